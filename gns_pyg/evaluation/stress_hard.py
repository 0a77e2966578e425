"""The hard lines: what must hold at the extremes, whatever the bundle. Each takes a `Bench` and returns a verdict."""

import math
import tempfile
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from gns_pyg.data.coverage import coverage, outside_coverage
from gns_pyg.data.datamodule import DataConfig, split
from gns_pyg.data.trajectory import Trajectory, TrajectoryWriter
from gns_pyg.dynamics.places import elsewhere, in_scene
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import GnsError, NumericalError
from gns_pyg.evaluation.contacts import mean_overlap_ratio
from gns_pyg.evaluation.predict import initial_state, start_frame, write_rollout
from gns_pyg.evaluation.stress import Bench, Verdict, finite, kinetic_energy, last, steps
from gns_pyg.machine import peak_memory_mb
from gns_pyg.scene.boundary_points import sufficient_points
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.motion import to_world
from gns_pyg.scene.scene import PARAMETERS, Part, Scene
from gns_pyg.state import State

LONG = 10  # times the length of the training cases
SETTLED_STEPS = 10_000
TUNNEL_M_S = (1.0, 10.0, 30.0, 100.0)


def degenerate(bench: Bench) -> Verdict:
    """Coincident grains, half a diameter of overlap, centres on a boundary point, a corner and an edge of the mesh."""
    simulator, state = bench.simulator, bench.middle
    pos = state.pos.clone()
    pos[1] = pos[0]
    pos[3] = pos[2] + torch.tensor([1.0, 0.0, 0.0]) * state.radius[2]
    places = ["coincident", "half overlapping"]
    for name, part in simulator.scene.boundary.items():
        mesh = build_mesh(name, part)
        corner, middle = mesh.triangles[0, 0], mesh.triangles[0, :2].mean(axis=0)
        held = next(iter(simulator.boundary or ())).pos[0].numpy()
        body = torch.from_numpy(np.stack([held, corner, middle]))
        pos[4:7] = to_world(part.motion, body, state.time_s[state.batch[4:7]])[0]
        places += ["on a boundary point", "on a corner", "on an edge"]
        break
    pos.requires_grad_()
    after = simulator(replace(state, pos=pos))
    (after.pos.sum() + after.vel.sum()).backward()
    weights = [parameter.grad for parameter in simulator.parameters() if parameter.grad is not None]
    simulator.zero_grad()
    grads = [pos.grad, *weights]
    ok = finite(after) and all(g is not None and bool(torch.isfinite(g).all()) for g in grads)
    return ok, f"{', '.join(places)}: output and {len(grads)} gradients {'finite' if ok else 'NOT finite'}"


def slivers(bench: Bench) -> Verdict:
    """A boundary with sliver and degenerate triangles."""
    state, scene = bench.middle, deepcopy(bench.simulator.scene)
    low, high = state.pos.amin(0).numpy() - 0.05, state.pos.amax(0).numpy() + 0.05
    box = trimesh.creation.box(high - low).apply_translation((high + low) / 2)
    a, b, c = box.faces[0]
    near = box.vertices[a] + (box.vertices[b] - box.vertices[a]) * 0.5 + (box.vertices[c] - box.vertices[a]) * 1e-7
    vertices, new = np.vstack([box.vertices, near]), len(box.vertices)
    faces = np.vstack([box.faces[1:], [[a, b, new], [b, c, new], [c, a, new], [a, a, b]]])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "slivers.obj"
        path.write_text(trimesh.exchange.obj.export_obj(trimesh.Trimesh(vertices, faces, process=False), digits=12))
        shape = {"kind": "file", "path": str(path)}
        mesh, radius_m = build_mesh("slivers", Part(shape, 1, 0.5)), scene.grains.radii_m[0]
        points = sufficient_points(mesh, radius_m, bench.simulator.config.cutoff_wall_radii * radius_m)
        scene.boundary = {"slivers": Part(shape, 2 * points, 0.5)} if scene.boundary else {}
        other = in_scene(bench.simulator, scene)
        after = last(other, state, 5)
    n_thin = int((mesh.area_faces < 1e-6 * mesh.area).sum())
    return finite(after), f"box with {n_thin} sliver triangle(s), a degenerate one dropped: 5 steps finite"


def few_and_many(bench: Bench) -> Verdict:
    """0, 1 and 2 grains; no edges; the last grain isolated; 400 neighbours; all in one cell."""
    simulator, state, told = bench.simulator, bench.middle, []
    for n in (0, 1, 2):
        after = simulator(state.pick(torch.arange(n)))
        if after.pos.shape != (n, 3):
            return False, f"{n} grains: {tuple(after.pos.shape)}"
    told.append("0, 1, 2 grains: right shapes")

    far = state.pos.clone()
    far[-1] = state.pos.amax(0) + 10.0  # no wall, no grain in reach
    with torch.inference_mode():
        apart, alone = simulator(replace(state, pos=far)), state.pick(torch.arange(len(far) - 1))
        free = simulator.integrator.without_contact(replace(state, pos=far)).pos[-1]
        rest = simulator(alone)
    flies = torch.equal(apart.pos[-1], free) if not simulator.config.self_loops else True
    unseen = torch.allclose(apart.pos[:-1], rest.pos, rtol=0, atol=1e-12)
    if not (flies and unseen):
        return False, f"isolated last grain: free {flies}, unseen by others {unseen}"
    told.append("an isolated last grain flies free and is unseen")

    random, middle = np.random.default_rng(0), state.pos.mean(0)
    for what, n, spread in (
        ("400 neighbours", 401, simulator.cutoff_m / 4),
        ("one cell", 300, 1e-3 * simulator.cutoff_m),
    ):
        crowd = _crowd(state, middle.numpy() + random.uniform(-spread, spread, (n, 3)))
        edges = simulator.pairs_in_reach(crowd)
        expected = int((torch.cdist(crowd.pos, crowd.pos) <= simulator.cutoff_m).sum()) - n
        expected += n if simulator.config.self_loops else 0
        if edges.shape[1] != expected or not finite(simulator(crowd)):
            return False, f"{what}: {edges.shape[1]} edges, brute force {expected}"
        told.append(f"{what}: all {expected} edges")
    return True, "; ".join(told)


def shifted(bench: Bench) -> Verdict:
    """The scene moved by 1 m, 1 km and 1e6 m."""
    simulator, state = bench.simulator, bench.middle
    n, told, ok = 20, [], True
    if simulator.config.absolute_position:
        with elsewhere(simulator, state, shift_m=1000.0) as (other, moved):
            try:
                last(other, moved, 1)
            except GnsError as error:
                return True, f"absolute position: refused ({str(error).splitlines()[0]})"
        return False, "absolute position: moved away without a refusal"
    here = last(simulator, state, 1), last(simulator, state, n)
    for shift_m, most_m in ((1.0, 1e-6), (1000.0, 1e-4), (1e6, math.inf)):
        with elsewhere(simulator, state, shift_m=shift_m) as (other, moved):
            apart_m = float((last(other, moved, 1).pos - shift_m - here[0].pos).abs().max())
            later_m = float((last(other, moved, n).pos - shift_m - here[1].pos).abs().max())
        limit = min(most_m, 1e-6) if shift_m < 1e6 else 1e-6
        ok &= apart_m <= limit
        told.append(f"{shift_m:g} m: {apart_m:.1e} m after a step, {later_m:.1e} m after {n}")
    return ok, "; ".join(told)


def other_units(bench: Bench) -> Verdict:
    """The same scene with all lengths scaled (grains of 10 um to 1 m), times by the square root of that."""
    simulator, state = bench.simulator, bench.middle
    radius_m, told, ok = simulator.scene.grains.radii_m[-1], [], True
    if simulator.config.absolute_position:
        return None, "absolute position: tied to its own units"
    double = deepcopy(simulator).double()  # so that rounding does not hide what the equations do
    for target_m in (1e-5, 1e-3, 1.0):
        length, worst = target_m / radius_m, []
        for model in (double, simulator):
            with elsewhere(model, state, length=length, time=math.sqrt(length)) as (other, moved):
                here, after = last(model, state, 1), last(other, moved, 1)
            apart = float((after.pos / length - here.pos).abs().max()) / radius_m
            faster = float((after.vel / math.sqrt(length) - here.vel).abs().max()) / simulator.statistics.velocity_m_s
            worst.append(max(apart, faster))
        ok &= worst[0] <= 1e-5
        told.append(f"radius {target_m:g} m: {worst[0]:.1e}, networks in float32 {worst[1]:.1e}")
    return ok, "motion over radius and velocity scale differs by " + "; ".join(told)


def settled(bench: Bench) -> Verdict:
    """A pile that the DEM has let come to rest; where walls move, they are stopped, and the line is a figure."""
    own = bench.simulator.settles
    case = bench.recorded("long" if own else "still")
    if case is None:
        return None, "no settled DEM run of this scene is embedded"
    scene = replace(Scene.from_config(case.scene), frame_dt_s=bench.simulator.scene.frame_dt_s)
    simulator = in_scene(bench.simulator, scene)
    state, frame = initial_state(simulator, case, case.n_frames - 1), case.n_frames // 2
    n = SETTLED_STEPS if bench.full else 400
    mass_center, speed, curve = state.pos.mean(0), [], [0.0]
    for after in steps(simulator, state, n):
        speed.append(float(after.vel.square().sum(1).mean()))
        curve.append(float(torch.linalg.vector_norm(after.pos.mean(0) - mass_center)))
    diameter_m = 2 * simulator.scene.grains.radii_m[0]
    moved, dem = curve[-1] / diameter_m, case.read("position", frame).mean(axis=1)
    dem_moved = float(np.linalg.norm(dem[-1] - dem[0])) / diameter_m
    grows = speed[-1] > max(speed[0], 1e-12)
    bench.curves["settled"] = {"moved_m": curve[:: max(1, n // 500)], "steps": n}
    took_s = n * simulator.scene.frame_dt_s
    holds = max(curve) / diameter_m < 0.01 and not grows
    where = "" if own else "the scene's walls move, nothing settles in it (no mark); with its walls stopped: "
    return holds if own else None, where + (
        f"{n} steps ({took_s:g} s): centre of mass {moved:.1e} diameters (at most {max(curve) / diameter_m:.1e}), "
        f"mean square speed {speed[0]:.1e} -> {speed[-1]:.1e} m^2/s^2; "
        f"Yade in {case.times_s[-1] - case.times_s[frame]:g} s: {dem_moved:.1e} diameters"
    )


def long_run(bench: Bench) -> Verdict:
    """Ten times the length of the training cases, from an unseen start."""
    simulator, dem = bench.simulator, bench.recorded("long")
    trained_s, dt_s = float(bench.case.times_s[-1]), simulator.scene.frame_dt_s
    n = round((LONG if bench.full else 0.1) * trained_s / dt_s)
    density, radius = simulator.scene.grains.material.density_kg_m3, bench.start.radius
    every, energies, escaped, overlap = max(1, round(0.05 / dt_s)), [], 0, []
    simulator.guard.reset()
    for number, after in enumerate(steps(simulator, bench.start, n), 1):
        if number % every == 0:
            energies.append((float(after.time_s[0]), kinetic_energy(after, density)))
            escaped = max(escaped, bench.escaped(after))
            overlap.append(float(mean_overlap_ratio(after.pos[None].numpy(), radius.numpy())[0]))
    times_s, energy = np.array(energies).T if energies else (np.zeros(1), np.zeros(1))
    crossings = simulator.guard.crossings
    ok, told = escaped == 0, f"{n * dt_s:g} s: finite, {escaped} escaped, {crossings} stopped at walls"
    bench.curves["long"] = {"times_s": times_s.tolist(), "energy_j": energy.tolist()}
    half = len(overlap) // 2
    if half:
        told += f", mean overlap {100 * np.mean(overlap[:half]):.2f} -> {100 * np.mean(overlap[half:]):.2f} %"
    if dem is not None:
        vel = dem.read("velocity")
        dem_energy = (dem.mass * (vel**2).sum(axis=2) / 2).sum(axis=1)
        steady = dem.times_s > dem.times_s[-1] / 2
        band_j = float(dem_energy[steady].max())
        bench.curves["long"] |= {"dem_times_s": dem.times_s.tolist(), "dem_energy_j": dem_energy.tolist()}
        late = energy[times_s > times_s[-1] / 2] if bench.full else energy[:0]
        highest_j = float(late.max()) if len(late) else float("nan")
        ok &= not highest_j > 2 * band_j + 1e-9
        told += f"; kinetic energy in the last half at most {highest_j:.2e} J, DEM's steady band up to {band_j:.2e} J"
    return ok, told


def tunnelling(bench: Bench) -> Verdict:
    """Grains at up to 100 m/s, in every direction."""
    simulator, told, ok = bench.simulator, [], True
    directions = torch.randn(12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions /= torch.linalg.vector_norm(directions, dim=1, keepdim=True)
    for speed in TUNNEL_M_S:
        vel = bench.middle.vel.clone()
        vel[: len(directions)] = speed * directions
        state = replace(bench.middle, vel=vel)
        simulator.guard.reset()
        escaped = max(bench.escaped(after) for after in steps(simulator, state, 40))
        crossings = simulator.guard.crossings
        ok &= escaped == 0
        told.append(f"{speed:g} m/s: {crossings} stopped at walls, {escaped} through")
    return ok, "; ".join(told)


def extremes(bench: Bench) -> Verdict:
    """Another speed of the drum, gravity, damping and frame step than trained."""
    simulator, own = bench.simulator, bench.simulator.scene
    told, ok, n = [], True, 200 if bench.full else 15
    for what, scene, damping, expected in _extremes(own):
        other, state = in_scene(simulator, scene), bench.middle
        now = coverage(scene, [bench.case], slice(bench.case.n_frames // 2, bench.case.n_frames // 2 + 1))
        if state.parameters is not None and damping is not None:
            parameters = state.parameters.clone()
            parameters[:, PARAMETERS.index("damping")] = damping
            state, now = replace(state, parameters=parameters), now | {"damping": [damping, damping]}
        warned = outside_coverage(bench.covered, now) if bench.covered else [expected or ""]
        named = expected is None or any(expected in text for text in warned)
        after = last(other, state, n)
        escaped, stopped = bench.escaped(after, other), other.guard.crossings
        ok &= named and escaped == 0 and finite(after)
        text = f"{what}: {escaped} escaped, {stopped} stopped at walls"
        text += "" if expected is None else ", warned" if named else f", NOT warned of {expected}"
        told.append(text)
    return ok, "; ".join(told)


def bad_values(bench: Bench) -> Verdict:
    """NaN and infinity in every field, at the start and in the middle of a roll-out."""
    simulator, told = bench.simulator, []
    fields = [name for name in ("pos", "vel", "ang_vel", "drift", "radius") if getattr(bench.middle, name) is not None]
    for name in fields:
        for value in (math.nan, math.inf):
            values = getattr(bench.middle, name).clone()
            values[2] = value
            try:
                last(simulator, replace(bench.middle, **{name: values}), 1)
            except NumericalError as error:
                if not ("step 0" in str(error) and f"{name} of grain 2" in str(error)):
                    return False, str(error)
                continue
            return False, f"{value} in {name} went unnoticed"
    told.append(f"{', '.join(fields)}: refused at step 0, grain and field named")
    with tempfile.TemporaryDirectory() as folder:
        path, forward, calls = Path(folder) / "rollout.h5", simulator.forward, [0]

        def broken(state: State) -> State:
            calls[0] += 1
            after = forward(state)
            if calls[0] < 4 * max(1, round(bench.case.frame_dt_s / simulator.scene.frame_dt_s)):
                return after
            vel = after.vel.clone()
            vel[1] = math.nan
            return replace(after, vel=vel)

        simulator.forward = broken  # type: ignore[method-assign]
        try:
            write_rollout(simulator, bench.case, start_frame(bench.case, bench.start_s), path)
        except NumericalError as error:
            kept = Trajectory(path.with_name("rollout_stopped.h5"))
            ok = "vel of grain 1" in str(error) and not path.exists() and kept.n_frames == 4
            told.append(f"in the middle: named, {kept.n_frames} good frames kept in rollout_stopped.h5")
        else:
            ok = False
        finally:
            del simulator.forward
    return ok, "; ".join(told)


def too_little(bench: Bench) -> Verdict:
    """Statistics without variance, a case of one frame, a single case."""
    scene, told, ok = bench.simulator.scene, [], True
    attempts: list[tuple[str, Callable[[Path], Any]]] = [
        ("nothing moves", lambda _: replace(bench.simulator.statistics, velocity_m_s=0.0)),
        ("one frame", lambda folder: start_frame(_one_frame(bench.case, folder), 0.0)),
        ("one case", lambda folder: split(scene, DataConfig(dir=str(_one_case(bench.case, folder))))),
    ]
    for what, attempt in attempts:
        with tempfile.TemporaryDirectory() as folder:
            try:
                attempt(Path(folder))
                told.append(f"{what}: works")
            except GnsError as error:
                told.append(f"{what}: refused ({error.expected})")
            except Exception as error:
                ok, told = False, [*told, f"{what}: {error!r}"]
    return ok, "; ".join(told)


def single_precision(bench: Bench) -> Verdict:
    """One step with float32 and with float64 networks."""
    simulator = bench.simulator
    double = deepcopy(simulator).double()
    one, two = (last(model, bench.middle, 1) for model in (simulator, double))
    apart = float((one.vel - two.vel).abs().max()) / simulator.statistics.velocity_m_s
    return apart <= 1e-5, f"largest difference {apart:.1e} of the velocity scale"


def repeatable(bench: Bench) -> Verdict:
    """The same roll-out twice, on the CPU with fixed threads."""
    n = 100 if bench.full else 10
    one, two = (last(bench.simulator, bench.start, n) for _ in range(2))
    same = torch.equal(one.pos, two.pos) and torch.equal(one.vel, two.vel)
    return same, f"{n} steps twice: {'bitwise the same' if same else 'NOT the same'} (training: tests/integration)"


def a_million(bench: Bench) -> Verdict:
    """A million grains through one step of a small network."""
    if not bench.full:
        return None, "full form only"
    simulator = _small(bench.simulator)
    side = 100
    grid = torch.cartesian_prod(*[torch.arange(side, dtype=torch.float64)] * 3)
    spacing_m = 2 * simulator.scene.grains.radii_m[0] * 0.999
    crowd = _crowd(bench.middle, (grid * spacing_m).numpy())
    before_mb = peak_memory_mb()
    simulator.execution = replace(simulator.execution, tile_grains=100_000)
    after = last(simulator, crowd, 1)
    n_edges, fewest = simulator.edges_done, 5 * side**3 / (1 + simulator.pairs_once)  # six neighbours a grain
    return finite(after) and len(after.pos) == side**3 and n_edges > fewest, (
        f"{side**3:,} grains, {n_edges:,} edges through the networks: finite; peak memory "
        f"{peak_memory_mb() / 1024:.2f} GiB (before: {before_mb / 1024:.2f})"
    )


HARD: dict[str, Callable[[Bench], Verdict]] = {
    "coincident, overlapping, on a wall": degenerate,
    "sliver and degenerate triangles": slivers,
    "no grains, few, isolated, crowded": few_and_many,
    "coordinates shifted": shifted,
    "other units": other_units,
    "settled pile": settled,
    "ten times the trained length": long_run,
    "grains up to 100 m/s": tunnelling,
    "drum speed, gravity, damping, frame step": extremes,
    "NaN and infinity": bad_values,
    "too little data": too_little,
    "float32 against float64": single_precision,
    "repeatable": repeatable,
    "a million grains": a_million,
}


def _crowd(like: State, pos: np.ndarray) -> State:
    """Grains at rest at `pos`, (n, 3), m, one graph, of the radius and parameters of `like`."""
    n, zeros = len(pos), torch.zeros(len(pos), 3, dtype=torch.float64)
    return State(
        pos=torch.from_numpy(np.ascontiguousarray(pos)),
        vel=zeros,
        ang_vel=None if like.ang_vel is None else zeros,
        radius=like.radius[:1].expand(n).contiguous(),
        time_s=like.time_s[:1],
        batch=torch.zeros(n, dtype=torch.long),
        parameters=None if like.parameters is None else like.parameters[:1],
        active=None if like.active is None else torch.ones(n, dtype=torch.bool),
    )


def _extremes(own: Scene) -> list[tuple[str, Scene, float | None, str | None]]:
    """What, the changed scene, damping, what must be warned of (None: lies within what was trained)."""
    rows: list[tuple[str, Scene, float | None, str | None]] = []
    for name, part in own.boundary.items():
        if part.motion.moves and part.motion.rate_rad_s:
            for factor, expected in ((0.0, "wall speed"), (10.0, "wall speed"), (-1.0, None)):
                scene = deepcopy(own)
                scene.boundary[name].motion.rate_rad_s *= factor
                rows.append((f"speed x {factor:g}", scene, None, expected))
    for factor in (0.0, 10.0):
        scene = replace(deepcopy(own), gravity_m_s2=[factor * g for g in own.gravity_m_s2])
        rows.append((f"gravity x {factor:g}", scene, None, "gravity"))
    for damping in (0.0, 0.9):
        expected = None if damping == own.damping else "damping"
        rows.append((f"damping {damping:g}", replace(deepcopy(own), damping=damping), damping, expected))
    for factor in (0.1, 4.0):
        scene = replace(deepcopy(own), frame_dt_s=factor * own.frame_dt_s)
        rows.append((f"frame x {factor:g}", scene, None, "frame"))
    return rows


def _one_frame(case: Trajectory, folder: Path) -> Trajectory:
    with TrajectoryWriter(
        folder / "case_000.h5", case.scene, case.radius, case.mass, case.boundary, dict.fromkeys(_fields(case), 6)
    ) as writer:
        writer.append(0, 0.0, *(case.read(name, 0, 1)[0] for name in _fields(case)))
        writer.finish(case.run)
    return Trajectory(folder / "case_000.h5")


def _one_case(case: Trajectory, folder: Path) -> Path:
    (folder / "case_000.h5").write_bytes(case.path.read_bytes())
    return folder


def _fields(case: Trajectory) -> tuple[str, ...]:
    return ("position", "velocity", "angular_velocity")


def _small(simulator: Simulator) -> Simulator:
    """An untrained simulator of width 8 and one layer without walls."""
    config = replace(simulator.config, hidden=8, layers=1)
    scene = replace(deepcopy(simulator.scene), boundary={})
    rows = ("wall_network", "wall_velocity", "wall_friction", "static_walls", "reachable_points")
    without: dict[str, Any] = dict.fromkeys(rows, False)
    requires = replace(simulator.requires, **without)
    return Simulator(scene, config, requires, {}, simulator.statistics).eval()
