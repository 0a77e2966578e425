"""What is simulated: a scene as typed records, checked on construction. conf/scene/*.yaml are its files.

These records are also OmegaConf schemas, hence plain containers and no unions beyond primitives.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Union

from omegaconf import MISSING

from gns_pyg.config import require, typed


def _positive(where: str, value: float, unit: str) -> None:
    require(math.isfinite(value) and value > 0, where, value, f"a finite number above 0 {unit}", f"set {where} above 0")


@dataclass
class Material:
    """Elastic-frictional contact material (Yade's FrictMat; the paper's Table 1)."""

    density_kg_m3: float = MISSING
    young_modulus_pa: float = MISSING
    poisson_ratio: float = MISSING  # Yade's FrictMat: the ratio of shear to normal stiffness
    friction_angle_rad: float = MISSING

    def __post_init__(self) -> None:
        _positive("scene.grains.material.density_kg_m3", self.density_kg_m3, "kg/m^3")
        _positive("scene.grains.material.young_modulus_pa", self.young_modulus_pa, "Pa")


@dataclass
class Grains:
    """Spheres of one radius and one material."""

    count: int = MISSING
    radius_m: float = MISSING
    material: Material = MISSING

    def __post_init__(self) -> None:
        require(self.count > 0, "scene.grains.count", self.count, "at least 1", "set it to the number of grains")
        _positive("scene.grains.radius_m", self.radius_m, "m")


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


@dataclass
class Motion:
    """Rigid motion of a boundary part. `none`, or `rotation` about the line through `origin_m` along `axis`."""

    kind: str = "none"
    axis: list[float] = field(default_factory=list)
    origin_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    rate_rad_s: float = 0.0

    def __post_init__(self) -> None:
        known = ("none", "rotation")
        require(
            self.kind in known, "scene.boundary.<part>.motion.kind", self.kind, " or ".join(known), "pick one of them"
        )
        if self.kind == "rotation":
            require(
                len(self.axis) == 3 and math.hypot(*self.axis) > 0,
                "scene.boundary.<part>.motion.axis",
                self.axis,
                "three numbers that are not all 0",
                "give the direction of the rotation axis, e.g. [1, 0, 0]",
            )

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


@dataclass
class AngleOfRepose:
    """How the angle of repose is read: `plane` (surface line in the plane across `axis`; a drum) or `radial`
    (height against distance from the vertical axis; a heap), averaged over frames from `from_s` on."""

    kind: str = MISSING
    axis: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0])
    from_s: float = MISSING


@dataclass
class Dem:
    """How Yade runs. `dt_s` is a number or `auto` (a third of the P-wave step)."""

    dt_s: Union[float, str] = "auto"
    verlet_distance_ratio: float = 0.3  # of the radius; see docs/assumptions.md
    decimals: dict[str, int] = field(default_factory=lambda: {"position": 7, "velocity": 5, "angular_velocity": 3})

    def __post_init__(self) -> None:
        if self.dt_s != "auto":
            require(not isinstance(self.dt_s, str), "scene.dem.dt_s", self.dt_s, "seconds or auto", "e.g. 1e-5")
            _positive("scene.dem.dt_s", float(self.dt_s), "s")


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
        _positive("scene.duration_s", self.duration_s, "s")
        _positive("scene.frame_dt_s", self.frame_dt_s, "s")
        require(
            0 <= self.damping < 1, "scene.damping", self.damping, "at least 0 and below 1", "0 is no damping at all"
        )
        require(
            len(self.gravity_m_s2) == 3, "scene.gravity_m_s2", self.gravity_m_s2, "three numbers", "e.g. [0, 0, -9.81]"
        )

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
