"""What is simulated: a scene as typed records, checked on construction. conf/scene/*.yaml are its files.

These records are also OmegaConf schemas, hence plain containers and no unions beyond primitives.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, Union

from omegaconf import MISSING

from gns_pyg.config import require, typed


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
    """Elastic-frictional contact material (Yade's FrictMat; the paper's Table 1)."""

    density_kg_m3: float = MISSING
    young_modulus_pa: float = MISSING
    poisson_ratio: float = MISSING  # Yade's FrictMat: the ratio of shear to normal stiffness
    friction_angle_rad: float = MISSING

    def __post_init__(self) -> None:
        positive("scene.grains.material.density_kg_m3", self.density_kg_m3, "kg/m^3")
        positive("scene.grains.material.young_modulus_pa", self.young_modulus_pa, "Pa")
        positive("scene.grains.material.poisson_ratio", self.poisson_ratio)
        _friction_angle("scene.grains.material.friction_angle_rad", self.friction_angle_rad)


@dataclass
class Grains:
    """Spheres of one radius and one material."""

    count: int = MISSING
    radius_m: float = MISSING
    material: Material = MISSING

    def __post_init__(self) -> None:
        require(self.count > 0, "scene.grains.count", self.count, "at least 1", "set it to the number of grains")
        positive("scene.grains.radius_m", self.radius_m, "m")


@dataclass
class Initial:
    """How grains start.

    Attributes:
        arrangement: `random` (random sequential addition in the region) or `dense` (the sites of a randomly
            oriented close-packed lattice nearest to a random point).
        z_min_m, z_max_m: grain centres lie between these heights; None is no limit.
        speed_max_m_s: each velocity component is uniform in [-speed_max_m_s, speed_max_m_s].
    """

    arrangement: str = MISSING
    speed_max_m_s: float = MISSING
    z_min_m: float | None = None
    z_max_m: float | None = None

    def __post_init__(self) -> None:
        known = ("random", "dense")
        require(
            self.arrangement in known, "scene.initial.arrangement", self.arrangement, " or ".join(known), "pick one"
        )
        _not_negative("scene.initial.speed_max_m_s", self.speed_max_m_s, "m/s")


@dataclass
class Motion:
    """Rigid motion of a boundary part. `none`, or `rotation` about the line through `origin_m` along `axis`."""

    kind: str = "none"
    axis: list[float] = field(default_factory=list)
    origin_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    rate_rad_s: float = 0.0

    def check(self, where: str) -> None:
        """Raises ConfigError for a value out of range; `where` is this record's key, which only the scene knows."""
        known = ("none", "rotation")
        require(self.kind in known, f"{where}.kind", self.kind, " or ".join(known), "pick one of them")
        if self.kind == "rotation":
            require(
                finite(self.axis, 3) and any(self.axis),
                f"{where}.axis",
                self.axis,
                "three finite numbers that are not all 0",
                "give the direction of the rotation axis, e.g. [1, 0, 0]",
            )
            origin_ok = finite(self.origin_m, 3)
            require(origin_ok, f"{where}.origin_m", self.origin_m, "three finite numbers", "e.g. [0, 0, 0]")
            rate_ok = math.isfinite(self.rate_rad_s)
            require(rate_ok, f"{where}.rate_rad_s", self.rate_rad_s, "a finite number", "e.g. 3.0")

    @property
    def moves(self) -> bool:
        return self.kind == "rotation" and self.rate_rad_s != 0.0


@dataclass
class Part:
    """One rigid part of the boundary; grains lie inside a closed part, or on the winding side of an open one.

    Attributes:
        shape: `{kind: revolution, profile_m: [[radius, z], ...], segments}`, `{kind: cylinder, radius_m, length_m,
            axis, segments}`, `{kind: box, size_m, center_m}` or `{kind: file, path, scale}` (STL, OBJ, ...).
        points: number of boundary points the network sees.
        friction_angle_rad: wall friction angle, rad.
    """

    shape: dict[str, Any] = field(default_factory=dict)
    points: int = MISSING
    friction_angle_rad: float = MISSING
    motion: Motion = field(default_factory=Motion)

    def check(self, where: str) -> None:
        """Raises ConfigError for a value out of range; `where` is this record's key, which only the scene knows."""
        enough = "see docs/assumptions.md for a sufficient number"
        require(self.points >= 1, f"{where}.points", self.points, "at least 1", enough)
        _friction_angle(f"{where}.friction_angle_rad", self.friction_angle_rad)
        self.motion.check(f"{where}.motion")


@dataclass
class AngleOfRepose:
    """How the angle of repose is read: `plane` (surface line in the plane across `axis`; a drum) or `radial`
    (height against distance from the vertical axis; a heap), averaged over frames from `from_s` on."""

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
class Dem:
    """How Yade runs. `dt_s` is a number or `auto` (a third of the P-wave step)."""

    dt_s: Union[float, str] = "auto"
    verlet_distance_ratio: float = 0.3  # of the radius; see docs/assumptions.md
    decimals: dict[str, int] = field(default_factory=lambda: {"position": 7, "velocity": 5, "angular_velocity": 3})

    def __post_init__(self) -> None:
        _not_negative("scene.dem.verlet_distance_ratio", self.verlet_distance_ratio)
        if self.dt_s != "auto":
            require(not isinstance(self.dt_s, str), "scene.dem.dt_s", self.dt_s, "seconds or auto", "e.g. 1e-5")
            positive("scene.dem.dt_s", float(self.dt_s), "s")


@dataclass
class Scene:
    """Everything that defines a granular scene. Lengths in m, times in s, angles in rad."""

    name: str = MISSING
    duration_s: float = MISSING
    frame_dt_s: float = MISSING
    cases: int = MISSING
    seed: int = 0
    gravity_m_s2: list[float] = MISSING
    damping: float = MISSING  # Cundall's non-viscous damping, Yade's NewtonIntegrator
    damping_on_gravity: bool = True
    grains: Grains = MISSING
    initial: Initial = MISSING
    boundary: dict[str, Part] = field(default_factory=dict)
    dem: Dem = field(default_factory=Dem)
    angle_of_repose: AngleOfRepose | None = None

    def __post_init__(self) -> None:
        positive("scene.duration_s", self.duration_s, "s")
        positive("scene.frame_dt_s", self.frame_dt_s, "s")
        a_frame = self.duration_s >= self.frame_dt_s * (1 - 1e-9)
        expected = f"at least one frame, scene.frame_dt_s = {self.frame_dt_s} s"
        require(a_frame, "scene.duration_s", self.duration_s, expected, "raise it, or lower scene.frame_dt_s")
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
            part.check(f"scene.boundary.{name}")
        if self.angle_of_repose is not None:
            self.angle_of_repose.check("scene.angle_of_repose")

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
