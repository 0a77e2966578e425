"""How grains start: positions and velocities from one random generator, seeded by (scene.seed, case)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh import Trimesh

from gns_pyg.errors import GeometryError
from gns_pyg.scene.inlet import entries
from gns_pyg.scene.mesh import container, distance, inside
from gns_pyg.scene.scene import Scene

LATTICE_SPACING = 1.002  # of the diameter: touching spheres would start with rounding-error overlaps


@dataclass(frozen=True)
class Start:
    """The state that a DEM run starts from.

    Attributes:
        pos: grain centres, m, (n_grains, 3).
        vel: m/s, (n_grains, 3).
        ang_vel: rad/s, (n_grains, 3).
        radius: m, (n_grains,).
        active: who is there, bool (n_grains,).
        time_s: scene time; moving walls start in their pose at this time.
    """

    pos: np.ndarray
    vel: np.ndarray
    ang_vel: np.ndarray
    radius: np.ndarray
    active: np.ndarray
    time_s: float = 0.0


def initial_state(scene: Scene, meshes: Mapping[str, Trimesh], case: int) -> Start:
    """Draws the start of a case; grains do not spin. Those that enter later wait where they will enter.

    Args:
        scene: arrangement, number of grains, radii, speed.
        meshes: mesh of every boundary part; grains lie inside every part that encloses them and clear of all parts.
        case: number of the case; (scene.seed, case) fixes every random choice.

    Raises:
        GeometryError: if nothing says where grains lie, or they do not fit.
    """
    generator = np.random.default_rng((scene.seed, case))
    later = entries(scene)
    radius = np.concatenate([np.full(n, radius_m) for radius_m, n in scene.grains.counts])
    if len(scene.grains.radii_m) > 1:
        radius = generator.permutation(radius)
    n = scene.grains.count - len(later.pos)
    arrange = {"random": _random, "dense": _dense}[scene.initial.arrangement]
    pos = arrange(scene, meshes, radius[:n], generator) if n else np.zeros((0, 3))
    speed = scene.initial.speed_max_m_s
    vel = np.concatenate([generator.uniform(-speed, speed, pos.shape), np.zeros_like(later.pos)])
    pos = np.concatenate([pos, later.pos])
    return Start(pos, vel, np.zeros_like(pos), radius, np.arange(len(pos)) < n)


def _random(
    scene: Scene, meshes: Mapping[str, Trimesh], radius: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """Random sequential addition: uniform candidates, kept one after the other where they overlap nothing."""
    n, diameter = len(radius), 2 * scene.grains.radii_m[-1]
    lower, upper = _bounds(scene, meshes)
    cells: dict[tuple[int, ...], list[int]] = {}  # grains by cell of one diameter: only neighbours can touch
    offsets = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    kept: list[np.ndarray] = []
    n_before = -n
    while len(kept) < n and len(kept) - n_before > n / 1000:  # random addition saturates, near a fraction of 0.38
        n_before = len(kept)
        candidates = generator.uniform(lower, upper, (max(n, 1000), 3))
        for candidate in candidates[_allowed(scene, meshes, candidates)]:
            cell = np.floor(candidate / diameter).astype(int)
            near = [other for key in map(tuple, cell + offsets) for other in cells.get(key, ())]
            reach = radius[near] + radius[len(kept)]
            if near and (((np.array([kept[k] for k in near]) - candidate) ** 2).sum(axis=1) < reach**2).any():
                continue
            cells.setdefault(tuple(cell), []).append(len(kept))
            kept.append(candidate)
            if len(kept) == n:
                break
    if len(kept) < n:
        raise _does_not_fit(scene, f"no room for more than {len(kept)} of {n} grains placed at random")
    return np.array(kept).reshape(n, 3)


def _dense(
    scene: Scene, meshes: Mapping[str, Trimesh], radius: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """The sites of a randomly turned and shifted face-centred cubic lattice nearest to a random allowed point."""
    n, spacing = len(radius), LATTICE_SPACING * 2 * scene.grains.radii_m[-1]
    lower, upper = _bounds(scene, meshes)
    centre, reach = (lower + upper) / 2, np.linalg.norm(upper - lower) / 2
    vectors = spacing / np.sqrt(2) * np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]])
    vectors = Rotation.random(random_state=generator).apply(vectors)
    # A lattice coordinate is a product with a reciprocal vector, so it varies by at most |reciprocal| * reach.
    steps = np.ceil(np.linalg.norm(np.linalg.inv(vectors), axis=0) * reach).astype(int) + 1
    sites = np.stack(np.meshgrid(*[np.arange(-k, k + 1) for k in steps], indexing="ij"), axis=-1).reshape(-1, 3)
    sites = centre + (sites + generator.uniform(0, 1, 3)) @ vectors
    sites = sites[((sites >= lower) & (sites <= upper)).all(axis=1)]
    sites = sites[_allowed(scene, meshes, sites)]
    if len(sites) < n:
        raise _does_not_fit(scene, f"a close-packed lattice has {len(sites)} sites in the region for {n} grains")
    anchor = sites[generator.integers(len(sites))]
    return sites[np.atleast_1d(cKDTree(sites).query(anchor, k=n)[1])]


def _bounds(scene: Scene, meshes: Mapping[str, Trimesh]) -> tuple[np.ndarray, np.ndarray]:
    """Box (lower, upper), m, that holds all grain centres."""
    radius_m = scene.grains.radii_m[-1]
    boxes = [mesh.bounds + np.array([[radius_m], [-radius_m]]) for mesh in _containers(scene)]
    if scene.initial.region_m:
        boxes.append(np.array(scene.initial.region_m, np.float64))
    if not boxes:
        found = ", ".join(meshes) or "no part"
        raise GeometryError(
            "scene.initial.region_m",
            f"not set, and nothing encloses the grains (scene.boundary: {found})",
            "a box for the grains to start in, or a closed part",
            "e.g. region_m: [[-0.1, -0.1, 0], [0.1, 0.1, 0.3]]; a mesh file must have no hole",
        )
    lower, upper = np.max([box[0] for box in boxes], axis=0), np.min([box[1] for box in boxes], axis=0)
    if scene.initial.z_min_m is not None:
        lower[2] = max(lower[2], scene.initial.z_min_m)
    if scene.initial.z_max_m is not None:
        upper[2] = min(upper[2], scene.initial.z_max_m)
    if (lower >= upper).any():
        raise _does_not_fit(scene, f"the region for grain centres is empty (from {lower} to {upper} m)")
    return lower, upper


def _allowed(scene: Scene, meshes: Mapping[str, Trimesh], pos: np.ndarray) -> np.ndarray:
    """Which centres lie inside every part that encloses grains, on the inner side of the outlet, and (the largest)
    radius clear of every wall, bool (n,)."""
    allowed = np.ones(len(pos), bool)
    if scene.outlet is not None:
        allowed = (pos - scene.outlet.point_m) @ scene.outlet.normal <= 0
    for mesh in _containers(scene):
        allowed[allowed] = inside(mesh, pos[allowed])
    for mesh in meshes.values():
        allowed[allowed] = distance(mesh, pos[allowed]) >= scene.grains.radii_m[-1]
    return allowed


def _containers(scene: Scene) -> list[Trimesh]:
    """What encloses the grains."""
    return [mesh for name, part in scene.boundary.items() if (mesh := container(name, part)) is not None]


def _does_not_fit(scene: Scene, found: str) -> GeometryError:
    return GeometryError(
        f"scene.initial of {scene.name}",
        found,
        "room for all grains without overlap",
        "lower scene.grains.count or scene.grains.radius_m, widen scene.initial.z_min_m/z_max_m/region_m, "
        "or set scene.initial.arrangement=dense",
    )
