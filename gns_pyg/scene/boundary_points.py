"""Poisson-disk points on a boundary part: evenly spread, exact in number, with normals to the grains' side."""

import heapq
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from trimesh import Trimesh

from gns_pyg.config import require
from gns_pyg.errors import GeometryError
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene

CANDIDATES_PER_POINT = 5
TESTS_PER_POINT = 20  # places of the surface that `check_density` looks at
ALPHA, BETA, GAMMA = 8, 0.65, 1.5  # Yuksel's choices: the weight's exponent and its limit at small distances

LARGEST_HOLE = 1.12  # farthest place from any point, in spacings of the densest packing; measured on all scenes


@dataclass(frozen=True)
class BoundaryPoints:
    """Points of one part in its body frame (its pose at t = 0).

    Attributes:
        pos: m, (n, 3).
        normal: unit vectors to the grains' side, (n, 3): inwards on a closed part, the winding side of an open one.
    """

    pos: np.ndarray
    normal: np.ndarray


def boundary_points(scene: Scene, cutoff_wall_radii: float) -> dict[str, BoundaryPoints]:
    """The points of every boundary part of a scene, dense enough for its smallest grains (see `check_density`)."""
    points, radius_m = {}, scene.grains.radii_m[0]
    for name, part in scene.boundary.items():
        mesh = build_mesh(name, part)
        points[name] = sample_boundary_points(mesh, part.points, scene.seed)
        check_density(name, points[name], mesh, cutoff_wall_radii * radius_m, radius_m)
    return points


def sample_boundary_points(mesh: Trimesh, n: int, seed: int = 0) -> BoundaryPoints:
    """Spreads exactly `n` points over a mesh by weighted sample elimination.

    Source: C. Yuksel, Sample elimination for generating Poisson disk sample sets, Computer Graphics Forum 34 (2015).

    Args:
        mesh: part as `build_mesh` makes it, m.
        n: number of points.
        seed: the same mesh, number and seed give the same points.

    Raises:
        ConfigError: for fewer than one point.
    """
    require(n >= 1, "scene.boundary.<part>.points", n, "at least 1", "see docs/assumptions.md for a sufficient number")
    pos, triangle = _uniform(mesh, CANDIDATES_PER_POINT * n, np.random.default_rng(seed))
    kept = _eliminate(pos, n, mesh.area)
    side = -1.0 if mesh.is_watertight else 1.0
    return BoundaryPoints(pos[kept], side * mesh.face_normals[triangle[kept]])


def sufficient_points(mesh: Trimesh, radius_m: float, cutoff_radius_m: float) -> int:
    """The number of points with which a grain that touches the wall anywhere sees at least one.

    Args:
        mesh: part, m.
        radius_m: grain radius.
        cutoff_radius_m: how far a grain's centre sees boundary points.

    Raises:
        ConfigError: if a touching grain's centre is out of reach of the point that it touches.
    """
    spacing = _reach(cutoff_radius_m, radius_m) / LARGEST_HOLE
    return int(np.ceil(2 * mesh.area / (np.sqrt(3) * spacing**2)))


def check_density(name: str, points: BoundaryPoints, mesh: Trimesh, cutoff_m: float, radius_m: float) -> None:
    """Checks that a grain that touches a part anywhere sees at least one of its points.

    The centre of a touching grain is a radius off the wall, so every place of the wall needs a point within
    sqrt(cutoff_m^2 - radius_m^2). Random places are looked at, always the same ones.

    Args:
        name: the part's key under scene.boundary; errors name it.
        points: the part's points.
        mesh: the part as `build_mesh` makes it, m.
        cutoff_m: how far a grain's centre sees boundary points.
        radius_m: grain radius.

    Raises:
        ConfigError: if a touching grain's centre is out of reach of the point that it touches.
        GeometryError: if the points are too few; says how many would do.
    """
    reach, n = _reach(cutoff_m, radius_m), len(points.pos)
    places = _uniform(mesh, max(TESTS_PER_POINT * n, 10_000), np.random.default_rng(0))[0]
    hole = cKDTree(points.pos).query(places)[0].max()
    if hole >= reach:
        enough = max(sufficient_points(mesh, radius_m, cutoff_m), int(np.ceil(n * (hole / reach) ** 2)))
        raise GeometryError(
            f"scene.boundary.{name}.points",
            f"{n} points: a place of the wall is {hole:.3g} m away from the nearest one",
            f"a point within {reach:.3g} m of every place, so that a grain that touches the wall sees it "
            f"(cutoff {cutoff_m:.3g} m, grain radius {radius_m:.3g} m); {enough} points would do",
            f"set scene.boundary.{name}.points={enough}, or raise model.cutoff_wall_radii",
        )


def _reach(cutoff_m: float, radius_m: float) -> float:
    """How far along a flat wall the centre of a grain that touches it sees, m."""
    expected = f"above the grain radius, {radius_m} m"
    require(cutoff_m > radius_m, "model.cutoff_wall_radii", f"a cutoff of {cutoff_m} m", expected, "set it above 1")
    return float(np.sqrt(cutoff_m**2 - radius_m**2))


def _uniform(mesh: Trimesh, n: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) points uniform by area, m, and the triangle of each."""
    chosen = generator.choice(len(mesh.faces), n, p=mesh.area_faces / mesh.area_faces.sum())
    weights = generator.uniform(size=(n, 2))
    beyond = weights.sum(axis=1) > 1  # the parallelogram's other half, mirrored back
    weights[beyond] = 1 - weights[beyond]
    corners = np.asarray(mesh.triangles)[chosen]
    return corners[:, 0] + np.einsum("ne,nek->nk", weights, corners[:, 1:] - corners[:, :1]), chosen


def _eliminate(pos: np.ndarray, n: int, area: float) -> np.ndarray:
    """Indices (n,) of the points that stay when the most crowded one is removed again and again."""
    largest = np.sqrt(area / (2 * np.sqrt(3) * n))  # disk radius of the densest packing of n disks
    smallest = largest * (1 - (n / len(pos)) ** GAMMA) * BETA
    pairs = cKDTree(pos).query_pairs(2 * largest, output_type="ndarray")
    apart = np.linalg.norm(pos[pairs[:, 0]] - pos[pairs[:, 1]], axis=1)
    weight_of_pair = (1 - np.clip(apart, 2 * smallest, 2 * largest) / (2 * largest)) ** ALPHA

    ends = np.concatenate([pairs, pairs[:, ::-1]])
    order = np.argsort(ends[:, 0], kind="stable")
    neighbours, pair_weights = ends[order, 1].tolist(), np.tile(weight_of_pair, 2)[order].tolist()
    first = np.searchsorted(ends[order, 0], np.arange(len(pos) + 1)).tolist()
    weight = np.bincount(ends[:, 0], np.tile(weight_of_pair, 2), minlength=len(pos)).tolist()

    alive = [True] * len(pos)
    heap = [(-value, index) for index, value in enumerate(weight)]
    heapq.heapify(heap)
    remaining = len(pos)
    while remaining > n:
        value, index = heapq.heappop(heap)
        if not alive[index] or -value != weight[index]:
            continue  # an entry from before a neighbour went; its successor is in the heap
        alive[index] = False
        remaining -= 1
        for k in range(first[index], first[index + 1]):
            other = neighbours[k]
            if alive[other]:
                weight[other] -= pair_weights[k]
                heapq.heappush(heap, (-weight[other], other))
    return np.flatnonzero(alive)
