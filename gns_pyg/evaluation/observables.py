"""What an engineer reads from a granular run: functions of positions alone, so that DEM and network are read alike.

Positions `pos` are grain centres, m, (n_frames, n_grains, 3) float64, nan where a grain is absent; times `times_s`
are (n_frames,) s.
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gns_pyg.config import require
from gns_pyg.errors import ConfigError
from gns_pyg.evaluation.errors import mean_present, present
from gns_pyg.scene.containment import outside
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene
from gns_pyg.scene.symmetry import up_direction

CELL_DIAMETERS = 1.5  # edge of the surface's cells; 1 to 2 read the same angle, 1.5 with the least scatter
DRUM_GAP_DIAMETERS = 1.25  # grains nearer than this belong together (a flowing bed is loose): the paper's 2.5 radii
HEAP_GAP_DIAMETERS = 1.05  # a heap's grains touch; a jet that falls onto it is dense enough for the drum's gap
CENTRAL_SHARE = 0.75  # of the bed's width across the drum; the surface bends towards the mantle beyond it


def center_of_mass(pos: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Centre of mass of all grains that are present (escaped ones too), per frame.

    Args:
        pos: m, (n_frames, n_grains, 3).
        mass: kg, (n_grains,).

    Returns:
        (n_frames, 3), m; nan where there is no grain.
    """
    there = present(pos)
    moment = np.einsum("fgi,g->fi", np.where(there[:, :, None], pos, 0.0), mass)
    with np.errstate(invalid="ignore"):
        return moment / np.where(there, mass, 0.0).sum(axis=1)[:, None]


def outflow(pos: np.ndarray) -> np.ndarray:
    """The part of the grains present at the start that have left, per frame, (n_frames,)."""
    there = present(pos)
    with np.errstate(invalid="ignore"):
        return (there[0] & ~there).sum(axis=1) / there[0].sum()


# ---------------------------------------------------------------------------------------------- angle of repose


def angle_of_repose(pos: np.ndarray, scene: Scene) -> np.ndarray:
    """Angle of the bed's free surface against the horizontal, per frame.

    Only grains of the bed count, so that those in flight, in a jet or outside do not pose as surface: the largest
    cluster of grains nearer to each other than 1.25 diameters (a drum) or 1.05 (a heap). The horizontal plane is
    divided into square cells of 1.5 grain diameters, the highest grain of each cell is the surface (the radius that
    lies between its centre and its top is the same everywhere and leaves the slope as it is), and a least-squares line
    through the heights of these grains gives the angle. Cells of equal area matter: the highest of many grains is
    higher than the highest of few, so that whole annuli of a heap, which grow outwards, would read several degrees too
    flat.

    `plane` (a drum): height against the horizontal coordinate across the axis; the middle half of the bed's grains
    along the axis and the central 75 % of the bed's width are read (away from end caps and mantle); unsigned.
    `radial` (a heap): height against distance from the vertical axis through the middle of the boundary; positive
    where the heap is highest in the middle, negative for a crater.

    Args:
        pos: m, (n_frames, n_grains, 3).
        scene: gives `angle_of_repose`, gravity and the (largest) grain radius.

    Returns:
        (n_frames,), degrees; nan where the surface's grains span less than two cells.

    Raises:
        ConfigError: if the scene defines no angle of repose, of an unknown kind, or an axis along gravity.
    """
    definition = scene.angle_of_repose
    if definition is None:
        raise ConfigError(
            "scene.angle_of_repose", "not defined", "a kind (plane or radial) and from_s", "define it in the scene"
        )
    if definition.kind == "plane":
        return np.array([np.degrees(np.arctan(abs(surface_slope(frame[present(frame)], scene)))) for frame in pos])
    if definition.kind == "radial":
        radius, middle, up = scene.grains.radii_m[-1], _boundary_middle(scene), up_direction(scene)
        beds = (_bed(frame[present(frame)], HEAP_GAP_DIAMETERS * 2 * radius) for frame in pos)
        return np.array([_radial_angle(bed, middle, up, radius) for bed in beds])
    raise ConfigError("scene.angle_of_repose.kind", definition.kind, "plane or radial", "pick one of them")


def mean_angle_of_repose(pos: np.ndarray, times_s: np.ndarray, scene: Scene) -> tuple[float, float]:
    """Angle of repose averaged over the frames from `scene.angle_of_repose.from_s` on.

    Returns:
        (mean, standard error), degrees; the error allows for correlation in time, see `time_mean`.
    """
    steady = pos[from_frame(times_s, scene) :]
    return time_mean(angle_of_repose(steady, scene))


def from_frame(times_s: np.ndarray, scene: Scene) -> int:
    """Index of the first frame that the angle of repose is averaged over (n_frames if the run ends before)."""
    start = 0.0 if scene.angle_of_repose is None else scene.angle_of_repose.from_s
    return int(np.searchsorted(times_s, start - 1e-9))


def time_mean(values: np.ndarray) -> tuple[float, float]:
    """Mean of a correlated series and its standard error by block averaging (Flyvbjerg and Petersen 1989).

    The standard error of block means grows with the block length until blocks are independent; the largest value
    over block lengths 1, 2, 4, ... with at least four blocks is taken. Frames that are nan are left out.

    Args:
        values: (n,).

    Returns:
        (mean, standard error); nan where there are no values, or fewer than two for the error.
    """
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return float("nan"), float("nan")
    errors, length = [], 1
    while len(values) // length >= (4 if length > 1 else 2):
        n_blocks = len(values) // length
        blocks = values[: n_blocks * length].reshape(n_blocks, length).mean(axis=1)
        errors.append(blocks.std(ddof=1) / np.sqrt(n_blocks))
        length *= 2
    return float(values.mean()), float(max(errors, default=float("nan")))


def drum_axes(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors of a scene whose angle of repose is `plane`: along the axis, across it, up. Each (3,).

    Raises:
        ConfigError: for another kind, or an axis along gravity.
    """
    definition, up = scene.angle_of_repose, up_direction(scene)
    plane = definition is not None and definition.kind == "plane"
    found = "not defined" if definition is None else definition.kind
    require(plane, "scene.angle_of_repose.kind", found, "plane", "define it in the scene")
    assert definition is not None
    axis = np.asarray(definition.axis, np.float64)
    across = np.cross(up, axis)
    upright = np.linalg.norm(across) > 1e-6 * np.linalg.norm(axis)
    expected = "an axis that is not along gravity"
    require(bool(upright), "scene.angle_of_repose.axis", definition.axis, expected, "turn the axis")
    return axis / np.linalg.norm(axis), across / np.linalg.norm(across), up


def surface_slope(pos: np.ndarray, scene: Scene) -> float:
    """Slope of a drum's free surface in one frame (n, 3): height over the way across the axis, signed; as
    `angle_of_repose` reads it. nan where the surface's grains span less than two cells."""
    (axis, across, up), radius = drum_axes(scene), scene.grains.radii_m[-1]
    bed = _bed(pos, DRUM_GAP_DIAMETERS * 2 * radius)
    if len(bed) == 0:
        return float("nan")
    slab = bed[mid_length(bed, axis)]
    coordinate = slab @ across
    middle, half = (coordinate.min() + coordinate.max()) / 2, CENTRAL_SHARE * np.ptp(coordinate) / 2
    central = slab[np.abs(coordinate - middle) <= half]
    tops = central[_surface(central @ across, central @ axis, central @ up, radius)]
    return _slope(tops @ across, tops @ up, radius)


def mid_length(pos: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Which grains (n, 3) are the middle half along the axis, away from end caps, bool (n,)."""
    along = pos @ axis
    low, high = np.quantile(along, [0.25, 0.75])
    return (along >= low) & (along <= high)


def _bed(pos: np.ndarray, gap_m: float) -> np.ndarray:
    """Grains (n, 3) of the largest cluster of one frame (n_grains, 3): each is nearer than `gap_m` to another."""
    if len(pos) == 0:
        return pos
    pairs = cKDTree(pos).query_pairs(gap_m, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(pos), len(pos)))
    label = connected_components(links, directed=False)[1]
    return pos[label == np.bincount(label).argmax()]


def _radial_angle(bed: np.ndarray, middle: np.ndarray, up: np.ndarray, radius: float) -> float:
    if len(bed) == 0:
        return float("nan")
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    east /= np.linalg.norm(east)
    x, y, height = (bed - middle) @ east, (bed - middle) @ np.cross(up, east), (bed - middle) @ up
    top = _surface(x, y, height, radius)
    return float(np.degrees(np.arctan(-_slope(np.hypot(x, y)[top], height[top], radius))))


def _surface(x: np.ndarray, y: np.ndarray, height: np.ndarray, radius: float) -> np.ndarray:
    """Indices of the highest grain of each cell of the horizontal plane (x, y)."""
    cells = np.floor(np.stack([x, y], axis=1) / (CELL_DIAMETERS * 2 * radius))
    cell = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.lexsort((height, cell))
    return order[np.append(np.diff(cell[order]) > 0, True)[: len(order)]]


def _slope(coordinate: np.ndarray, height: np.ndarray, radius: float) -> float:
    """Slope of the least-squares line; nan where the points span too little to tell."""
    if len(coordinate) < 3 or np.ptp(coordinate) < 2 * CELL_DIAMETERS * 2 * radius:
        return float("nan")
    return float(np.polyfit(coordinate, height, 1)[0])


def _boundary_middle(scene: Scene) -> np.ndarray:
    """Middle of the box around all boundary parts, (3,), m; the origin where there is no boundary."""
    if not scene.boundary:
        return np.zeros(3)
    corners = np.concatenate([build_mesh(name, part).bounds for name, part in scene.boundary.items()])
    return 0.5 * (corners.min(axis=0) + corners.max(axis=0))


def escaped_grains(pos: np.ndarray, times_s: np.ndarray, scene: Scene) -> np.ndarray:
    """Number of grains outside the boundary (see `scene.containment.outside`), per frame, (n_frames,) int; one that
    has left through the outlet is absent, not outside."""
    return (outside(pos, times_s, scene) & present(pos)).sum(axis=1)


# -------------------------------------------------------------------------------------------------- velocities


def finite_difference_velocity(pos: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Displacement to the next frame over the time between, m/s, (n_frames - 1, n_grains, 3); nan where a grain is
    absent in one of the two."""
    return np.diff(pos, axis=0) / np.diff(times_s)[:, None, None]


def mean_speed(pos: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Mean over grains of the finite-difference speed, m/s, (n_frames - 1,): DEM and network read alike, unlike the
    DEM's instantaneous velocity, which a difference over one frame smooths."""
    return mean_present(np.linalg.norm(finite_difference_velocity(pos, times_s), axis=2), axis=1)


def granular_temperature(pos: np.ndarray, times_s: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """One third of the mean squared velocity fluctuation, <|v - v_local|^2> / 3, per frame.

    v is the finite-difference velocity and v_local its mean over the grain itself and all grains whose centre lies
    within three (largest) radii of its own; a grain alone contributes 0. Grains count that are present in the frame
    and the next.

    Args:
        pos: m, (n_frames, n_grains, 3).
        radius: m, (n_grains,).

    Returns:
        (n_frames - 1,), m^2/s^2; nan where there is no grain.
    """
    velocity = finite_difference_velocity(pos, times_s)
    temperature = np.full(len(velocity), np.nan)
    for index, there in enumerate(present(velocity)):
        if not there.any():
            continue
        at, vel = pos[index, there], velocity[index, there]
        pairs = cKDTree(at).query_pairs(3 * radius.max(), output_type="ndarray")
        total, count = vel.copy(), np.ones(len(at))
        for this, other in (pairs.T, pairs.T[::-1]):
            np.add.at(total, this, vel[other])
            count += np.bincount(this, minlength=len(at))
        temperature[index] = ((vel - total / count[:, None]) ** 2).sum(axis=1).mean() / 3
    return temperature
