"""Triangle meshes of boundary parts: the one source for Yade's facets and for the network's boundary points."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from omegaconf import MISSING
from trimesh import Trimesh

from gns_pyg.config import CONF, require, typed
from gns_pyg.errors import GeometryError
from gns_pyg.scene.scene import Part, finite, positive

PACKAGE = Path(CONF).parent
FARTHEST_M = 1e9
SAME_PLANE = 1e-9  # of the mesh's size, and of a unit vector
BLOCK = 20_000  # point-triangle pairs handled at once: few enough to stay in the processor's cache


@dataclass
class Revolution:
    """`profile_m` ([[radius, z], ...] from the bottom up) turned about z and closed to the axis at both ends.

    Attributes:
        profile_m: two or more [radius, z].
        segments: flat pieces around the axis.
        open_bottom: leaves the lower lid out (above a scene's outlet); grains are then still on the inner side.
    """

    profile_m: list[Any] = MISSING  # pairs of numbers: OmegaConf would refuse whole ones in nested lists of floats
    segments: int = 48
    open_bottom: bool = False

    def mesh(self, where: str) -> Trimesh:
        key, remedy = f"{where}.profile_m", f"correct {where}.profile_m, e.g. [[0.1, 0], [0.1, 0.3]]"
        pairs = len(self.profile_m) >= 2 and all(
            isinstance(point, list) and finite(point, 2) for point in self.profile_m
        )
        require(pairs, key, self.profile_m, "two or more [radius, z] pairs of finite numbers", remedy)
        profile = np.array(self.profile_m, np.float64)
        radii_ok = bool((profile[:, 0] >= 0).all() and (profile[:, 0] > 0).any())
        require(radii_ok, key, self.profile_m, "radii of at least 0, not all of them 0", remedy)
        require(bool(np.ptp(profile[:, 1]) > 0), key, self.profile_m, "points at different heights z", remedy)
        require(self.segments >= 3, f"{where}.segments", self.segments, "at least 3", "e.g. 48")
        mesh = _revolve(profile, self.segments)
        if self.open_bottom:
            mesh.update_faces((mesh.triangles[:, :, 2] > profile[0, 1]).any(axis=1))
            mesh.remove_unreferenced_vertices()
            mesh.invert()
        return mesh


@dataclass
class Cylinder:
    """Closed cylinder centred at the origin.

    Attributes:
        radius_m: corners lie on it.
        length_m: between its end caps.
        axis: its direction.
        segments: flat pieces around the axis.
    """

    radius_m: float = MISSING
    length_m: float = MISSING
    axis: list[float] = field(default_factory=lambda: [0.0, 0.0, 1.0])
    segments: int = 48

    def mesh(self, where: str) -> Trimesh:
        positive(f"{where}.radius_m", self.radius_m, "m")
        positive(f"{where}.length_m", self.length_m, "m")
        axis_ok = finite(self.axis, 3) and any(self.axis)
        require(axis_ok, f"{where}.axis", self.axis, "three finite numbers that are not all 0", "e.g. [1, 0, 0]")
        require(self.segments >= 3, f"{where}.segments", self.segments, "at least 3", "e.g. 48")
        half = self.length_m / 2
        mesh = _revolve(np.array([[self.radius_m, -half], [self.radius_m, half]]), self.segments)
        return mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], self.axis))


@dataclass
class Box:
    """Closed box with its edges along x, y and z.

    Attributes:
        size_m: of its edges.
        center_m: its middle.
    """

    size_m: list[float] = MISSING
    center_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def mesh(self, where: str) -> Trimesh:
        size_ok = finite(self.size_m, 3) and min(self.size_m) > 0
        require(size_ok, f"{where}.size_m", self.size_m, "three finite lengths above 0 m", "e.g. [0.3, 0.2, 0.1]")
        center_ok = finite(self.center_m, 3)
        require(center_ok, f"{where}.center_m", self.center_m, "three finite numbers", "e.g. [0, 0, 0.05]")
        return trimesh.creation.box(self.size_m).apply_translation(self.center_m)


@dataclass
class Floor:
    """Horizontal rectangle with edges along x and y; grains are above it.

    Attributes:
        size_m: along x and y.
        center_m: its middle.
    """

    size_m: list[float] = MISSING
    center_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def mesh(self, where: str) -> Trimesh:
        size_ok = finite(self.size_m, 2) and min(self.size_m) > 0
        require(size_ok, f"{where}.size_m", self.size_m, "two finite lengths above 0 m", "e.g. [0.6, 0.6]")
        center_ok = finite(self.center_m, 3)
        require(center_ok, f"{where}.center_m", self.center_m, "three finite numbers", "e.g. [0, 0, 0]")
        corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]) * [*self.size_m, 0.0]
        return Trimesh(corners + self.center_m, [[0, 1, 2], [0, 2, 3]], process=False)


@dataclass
class File:
    """A mesh file.

    Attributes:
        path: a file that trimesh reads (STL, OBJ, PLY, ...), from where the command runs or in the package.
        scale: turns its unit into metres: 0.001 for mm.
    """

    path: str = MISSING
    scale: float = 1.0

    def mesh(self, where: str) -> Trimesh:
        path = Path(self.path).expanduser()
        own = PACKAGE / path  # e.g. conf/scene/silo.stl, wherever this runs
        path = own if own.is_file() and not path.is_file() else path
        require(path.is_file(), f"{where}.path", f"no file at {path.resolve()}", "a mesh file", "correct the path")
        scale_ok = math.isfinite(self.scale) and self.scale > 0
        require(scale_ok, f"{where}.scale", self.scale, "finite, above 0", "1 for metres, 0.001 for millimetres")
        try:
            mesh = trimesh.load_mesh(path)
        except Exception as error:  # each file format has errors of its own
            raise GeometryError(path, f"{error}", "a triangle mesh", "export it again, e.g. as binary STL") from error
        if not isinstance(mesh, Trimesh) or len(mesh.faces) == 0:
            raise GeometryError(path, "no triangles", "a triangle mesh", "export it again, e.g. as binary STL")
        mesh.merge_vertices(merge_tex=True, merge_norm=True)  # STL repeats corners; only joined ones can be closed
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh.metadata["path"] = str(path)  # so that a later error can name it
        if not mesh.is_winding_consistent:
            raise GeometryError(
                path,
                "neighbouring triangles are wound in opposite ways",
                "one side of the surface",
                "unify its normals",
            )
        return mesh.apply_scale(self.scale)


SHAPES = {"revolution": Revolution, "cylinder": Cylinder, "box": Box, "floor": Floor, "file": File}


def build_mesh(name: str, part: Part) -> Trimesh:
    """Builds the mesh of a boundary part in its body frame (its pose at t = 0), m.

    A closed mesh is wound so that its triangles' own normals point outwards. An open one keeps its winding:
    grains are on the side that its normals point to.

    Args:
        name: the part's key under scene.boundary; errors name it.
        part: its shape.

    Raises:
        ConfigError: for an unknown, missing or impossible key of the shape, or a mesh file that is not there.
        GeometryError: for a mesh file without triangles or with mixed winding.
    """
    where = f"scene.boundary.{name}.shape"
    shape = dict(part.shape)
    kind = shape.pop("kind", None)
    require(isinstance(kind, str) and kind in SHAPES, f"{where}.kind", kind, " or ".join(SHAPES), "pick one of them")
    record: Any = typed(SHAPES[kind], shape, where)
    with np.errstate(over="ignore"):  # refused below
        mesh: Trimesh = record.mesh(where)
    farthest_m, most = float(np.abs(mesh.vertices).max()), f"at most {FARTHEST_M:g} m from the origin"
    require(
        farthest_m <= FARTHEST_M, where, f"a corner {farthest_m:g} m away", most, "check its unit: lengths are in m"
    )
    if mesh.is_watertight and mesh.volume < 0:
        if kind == "file":
            raise GeometryError(
                record.path,
                f"normals that point inwards (it encloses {mesh.volume * 1e3:.3g} litres)",
                "a closed surface whose normals point outwards; grains are inside",
                "flip its normals and export it again",
            )
        mesh.invert()
    return mesh


def planes(normal: np.ndarray, pos: np.ndarray, size_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The planes through points of a mesh, each by the first of its points, (n_planes,); which each point is on, (n,).

    Args:
        normal, pos: unit vectors and places, (n, 3).
        size_m: of the mesh: offsets are compared relative to it.
    """
    offset = (normal * pos).sum(axis=1) / size_m
    rounded = np.round(np.column_stack([normal, offset]) / SAME_PLANE)
    _, first, plane = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return first, plane.ravel()


def container(name: str, part: Part) -> Trimesh | None:
    """The closed surface, m, that a part holds grains in: its mesh, with the lid that `open_bottom` left out; None
    for a part that encloses nothing (a floor).

    Raises:
        GeometryError: for a mesh file with a hole.
    """
    shape = {key: value for key, value in part.shape.items() if key != "open_bottom"}
    mesh = build_mesh(name, replace(part, shape=shape))
    if shape.get("kind") == "file":
        require_closed(mesh, f"scene.boundary.{name}")
    return mesh if mesh.is_watertight else None


def require_closed(mesh: Trimesh, where: str) -> None:
    """Raises GeometryError unless `mesh` encloses a volume; names its file and says how many edges are open."""
    if mesh.is_watertight:
        return
    file = f"{mesh.metadata['path']}: " if "path" in mesh.metadata else ""
    n_triangles_at_edge = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
    raise GeometryError(
        where,
        f"{file}{(n_triangles_at_edge == 1).sum()} open edges and {(n_triangles_at_edge > 2).sum()} edges with more "
        f"than two triangles, of {len(n_triangles_at_edge)}",
        "a closed surface, so that inside and outside are defined",
        "close the holes (e.g. mesh.fill_holes() of trimesh, or in the CAD program) and export it again; "
        "open parts made of files are not supported as containers yet",
    )


def same_mesh(stored: Mapping[str, Any], mesh: Trimesh) -> bool:
    """Whether a stored part is `mesh`: the same triangles, corner by corner, to 1 nm; the corners' numbering is free.

    Args:
        stored: a part as `Trajectory.boundary` gives it: `vertices` (n, 3), m, and `triangles` (m, 3), rows of them.
        mesh: part as `build_mesh` makes it, m.
    """
    corners = np.asarray(stored["vertices"])[np.asarray(stored["triangles"])]
    return corners.shape == mesh.triangles.shape and np.allclose(corners, mesh.triangles, rtol=0, atol=1e-9)


def inside(mesh: Trimesh, pos: np.ndarray) -> np.ndarray:
    """Tells which points a closed mesh encloses, by its winding number (the sum of signed solid angles).

    Source: A. van Oosterom, J. Strackee, The solid angle of a plane triangle, IEEE Trans. Biomed. Eng. 30 (1983).

    Args:
        mesh: closed, wound outwards, m.
        pos: points, m, (n, 3); all frames of a roll-out can be given at once.

    Returns:
        bool (n,).

    Raises:
        GeometryError: if the mesh is not closed.
    """
    require_closed(mesh, "containment test")
    pos = np.asarray(pos, np.float64).reshape(-1, 3)
    result = np.zeros(len(pos), bool)
    candidates = np.flatnonzero(((pos >= mesh.bounds[0]) & (pos <= mesh.bounds[1])).all(axis=1))
    rows = max(1, BLOCK // len(mesh.faces))
    for start in range(0, len(candidates), rows):
        block = candidates[start : start + rows]
        result[block] = _winding_number(mesh, pos[block]) > 0.5
    return result


def distance(mesh: Trimesh, pos: np.ndarray) -> np.ndarray:
    """Distance of points (n, 3) from the surface (its nearest triangle), m, (n,); always at least 0."""
    pos = np.asarray(pos, np.float64).reshape(-1, 3)
    rows = max(1, BLOCK // len(mesh.edges_unique))
    blocks = [_distance_block(mesh, pos[start : start + rows]) for start in range(0, len(pos), rows)]
    return np.concatenate(blocks) if blocks else np.zeros(0)


def _winding_number(mesh: Trimesh, pos: np.ndarray) -> np.ndarray:
    """(n,) winding numbers; rows are corners or triangles, so that a triangle's corners are picked as whole rows."""
    corners = [mesh.triangles[:, k] for k in range(3)]
    a, b, c = corners
    squared = ((mesh.vertices[:, None] - pos) ** 2).sum(axis=2)  # (n_vertices, n)
    length = np.sqrt(squared)
    squares = [squared[mesh.faces[:, k]] for k in range(3)]
    lengths = [length[mesh.faces[:, k]] for k in range(3)]
    denominator = lengths[0] * lengths[1] * lengths[2]
    for p, q, r in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # dot product of two arms from the law of cosines
        side = ((corners[p] - corners[q]) ** 2).sum(axis=1)[:, None]
        denominator += (squares[p] + squares[q] - side) / 2 * lengths[r]
    area_vector = np.cross(b - a, c - a)
    triple_product = (area_vector * a).sum(axis=1)[:, None] - area_vector @ pos.T
    return np.arctan2(triple_product, denominator).sum(axis=0) / (2 * np.pi)


def _distance_block(mesh: Trimesh, pos: np.ndarray) -> np.ndarray:
    """Nearest of all edges, or of a triangle's plane where the point projects into the triangle."""
    start, end = mesh.vertices[mesh.edges_unique[:, 0]], mesh.vertices[mesh.edges_unique[:, 1]]
    along = end - start
    fraction = (pos @ along.T - (start * along).sum(axis=1)) / (along**2).sum(axis=1)
    fraction = np.clip(fraction, 0.0, 1.0)
    squared = np.zeros_like(fraction)
    for k in range(3):  # (n, n_edges) at a time instead of (n, n_edges, 3)
        squared += (pos[:, k, None] - start[:, k] - fraction * along[:, k]) ** 2
    nearest = np.sqrt(squared.min(axis=1))

    normals, corners = mesh.face_normals, mesh.triangles
    over_triangle = np.ones((len(pos), len(normals)), bool)
    for k in range(3):
        inwards = np.cross(normals, corners[:, (k + 1) % 3] - corners[:, k])
        over_triangle &= pos @ inwards.T >= (inwards * corners[:, k]).sum(axis=1)
    height = np.abs(pos @ normals.T - (normals * corners[:, 0]).sum(axis=1))
    return np.minimum(nearest, np.where(over_triangle, height, np.inf).min(axis=1))


def _revolve(profile: np.ndarray, segments: int) -> Trimesh:
    """Closed surface of revolution about z from (n, 2) radius and z, bottom up; corners lie on the radius."""
    bottom, top = [0.0, profile[0, 1]], [0.0, profile[-1, 1]]
    rows = np.vstack([bottom, profile[profile[:, 0] > 0], top])  # a point on the axis is the cap's centre anyway
    angle = 2 * np.pi * np.arange(segments) / segments
    radius, z = rows[:, :1], np.repeat(rows[:, 1:], segments, axis=1)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=2).reshape(-1, 3)
    this = np.arange(segments)
    following = (this + 1) % segments
    triangles = []
    for row in range(len(rows) - 1):
        lower, upper = row * segments, (row + 1) * segments
        triangles.append(np.stack([lower + this, lower + following, upper + following], axis=1))
        triangles.append(np.stack([lower + this, upper + following, upper + this], axis=1))
    mesh = Trimesh(vertices, np.concatenate(triangles), process=False)
    mesh.merge_vertices()  # the rings of radius 0 become single corners
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    return mesh
