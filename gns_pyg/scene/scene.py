"""What is simulated: a scene as typed records, checked on construction. conf/scene/*.yaml are its files.

These records are also OmegaConf schemas, hence plain containers and no unions beyond primitives.
"""

import cmath
import itertools
import math
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any, Union

from omegaconf import MISSING

from gns_pyg.config import require, typed
from gns_pyg.errors import ConfigError
from gns_pyg.scene.travel import FUNCTION, travel

MOST_FRAMES = 1_000_000  # every one of them is looked at when a scene with a moving wall is read
FASTEST = 1e6  # rad/s or m/s: a function of time with a higher speed has no finite one (sqrt(t) at t = 0)


def positive(where: str, value: float, unit: str = "") -> None:
    """Raises ConfigError naming the key `where` unless `value` is finite and above 0."""
    expected = f"a finite number above 0 {unit}".rstrip()
    require(math.isfinite(value) and value > 0, where, value, expected, f"set {where} above 0")


def finite(values: Sequence[Any], n: int) -> bool:
    """Whether `values` are `n` finite numbers."""
    return len(values) == n and all(isinstance(value, Real) and math.isfinite(value) for value in values)


def _not_negative(where: str, value: float, unit: str = "") -> None:
    expected = f"a finite number of at least 0 {unit}".rstrip()
    require(math.isfinite(value) and value >= 0, where, value, expected, f"set {where} to 0 or above")


def _friction_angle(where: str, angle_rad: float) -> None:
    known = "at least 0 and below pi/2 rad"
    require(0 <= angle_rad < math.pi / 2, where, angle_rad, known, "give the angle in rad, e.g. 0.5 (29 degrees)")


@dataclass
class Material:
    """Elastic-frictional contact material (Yade's FrictMat; the paper's Table 1).

    Attributes:
        density_kg_m3: of the grains.
        young_modulus_pa: Yade's FrictMat: normal stiffness over the radius.
        poisson_ratio: Yade's FrictMat: the ratio of shear to normal stiffness.
        friction_angle_rad: between grains.
    """

    density_kg_m3: float = MISSING
    young_modulus_pa: float = MISSING
    poisson_ratio: float = MISSING
    friction_angle_rad: float = MISSING

    def __post_init__(self) -> None:
        positive("scene.grains.material.density_kg_m3", self.density_kg_m3, "kg/m^3")
        positive("scene.grains.material.young_modulus_pa", self.young_modulus_pa, "Pa")
        positive("scene.grains.material.poisson_ratio", self.poisson_ratio)
        _friction_angle("scene.grains.material.friction_angle_rad", self.friction_angle_rad)


@dataclass
class Grains:
    """Spheres of one or several radii and one material.

    Attributes:
        count: grains in all; with an inlet, those that enter later too.
        radius_m: a number, or a list of them (several sizes).
        share: part of the grains that has each radius, by number; empty is equal parts.
        shape: only `sphere`.
    """

    count: int = MISSING
    radius_m: Any = MISSING
    material: Material = MISSING
    share: list[float] = field(default_factory=list)
    shape: str = "sphere"

    def __post_init__(self) -> None:
        require(self.count > 0, "scene.grains.count", self.count, "at least 1", "set it to the number of grains")
        require(
            self.shape == "sphere",
            "scene.grains.shape",
            self.shape,
            "sphere; other shapes (clumps) need each grain's orientation and inertia in the state, contacts between "
            "members, and their storage in the trajectory, none of which is there yet",
            "use spheres, with a higher friction angle to stand for the shape",
        )
        key, radii = "scene.grains.radius_m", self.radius_m if isinstance(self.radius_m, list) else [self.radius_m]
        numbers = bool(radii) and all(finite([r], 1) and r > 0 for r in radii)
        require(numbers, key, self.radius_m, "a finite number above 0 m, or a list of them", f"e.g. {key}=0.01")
        require(len(set(radii)) == len(radii), key, self.radius_m, "every radius once", "give its part in share")
        share, key = self.share, "scene.grains.share"
        known = f"one number above 0 for each of the {len(radii)} radii, 1 in all"
        fits = not share or (len(share) == len(radii) and min(share) > 0 and abs(sum(share) - 1) < 1e-6)
        require(fits, key, share, known, "e.g. radius_m: [0.008, 0.012] with share: [0.6, 0.4]")

    @property
    def radii_m(self) -> list[float]:
        """Every radius that grains have, m, smallest first."""
        return sorted(float(r) for r in (self.radius_m if isinstance(self.radius_m, list) else [self.radius_m]))

    @property
    def counts(self) -> list[tuple[float, int]]:
        """(radius, m; number of grains), in the order of `radius_m`."""
        radii = self.radius_m if isinstance(self.radius_m, list) else [self.radius_m]
        until = [0.0, *itertools.accumulate(self.share or [1 / len(radii)] * len(radii))]
        ends = [round(self.count * part) for part in until]
        return [(float(r), b - a) for r, (a, b) in zip(radii, itertools.pairwise(ends), strict=True)]


@dataclass
class Initial:
    """How grains start.

    Attributes:
        arrangement: `random` (random sequential addition in the region) or `dense` (the sites of a randomly
            oriented close-packed lattice nearest to a random point).
        z_min_m, z_max_m: grain centres lie between these heights; None is no limit.
        region_m: opposite corners of a box that grain centres lie in; needed where no boundary part encloses them.
        speed_max_m_s: each velocity component is uniform in [-speed_max_m_s, speed_max_m_s].
    """

    arrangement: str = MISSING
    speed_max_m_s: float = MISSING
    z_min_m: float | None = None
    z_max_m: float | None = None
    region_m: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        corners = self.region_m
        box = not corners or (len(corners) == 2 and all(isinstance(c, list) and finite(c, 3) for c in corners))
        box = box and all(low < high for low, high in zip(*corners, strict=True))
        known_box = "[[x, y, z], [x, y, z]], the lower and the upper corner"
        require(box, "scene.initial.region_m", corners, known_box, "e.g. [[-0.1, -0.1, 0], [0.1, 0.1, 0.3]]")
        known = ("random", "dense")
        require(
            self.arrangement in known, "scene.initial.arrangement", self.arrangement, " or ".join(known), "pick one"
        )
        _not_negative("scene.initial.speed_max_m_s", self.speed_max_m_s, "m/s")


@dataclass
class Motion:
    """Rigid motion of a boundary part along or about `axis`, exact at every time.

    Attributes:
        kind: `none`; `rotation` about the line through `origin_m`; `translation`; `oscillation` (a sine way).
        axis: direction of the rotation axis or of the way.
        origin_m: a point of the rotation axis.
        rate_rad_s: of a rotation.
        speed_m_s: of a translation.
        amplitude_m, frequency_hz: of an oscillation; its way is amplitude_m sin(2 pi frequency_hz t).
        function: instead of a constant rate or speed: the angle in rad, or the way in m, as a function of t in s,
            0 at t = 0, e.g. "0.5 * t**2" (see `scene.travel`).
    """

    kind: str = "none"
    axis: list[float] = field(default_factory=list)
    origin_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    rate_rad_s: float = 0.0
    speed_m_s: float = 0.0
    amplitude_m: float = 0.0
    frequency_hz: float = 0.0
    function: str | None = None

    def check(self, where: str, times_s: Iterable[float] = (0.0,)) -> None:
        """Raises ConfigError for a value out of range, or a function that has none at one of `times_s` (0 is the
        first); `where` is this record's key, which only the scene knows."""
        known = {"none": (), "rotation": ("rate_rad_s",), "translation": ("speed_m_s",)}
        known["oscillation"] = ("amplitude_m", "frequency_hz")
        require(self.kind in known, f"{where}.kind", self.kind, " or ".join(known), "pick one of them")
        for key in {key for keys in known.values() for key in keys}:
            value = getattr(self, key)
            require(math.isfinite(value), f"{where}.{key}", value, "a finite number", "e.g. 3.0")
            owner = next(kind for kind, keys in known.items() if key in keys)
            belongs = value == 0 or self.kind == owner
            require(belongs, f"{where}.{key}", value, f"0 for a {self.kind}", f"set {where}.kind={owner}, or remove it")
        if self.kind != "none":
            axis_ok, direction = finite(self.axis, 3) and any(self.axis), "give its direction, e.g. [1, 0, 0]"
            require(axis_ok, f"{where}.axis", self.axis, "three finite numbers that are not all 0", direction)
            origin_ok = finite(self.origin_m, 3)
            require(origin_ok, f"{where}.origin_m", self.origin_m, "three finite numbers", "e.g. [0, 0, 0]")
        if self.function is None:
            return
        key, constant = f"{where}.function", self.rate_rad_s or self.speed_m_s
        takes = self.kind in ("rotation", "translation") and not constant
        require(takes, key, self.function, "a rotation or translation without a constant rate", "remove one of them")
        text = repr(self.function[:60])
        for time_s in times_s:
            try:
                way = travel(self, float(time_s), math)
                speed = travel(self, complex(time_s, 1e-30), cmath).imag / 1e-30  # see `scene.motion.way`
            except (ValueError, ArithmeticError) as error:
                found = f"{text} at t = {time_s:g}: {error}"
                raise ConfigError(key, found, FUNCTION, "e.g. '0.2 * sin(6.28 * t)'") from None
            real = isinstance(way, float) and math.isfinite(way) and abs(speed) < FASTEST
            found, known_way = f"{text} is {way:g}, its speed {speed:g}, at t = {time_s:g}", "finite in the whole run"
            require(real, key, found, known_way, "choose a function that is smooth from t = 0 to scene.duration_s")
            at_start = time_s != 0 or abs(way) < 1e-9
            require(at_start, key, f"{text} is {way:g} at t = 0", "0 there", "subtract it")

    @property
    def moves(self) -> bool:
        oscillates = self.amplitude_m * self.frequency_hz != 0.0
        return self.function is not None or self.rate_rad_s != 0.0 or self.speed_m_s != 0.0 or oscillates


@dataclass
class Part:
    """One rigid part of the boundary; grains lie inside a closed part, or on the winding side of an open one.

    Attributes:
        shape: `{kind: revolution, profile_m: [[radius, z], ...], segments, open_bottom}`, `{kind: cylinder, radius_m,
            length_m, axis, segments}`, `{kind: box, size_m, center_m}`, `{kind: floor, size_m, center_m}` or
            `{kind: file, path, scale}` (STL, OBJ, ...).
        points: number of boundary points the network sees.
        friction_angle_rad: between grains and this part.
    """

    shape: dict[str, Any] = field(default_factory=dict)
    points: int = MISSING
    friction_angle_rad: float = MISSING
    motion: Motion = field(default_factory=Motion)

    def check(self, where: str, times_s: Iterable[float] = (0.0,)) -> None:
        """Raises ConfigError for a value out of range (see `Motion.check`)."""
        enough = "see docs/assumptions.md for a sufficient number"
        require(self.points >= 1, f"{where}.points", self.points, "at least 1", enough)
        _friction_angle(f"{where}.friction_angle_rad", self.friction_angle_rad)
        self.motion.check(f"{where}.motion", times_s)


@dataclass
class AngleOfRepose:
    """How the angle of repose is read.

    Attributes:
        kind: `plane` (surface line in the plane across `axis`; a drum) or `radial` (height against distance from the
            vertical axis; a heap).
        axis: of a drum.
        from_s: its mean is over the frames from here on.
    """

    kind: str = MISSING
    axis: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0])
    from_s: float = MISSING

    def check(self, where: str) -> None:
        """Raises ConfigError for a value out of range; `where` is this record's key."""
        known = ("plane", "radial")
        require(self.kind in known, f"{where}.kind", self.kind, " or ".join(known), "pick one of them")
        axis_ok = self.kind == "radial" or (finite(self.axis, 3) and any(self.axis))
        found, expected = self.axis, "three finite numbers that are not all 0"
        require(axis_ok, f"{where}.axis", found, expected, "give the direction of the drum's axis, e.g. [1, 0, 0]")
        _not_negative(f"{where}.from_s", self.from_s, "s")


@dataclass
class Outlet:
    """A plane that grains leave the scene through: gone from the first frame on at which their centre is beyond it.

    Attributes:
        point_m: a point of the plane.
        normal: points out of the scene.
    """

    point_m: list[float] = field(default_factory=list)
    normal: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        where, example = "scene.outlet", "e.g. point_m: [0, 0, 0] with normal: [0, 0, -1]"
        require(finite(self.point_m, 3), f"{where}.point_m", self.point_m, "three finite numbers", example)
        normal_ok = finite(self.normal, 3) and any(self.normal)
        require(normal_ok, f"{where}.normal", self.normal, "three finite numbers that are not all 0", example)


@dataclass
class Inlet:
    """A horizontal rectangle that grains enter the scene through, one after the other (see `scene.inlet`).

    Attributes:
        count: grains that enter; they are the last ones of `scene.grains.count`.
        rate_per_s: grains per second.
        center_m, size_m: middle (three numbers) and edges (two numbers) of the rectangle.
        velocity_m_s: of an entering grain (three numbers).
    """

    count: int = 0
    rate_per_s: float = 0.0
    center_m: list[float] = field(default_factory=list)
    size_m: list[float] = field(default_factory=list)
    velocity_m_s: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        where = "scene.inlet"
        require(self.count >= 1, f"{where}.count", self.count, "at least 1", "set it to the number that enters")
        rate = self.rate_per_s
        require(math.isfinite(rate) and rate > 0, f"{where}.rate_per_s", rate, "grains per second, above 0", "e.g. 200")
        for key, n in (("center_m", 3), ("size_m", 2), ("velocity_m_s", 3)):
            value = getattr(self, key)
            require(finite(value, n), f"{where}.{key}", value, f"{n} finite numbers", "see docs/scenes.md")
        require(min(self.size_m) > 0, f"{where}.size_m", self.size_m, "two lengths above 0 m", "e.g. [0.1, 0.1]")


@dataclass
class Dem:
    """How Yade runs.

    Attributes:
        dt_s: the time step, or `auto`, a third of the P-wave step (see docs/time_step.md).
        verlet_distance_ratio: how far grains may move before Yade sorts them anew, over the radius; see
            docs/assumptions.md.
        decimals: digits after the point that the trajectory file keeps of each field, in SI units.
    """

    dt_s: Union[float, str] = "auto"
    verlet_distance_ratio: float = 0.3
    decimals: dict[str, int] = field(default_factory=lambda: {"position": 7, "velocity": 5, "angular_velocity": 3})

    def __post_init__(self) -> None:
        _not_negative("scene.dem.verlet_distance_ratio", self.verlet_distance_ratio)
        if self.dt_s != "auto":
            require(not isinstance(self.dt_s, str), "scene.dem.dt_s", self.dt_s, "seconds or auto", "e.g. 1e-5")
            positive("scene.dem.dt_s", float(self.dt_s), "s")


STATES = ("differences", "velocity", "full")  # what a state may hold, smallest first
PARAMETERS = ("density_kg_m3", "young_modulus_pa", "poisson_ratio", "friction_angle_rad", "damping")


@dataclass
class Scene:
    """Everything that defines a granular scene. Lengths in m, times in s, angles in rad.

    Attributes:
        name: cases are looked for in a folder of this name.
        duration_s: of a case.
        frame_dt_s: time between recorded frames, and of a step of the network.
        cases: how many there are, or are to be.
        seed: of the cases' starts and of the boundary points.
        gravity_m_s2: its three components.
        damping: Cundall's non-viscous damping, Yade's NewtonIntegrator; at least 0 and below 1.
        damping_on_gravity: whether it damps gravity too, as Yade does by default.
        mouth_height_m: height of a hopper's mouth (from the origin, against gravity), for its rate of discharge.
        vary: parameters (of PARAMETERS) that change from case to case -> their values; case n has value n modulo
            their number (see `of_case`).
        state: what a model's state must hold, as `data_gen.restart` measured it (see docs/state.md).
    """

    name: str = MISSING
    duration_s: float = MISSING
    frame_dt_s: float = MISSING
    cases: int = MISSING
    seed: int = 0
    gravity_m_s2: list[float] = MISSING
    damping: float = MISSING
    damping_on_gravity: bool = True
    grains: Grains = MISSING
    initial: Initial = MISSING
    boundary: dict[str, Part] = field(default_factory=dict)
    dem: Dem = field(default_factory=Dem)
    angle_of_repose: AngleOfRepose | None = None
    outlet: Outlet | None = None
    inlet: Inlet | None = None
    mouth_height_m: float | None = None
    vary: dict[str, Any] = field(default_factory=dict)
    state: str = "full"

    def __post_init__(self) -> None:
        positive("scene.duration_s", self.duration_s, "s")
        positive("scene.frame_dt_s", self.frame_dt_s, "s")
        a_frame = self.duration_s >= self.frame_dt_s * (1 - 1e-9)
        expected = f"at least one frame, scene.frame_dt_s = {self.frame_dt_s} s"
        require(a_frame, "scene.duration_s", self.duration_s, expected, "raise it, or lower scene.frame_dt_s")
        n_frames, expected = self.duration_s / self.frame_dt_s, f"at most {MOST_FRAMES} frames of scene.frame_dt_s"
        require(n_frames < MOST_FRAMES, "scene.duration_s", self.duration_s, expected, "lower it")
        require(self.cases >= 1, "scene.cases", self.cases, "at least 1", "set it to the number of cases")
        require(self.seed >= 0, "scene.seed", self.seed, "at least 0", "any whole number from 0 on")
        require(
            0 <= self.damping < 1, "scene.damping", self.damping, "at least 0 and below 1", "0 is no damping at all"
        )
        gravity, example = self.gravity_m_s2, "e.g. [0, 0, -9.81]"
        require(finite(gravity, 3), "scene.gravity_m_s2", gravity, "three finite numbers", example)
        for name, part in self.boundary.items():
            a_word = "a Python identifier: letters, digits and _, no digit first"
            require(name.isidentifier(), f"scene.boundary.{name}", name, a_word, "rename the part")
            part.check(f"scene.boundary.{name}", (frame * self.frame_dt_s for frame in range(self.n_frames)))
        if self.angle_of_repose is not None:
            self.angle_of_repose.check("scene.angle_of_repose")
        require(self.state in STATES, "scene.state", self.state, " or ".join(STATES), "see docs/state.md")
        if self.inlet is not None:
            if self.outlet is not None:
                arm = [a - b for a, b in zip(self.inlet.center_m, self.outlet.point_m, strict=True)]
                before = sum(a * b for a, b in zip(arm, self.outlet.normal, strict=True)) <= 0
                where, remedy = "scene.inlet.center_m", "move the inlet, or turn scene.outlet.normal"
                require(before, where, self.inlet.center_m, "a place that is not beyond the outlet", remedy)
            key, n = "scene.inlet.count", self.inlet.count
            require(n <= self.grains.count, key, n, f"at most scene.grains.count = {self.grains.count}", "lower it")
        for name, values in self.vary.items():
            require(name in PARAMETERS, f"scene.vary.{name}", "not a parameter", " or ".join(PARAMETERS), "pick one")
            listed = isinstance(values, list) and bool(values) and finite(values, len(values))
            require(listed, f"scene.vary.{name}", values, "a list of finite numbers", "e.g. [0.3, 0.5, 0.7]")
            for case in range(len(values)):
                self._with({name: float(values[case])})

    def of_case(self, case: int) -> "Scene":
        """The scene of case number `case`: parameters that vary have that case's values.

        Raises:
            ConfigError: for a value out of range.
        """
        return self._with({name: float(values[case % len(values)]) for name, values in self.vary.items()})

    def _with(self, values: dict[str, float]) -> "Scene":
        ours = {name: value for name, value in values.items() if name == "damping"}
        material = {name: value for name, value in values.items() if name not in ours}
        grains = replace(self.grains, material=replace(self.grains.material, **material))
        changed = copy(self)  # not `replace`, whose checks would come back here
        changed.grains, changed.damping = grains, ours.get("damping", self.damping)
        require(
            0 <= changed.damping < 1, "scene.vary.damping", changed.damping, "at least 0 and below 1", "see damping"
        )
        return changed

    @property
    def parameters(self) -> dict[str, float]:
        """The value of every one of PARAMETERS."""
        return {name: getattr(self if name == "damping" else self.grains.material, name) for name in PARAMETERS}

    @staticmethod
    def from_config(values: Any) -> "Scene":
        """Reads a scene from a Hydra node or a plain dict (the one stored in a trajectory or bundle).

        Raises:
            ConfigError: for unknown or missing keys, wrong types, or values out of range.
        """
        return typed(Scene, values, "scene")

    @property
    def n_frames(self) -> int:
        """Frames of a full run, the one at t = 0 included."""
        return round(self.duration_s / self.frame_dt_s) + 1
