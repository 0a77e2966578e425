// Plays DEM and network side by side: one camera, one clock. The data is what gns_pyg/report/player.py wrote into the
// page; three.js (three.min.js, as THREE) draws. Every grain is a square facing the camera on which a sphere is shaded:
// exact in the orthographic view, and 50,000 of them are 100,000 triangles.
(async () => {
  "use strict";
  const ABSENT = 65535; // of a stored coordinate
  const UNKNOWN = 255; // of a stored shade
  const root = document.getElementById("player");
  const one = (selector) => root.querySelector(selector);
  const [canvas, play, slider, rate, mode, slice, depth] = [
    "canvas", ".play", ".frame", ".rate", ".mode", ".slice", ".depth",
  ].map(one);

  function refuse(why) {
    root.dataset.state = "refused";
    one(".remark").textContent = `No 3D view: ${why}.`;
  }

  // ------------------------------------------------------------------------------------------------------- data

  async function unpack(base64) {
    const letters = atob(base64);
    const packed = new Uint8Array(letters.length);
    for (let i = 0; i < packed.length; i++) packed[i] = letters.charCodeAt(i);
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // Stored are differences from frame to frame, modulo the integer's range; the first frame as it is.
  function accumulate(frames, size) {
    for (let i = size; i < frames.length; i++) frames[i] += frames[i - size];
    return frames;
  }

  // Positions [view], then shades [mode][view], then radii; two-byte numbers as all low bytes, then all high bytes.
  function decode(bytes, meta) {
    const [n, size] = [meta.times_s.length * meta.grains, meta.grains];
    let at = 0;
    const take = (length) => bytes.subarray(at, (at += length));
    const positions = meta.views.map(() => {
      const [low, high] = [take(3 * n), take(3 * n)];
      const steps = new Uint16Array(3 * n);
      for (let i = 0; i < steps.length; i++) steps[i] = low[i] | (high[i] << 8);
      return accumulate(steps, 3 * size);
    });
    const shades = meta.modes.map((kind) => {
      const own = Array.from({ length: kind.shared ? 1 : 2 }, () => accumulate(take(n), size));
      return meta.views.map((_, view) => own[kind.shared ? 0 : view]);
    });
    return { positions, shades, radii: new Float32Array(bytes.slice(at).buffer) };
  }

  if (!("DecompressionStream" in window)) return refuse("this browser is too old (DecompressionStream is missing)");
  const meta = JSON.parse(document.getElementById("player-meta").textContent);
  const { positions, shades, radii } = decode(
    await unpack(document.getElementById("player-frames").textContent.trim()), meta,
  );
  const last = meta.times_s.length - 1;

  // ------------------------------------------------------------------------------------------------------ scene

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  } catch (error) {
    return refuse("this browser has no WebGL");
  }
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  renderer.setScissorTest(true);
  renderer.localClippingEnabled = true;
  const scene = new THREE.Scene();
  scene.background = new THREE.Color("#ffffff");
  const vector = (values) => new THREE.Vector3(...values);
  const [middle, up, away] = [meta.middle_m, meta.up, meta.toward_reader].map(vector);
  const reach = meta.size_m; // the longest edge of the box around the scene

  const camera = new THREE.OrthographicCamera();
  camera.up.copy(up);
  camera.far = 20 * reach;
  const controls = new THREE.OrbitControls(camera, canvas);
  controls.enableZoom = false; // until clicked, so that whoever scrolls down the page passes by
  canvas.addEventListener("pointerdown", () => (controls.enableZoom = true));
  canvas.addEventListener("pointerleave", () => (controls.enableZoom = false));
  controls.addEventListener("change", wake);

  let fit; // what the views show before anyone zooms
  function home() {
    const side = new THREE.Vector3().crossVectors(up, away);
    controls.target.copy(middle);
    camera.position.copy(middle).addScaledVector(away, 5 * reach).addScaledVector(side, 1.8 * reach);
    camera.position.addScaledVector(up, 1.6 * reach);
    camera.zoom = 1;
    controls.update();
    fit = halfBox();
    wake();
  }

  // Half the width and height of the box around the scene as the camera sees it.
  function halfBox() {
    const [right, above] = [new THREE.Vector3(), new THREE.Vector3()];
    camera.updateMatrixWorld();
    camera.matrixWorld.extractBasis(right, above, new THREE.Vector3());
    const edges = meta.box_m[1].map((high, i) => high - meta.box_m[0][i]);
    return [right, above].map((axis) => edges.reduce((sum, edge, i) => sum + Math.abs(axis.getComponent(i)) * edge / 2, 0));
  }

  const colours = new Uint8Array(meta.colours.flatMap((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)).concat(255)));
  const ramp = new THREE.DataTexture(colours, meta.colours.length, 1);
  ramp.minFilter = ramp.magFilter = THREE.LinearFilter;
  ramp.needsUpdate = true;

  const grainMaterial = new THREE.ShaderMaterial({
    uniforms: {
      origin: { value: vector(meta.origin_m) },
      unit: { value: meta.unit_m },
      part: { value: 0 }, // of the way from the frame before to the frame after
      cut: { value: [0, 0, 0, 1] }, // no grain beyond the plane: normal and distance
      ramp: { value: ramp },
    },
    vertexShader: `
      attribute vec3 before, after;
      attribute float shade, radius;
      uniform vec3 origin;
      uniform float unit, part;
      uniform vec4 cut;
      varying vec2 corner;
      varying float value, depth, size;
      void main() {
        vec3 centre = origin + unit * mix(before, after, part);
        bool absent = max(before.x, part > 0.0 ? after.x : 0.0) > ${ABSENT - 1}.5;
        vec4 seen = modelViewMatrix * vec4(centre, 1.0);
        corner = position.xy;
        value = shade;
        depth = seen.z;
        size = radius;
        gl_Position = projectionMatrix * (seen + vec4(corner * radius, 0.0, 0.0));
        if (absent || dot(cut.xyz, centre) > cut.w) gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // off the screen
      }`,
    fragmentShader: `
      uniform sampler2D ramp;
      uniform mat4 projectionMatrix;
      varying vec2 corner;
      varying float value, depth, size;
      void main() {
        float square = dot(corner, corner);
        if (square > 1.0) discard;
        vec3 normal = vec3(corner, sqrt(1.0 - square));
        vec4 surface = projectionMatrix * vec4(0.0, 0.0, depth + size * normal.z, 1.0);
        gl_FragDepth = 0.5 + 0.5 * surface.z / surface.w;
        vec3 colour = value > ${UNKNOWN - 1}.5 ? vec3(0.6) : texture2D(ramp, vec2(value / ${UNKNOWN - 1}.0, 0.5)).rgb;
        float light = 0.45 + 0.55 * max(0.0, dot(normal, vec3(-0.35, 0.55, 0.76)));
        gl_FragColor = vec4(colour * light * smoothstep(0.0, 0.35, normal.z + 0.15), 1.0);
      }`,
  });

  const square = new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]), 3);
  const radius = new THREE.InstancedBufferAttribute(radii, 1);
  const views = meta.views.map((name, view) => {
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    geometry.setAttribute("position", square);
    geometry.setAttribute("radius", radius);
    for (const key of ["before", "after"]) {
      geometry.setAttribute(key, new THREE.InstancedBufferAttribute(frameOf(positions[view], 0, 3), 3));
    }
    geometry.setAttribute("shade", new THREE.InstancedBufferAttribute(frameOf(shades[0][view], 0, 1), 1));
    geometry.instanceCount = meta.grains;
    const grains = new THREE.Mesh(geometry, grainMaterial);
    grains.frustumCulled = false;
    scene.add(grains);
    one(view ? ".right" : ".left").textContent = name;
    return { grains, geometry, view };
  });

  function frameOf(array, frame, width) {
    return array.subarray(frame * meta.grains * width, (frame + 1) * meta.grains * width);
  }

  const plane = new THREE.Plane(new THREE.Vector3(), 1); // keeps everything
  scene.add(new THREE.AmbientLight("#ffffff", 1.6));
  const lamp = new THREE.DirectionalLight("#ffffff", 1.6);
  scene.add(lamp);
  const walls = meta.walls.map((wall) => {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(wall.vertices.flat()), 3));
    geometry.setIndex(wall.triangles.flat());
    const look = { transparent: true, depthWrite: false, clippingPlanes: [plane] };
    const skin = new THREE.MeshLambertMaterial({
      ...look, color: "#8fa3b5", opacity: 0.13, side: THREE.DoubleSide, flatShading: true,
    });
    const lines = new THREE.LineBasicMaterial({ ...look, color: "#33424f", opacity: 0.3 });
    const pivot = new THREE.Group(); // its children's origin is where the part turns about
    const pieces = [new THREE.Mesh(geometry, skin), new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 3), lines)];
    for (const piece of pieces) {
      piece.position.copy(vector(wall.origin_m)).negate();
      piece.renderOrder = 1;
      pivot.add(piece);
    }
    scene.add(pivot);
    return { ...wall, pivot };
  });

  function placeWalls(frame, part) {
    for (const { pivot, origin_m, axis, turns, way } of walls) {
      const come = way.length ? way[frame] + part * (way[Math.min(frame + 1, last)] - way[frame]) : 0;
      pivot.position.copy(vector(origin_m));
      if (turns) pivot.setRotationFromAxisAngle(vector(axis), come);
      else pivot.position.addScaledVector(vector(axis), come);
    }
  }

  // The half towards the reader is cut away, from wherever the scene is looked at.
  function placeSlice() {
    if (slice.value === "") {
      plane.set(new THREE.Vector3(), 1);
      grainMaterial.uniforms.cut.value = [0, 0, 0, 1];
      return;
    }
    const index = Number(slice.value);
    const toward = Math.sign(camera.position.getComponent(index) - controls.target.getComponent(index)) || 1;
    const [low, high] = meta.box_m;
    const place = toward * (low[index] + Number(depth.value) * (high[index] - low[index]));
    plane.normal.set(0, 0, 0).setComponent(index, -toward);
    plane.constant = place;
    grainMaterial.uniforms.cut.value = [0, 1, 2].map((i) => (i === index ? toward : 0)).concat(place);
  }

  function drawAxes() {
    const [right, above] = [new THREE.Vector3(), new THREE.Vector3()];
    camera.matrixWorld.extractBasis(right, above, new THREE.Vector3());
    one(".axes").innerHTML = ["x", "y", "z"].map((name, i) => {
      const [x, y] = [24 * right.getComponent(i), -24 * above.getComponent(i)];
      return `<line x2="${x}" y2="${y}"></line><text x="${1.28 * x}" y="${1.28 * y}">${name}</text>`;
    }).join("");
  }

  // ------------------------------------------------------------------------------------------------------ clock

  const state = { time_s: meta.times_s[0], playing: false, drawn: 0 };
  let shown = -1; // the frame whose arrays the GPU has

  function frameAt(time_s) {
    const after = meta.times_s.findIndex((known_s) => known_s > time_s + 1e-9);
    return after < 0 ? last : Math.max(0, after - 1);
  }

  function upload(frame) {
    if (frame === shown) return;
    shown = frame;
    for (const { geometry, view } of views) {
      const arrays = {
        before: frameOf(positions[view], frame, 3),
        after: frameOf(positions[view], Math.min(frame + 1, last), 3),
        shade: frameOf(shades[mode.selectedIndex][view], frame, 1),
      };
      for (const [key, array] of Object.entries(arrays)) {
        geometry.attributes[key].array = array;
        geometry.attributes[key].needsUpdate = true;
      }
    }
  }

  function draw() {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width) return;
    const ratio = renderer.getPixelRatio();
    if (canvas.width !== Math.floor(width * ratio) || canvas.height !== Math.floor(height * ratio)) {
      renderer.setSize(width, height, false);
    }
    const half = width / 2;
    const tall = 1.12 * Math.max(fit[1], (fit[0] * height) / half);
    [camera.top, camera.bottom, camera.left, camera.right] = [tall, -tall, (-tall * half) / height, (tall * half) / height];
    camera.updateProjectionMatrix();
    const frame = frameAt(state.time_s);
    const step_s = frame < last ? meta.times_s[frame + 1] - meta.times_s[frame] : 1;
    const part = Math.max(0, (state.time_s - meta.times_s[frame]) / step_s);
    upload(frame);
    grainMaterial.uniforms.part.value = part < 1e-6 ? 0 : part;
    placeWalls(frame, part);
    placeSlice();
    lamp.position.copy(camera.position);
    for (const { view } of views) {
      for (const { grains, view: other } of views) grains.visible = view === other;
      renderer.setViewport(view * half, 0, half, height);
      renderer.setScissor(view * half, 0, half, height);
      renderer.render(scene, camera);
    }
    drawAxes();
    slider.value = frame;
    one(".time").textContent = `${state.time_s.toFixed(3)} s, frame ${frame + 1} of ${last + 1}`;
    root.dataset.frame = frame;
    root.dataset.drawn = ++state.drawn;
  }

  let asked = false; // for a drawing
  let before_ms = 0;
  function wake() {
    if (asked) return;
    asked = true;
    requestAnimationFrame((now_ms) => {
      asked = false;
      if (state.playing) {
        const passed_s = before_ms ? Math.min(0.1, (now_ms - before_ms) / 1e3) : 0;
        state.time_s += passed_s * Number(rate.value);
        if (state.time_s > meta.times_s[last]) state.time_s = meta.times_s[0];
      }
      before_ms = state.playing ? now_ms : 0;
      draw();
      if (state.playing) wake();
    });
  }

  // --------------------------------------------------------------------------------------------------- controls

  function setPlaying(playing) {
    state.playing = playing;
    play.textContent = playing ? "\u23F8" : "\u25B6";
    wake();
  }

  function showLegend() {
    const { label, unit, top, open } = meta.modes[mode.selectedIndex];
    const text = (value) => Number(value.toPrecision(2)).toString();
    const ends = ["0", text(top / 2), `${open ? "\u2265 " : ""}${text(top)}`];
    one(".ticks").innerHTML = ends.map((end) => `<span>${end}</span>`).join("");
    one(".legend").title = label;
    one(".ramp").textContent = unit ? `${label} (${unit})` : label;
    one(".ramp").style.background = `linear-gradient(to right, ${meta.colours.join(",")})`;
  }

  slider.max = last;
  meta.modes.forEach(({ label }) => mode.add(new Option(label)));
  play.onclick = () => setPlaying(!state.playing);
  slider.oninput = () => {
    state.time_s = meta.times_s[Number(slider.value)];
    setPlaying(false);
  };
  mode.onchange = () => {
    shown = -1;
    showLegend();
    wake();
  };
  slice.onchange = () => {
    depth.disabled = slice.value === "";
    wake();
  };
  depth.oninput = wake;
  one(".home").onclick = home;
  root.onkeydown = (event) => {
    if (event.key !== " " || event.target.closest("button, select")) return;
    event.preventDefault();
    setPlaying(!state.playing);
  };
  new ResizeObserver(wake).observe(canvas);
  one(".remark").textContent = meta.remark;
  showLegend();
  home();
  root.dataset.state = "ready";
})().catch((error) => {
  document.getElementById("player").dataset.state = "failed";
  throw error;
});
