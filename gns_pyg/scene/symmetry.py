"""The symmetry that a scene really has: turns about gravity's direction, and reflection in vertical planes."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor
from trimesh import Trimesh

from gns_pyg.scene.inlet import entries
from gns_pyg.scene.mesh import build_mesh, distance
from gns_pyg.scene.scene import Scene

TOLERANCE = 1e-6  # of a scene's size
MOST_FOLD = 128
MIRROR_ANGLES = 360  # candidates where no corner of the scene gives any


@dataclass(frozen=True)
class Symmetry:
    """A group of maps x -> Q (x - center) + center that leave a scene as it is.

    Attributes:
        fold: it holds turns about the axis by multiples of 2 pi / fold; 0 is any angle, 1 none.
        mirror: unit normal of a vertical plane through the axis that it is reflected in, or None.
        axis: unit vector against gravity; +z where there is none.
        center_m: a point of the axis, m.
    """

    fold: int
    mirror: list[float] | None
    axis: list[float]
    center_m: list[float]

    @property
    def trivial(self) -> bool:
        return self.fold == 1 and self.mirror is None

    def draw(self, n: int, generator: torch.Generator) -> Float[Tensor, "n 3 3"]:
        """Orthogonal matrices Q drawn from the group, each element as likely as any other, float64."""
        part = torch.rand(n, dtype=torch.float64, generator=generator)
        angle = 2 * math.pi * (part if self.fold == 0 else torch.floor(part * self.fold) / self.fold)
        drawn = torch.stack([torch.from_numpy(_turn(np.array(self.axis), float(a))) for a in angle])
        if self.mirror is not None:
            reflected = torch.rand(n, dtype=torch.float64, generator=generator) < 0.5
            drawn[reflected] = drawn[reflected] @ torch.from_numpy(_reflection(np.array(self.mirror)))
        return drawn

    def describe(self) -> str:
        """In words, e.g. `rotation about the vertical by multiples of 11.25 degrees, reflection`."""
        words = []
        if self.fold != 1:
            by = "any angle" if self.fold == 0 else f"multiples of {360 / self.fold:g} degrees"
            words.append(f"rotation about the vertical by {by}")
        if self.mirror is not None:
            along = ", ".join(f"{x:.3g}" for x in self.mirror)
            words.append("reflection" if words else f"reflection along ({along})")
        return ", ".join(words) or "none"


def symmetry(scene: Scene) -> Symmetry:
    """Finds a scene's symmetry by trying maps on its boundary, motions, outlet, inlet and initial region.

    Only vertices that match and triangles that lie on the surface count, so that a mesh whose flat faces are divided
    unevenly may have more symmetry than is found here. Cundall's damping acts along x, y and z one by one, so that with
    it only maps that exchange these axes are left.

    Raises:
        ConfigError, GeometryError: for a boundary part that cannot be built.
    """
    fixed = _Fixed(scene)
    up = fixed.up
    fold = 0
    if not fixed.under(_turn(up, 1.0)):
        folds = range(MOST_FOLD, 1, -1)
        fold = next((n for n in folds if fixed.under(_turn(up, 2 * math.pi / n))), 1)
    mirror = next((n.tolist() for n in fixed.mirrors() if fixed.under(_reflection(n))), None)
    return Symmetry(fold, mirror, up.tolist(), fixed.center.tolist())


def up_direction(scene: Scene) -> np.ndarray:
    """Unit vector against gravity, (3,); +z where there is no gravity."""
    gravity = np.asarray(scene.gravity_m_s2, np.float64)
    strength = np.linalg.norm(gravity)
    return 0.0 - gravity / strength if strength > 0 else np.array([0.0, 0.0, 1.0])


class _Fixed:
    """What a symmetry must map onto itself.

    Attributes:
        up: unit vector against gravity.
        by_axis: damping tells x, y and z from other directions.
        center: a point that every axis and mirror plane must pass through, m.
        points: sets of points, each (n, 3), m.
        vectors: unit vectors and velocities.
        turns: (unit vector along the axis, a point of it) of every turning part.
    """

    def __init__(self, scene: Scene) -> None:
        self.up, self.meshes, z = up_direction(scene), [], np.array([0.0, 0.0, 1.0])
        self.by_axis = scene.damping > 0 or "damping" in scene.vary
        self.points: list[np.ndarray] = []
        self.vectors: list[np.ndarray] = []
        self.turns: list[tuple[np.ndarray, np.ndarray]] = []
        for name, part in scene.boundary.items():
            self.meshes.append(build_mesh(name, part))
            self.points.append(np.array(self.meshes[-1].vertices))
            if not part.motion.moves:
                continue
            axis = np.array(part.motion.axis, np.float64) / np.linalg.norm(part.motion.axis)
            if part.motion.kind == "rotation":
                self.turns.append((axis, np.array(part.motion.origin_m, np.float64)))
            else:
                self.vectors.append(axis)
        if (inlet := scene.inlet) is not None:
            self.points.append(entries(scene).pos)  # the plan is one of many, and has no symmetry of its own
            self.vectors.append(np.array(inlet.velocity_m_s, np.float64))
        initial = scene.initial
        if initial.region_m:
            self.points.append(_corners(*np.array(initial.region_m, np.float64)))
        if initial.z_min_m is not None or initial.z_max_m is not None:
            self.vectors.append(z)
        self.outlet = None
        if scene.outlet is not None:
            normal = np.array(scene.outlet.normal, np.float64) / np.linalg.norm(scene.outlet.normal)
            self.outlet = (normal, np.array(scene.outlet.point_m, np.float64))
            self.vectors.append(normal)
        self.center = np.zeros(3)
        if self.meshes:
            self.center = np.array(self.meshes[0].centroid)  # of its area: the same however faces are divided
        elif self.points:
            self.center = self.points[0].mean(axis=0)
        elif self.outlet is not None:
            self.center = self.outlet[1]
        reach = [np.linalg.norm(p - self.center, axis=1).max() for p in self.points]
        self.error_m = TOLERANCE * max(reach, default=1.0)

    def under(self, q: np.ndarray) -> bool:
        """Whether everything stays as it is under x -> q (x - center) + center."""
        return (
            not (self.by_axis and np.abs(q - q.round()).max() > TOLERANCE)
            and all(np.allclose(q @ v, v, rtol=0, atol=TOLERANCE * np.linalg.norm(v)) for v in self.vectors)
            and all(self._turns_alike(q, axis, origin) for axis, origin in self.turns)
            and (self.outlet is None or self._same_plane(q, *self.outlet))
            and all(self._same_set(q, points) for points in self.points)
            and all(self._same_surface(q, mesh) for mesh in self.meshes)
        )

    def mirrors(self) -> Iterator[np.ndarray]:
        """Candidates for a mirror plane's unit normal: horizontal; plain directions first."""
        east = np.eye(3)[0] if abs(self.up[0]) < 0.9 else np.eye(3)[1]
        east = east - (east @ self.up) * self.up
        east /= np.linalg.norm(east)
        north = np.cross(self.up, east)
        yield from (east, north)
        if not self.points:
            for angle in math.pi * np.arange(MIRROR_ANGLES) / MIRROR_ANGLES:
                yield math.cos(angle) * east + math.sin(angle) * north
            return
        arm = self.points[0] - self.center
        height = arm @ self.up
        level = arm - np.outer(height, self.up)
        radius = np.linalg.norm(level, axis=1)
        corner = radius.argmax()  # it lies on the mirror plane, or its image is another one
        alike = np.maximum(abs(radius - radius[corner]), abs(height - height[corner])) < self.error_m
        normals = np.vstack([np.cross(self.up, level[corner]), level[alike] - level[corner]])
        length = np.linalg.norm(normals, axis=1)
        yield from normals[length > self.error_m] / length[length > self.error_m, None]

    def _map(self, q: np.ndarray, points: np.ndarray) -> np.ndarray:
        return (points - self.center) @ q.T + self.center

    def _turns_alike(self, q: np.ndarray, axis: np.ndarray, origin: np.ndarray) -> bool:
        """The axis of a turn is an axial vector: a reflection across it reverses it, one along it does not."""
        same = np.allclose(np.linalg.det(q) * q @ axis, axis, rtol=0, atol=TOLERANCE)
        return bool(same and np.linalg.norm(np.cross(self._map(q, origin) - origin, axis)) < self.error_m)

    def _same_plane(self, q: np.ndarray, normal: np.ndarray, point: np.ndarray) -> bool:
        return bool(abs(normal @ (self._map(q, point) - point)) < self.error_m)

    def _same_set(self, q: np.ndarray, points: np.ndarray) -> bool:
        return bool((cKDTree(points).query(self._map(q, points))[0] < self.error_m).all())

    def _same_surface(self, q: np.ndarray, mesh: Trimesh) -> bool:
        """Flat faces may be divided along other diagonals; an open surface must keep its grains' side too."""
        area = (mesh.face_normals * mesh.area_faces[:, None]).sum(axis=0)
        if not np.allclose(q @ area, area, rtol=0, atol=TOLERANCE * mesh.area):
            return False
        centers = self._map(q, mesh.triangles_center)
        others = centers[cKDTree(mesh.triangles_center).query(centers)[0] > self.error_m]
        return bool((distance(mesh, others) < self.error_m).all())


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _reflection(normal: np.ndarray) -> np.ndarray:
    return np.eye(3) - 2 * np.outer(normal, normal)
