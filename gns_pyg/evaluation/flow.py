"""How a scene flows: discharge through a mouth, the profile of a flowing layer, mixing. Functions of positions alone.

Positions `pos` are grain centres, m, (n_frames, n_grains, 3) float64, nan where a grain is absent; times `times_s`
are (n_frames,) s, `mass` (n_grains,) kg.
"""

import numpy as np

from gns_pyg.config import require
from gns_pyg.evaluation.errors import present
from gns_pyg.evaluation.observables import drum_axes, finite_difference_velocity, mid_length, surface_slope
from gns_pyg.scene.scene import Scene
from gns_pyg.scene.symmetry import up_direction

BULK = (0.2, 0.8)  # of the discharged mass: the rate between is steady (Beverloo), before and after it is not
EMPTIED = 0.99  # part of the mass that has passed when a hopper counts as empty
LAYER_DIAMETERS = 12  # depth of the velocity profile, in bins of one diameter
CELL_DIAMETERS = 4.0  # edge of a cell of the mixing index: about 40 grains of a dense bed
LEAST_IN_CELL = 5  # cells with fewer grains say nothing of a mixture


def discharged(pos: np.ndarray, mass: np.ndarray, scene: Scene) -> np.ndarray:
    """Part of the mass that has passed the mouth, per frame, (n_frames,): what lies below `scene.mouth_height_m` or
    has left.

    Raises:
        ConfigError: if the scene has no mouth.
    """
    mouth = scene.mouth_height_m
    require(mouth is not None, "scene.mouth_height_m", "null", "the height of the mouth, m", "define it in the scene")
    there = present(pos)
    left = ~there & np.logical_or.accumulate(there, axis=0)
    below = there & (pos @ up_direction(scene) < mouth)
    return ((below | left) * mass).sum(axis=1) / mass.sum()


def discharge_rate(part: np.ndarray, mass: np.ndarray, times_s: np.ndarray) -> float:
    """Mass flow through the mouth, kg/s: the least-squares slope of the discharged mass while its `part` (`discharged`)
    is between 20 and 80 per cent, where the flow of a hopper is steady (Beverloo, Leniger and van de Velde 1961); nan
    if fewer than three frames are there."""
    bulk = (part >= BULK[0]) & (part <= BULK[1])
    if bulk.sum() < 3:
        return float("nan")
    return float(np.polyfit(times_s[bulk], part[bulk], 1)[0] * mass.sum())


def emptying_time(part: np.ndarray, times_s: np.ndarray) -> float:
    """When 99 per cent of the mass have passed the mouth, s (linear between frames); nan if that does not happen.
    `part` is what has passed, per frame (`discharged`)."""
    late = np.flatnonzero(part >= EMPTIED)
    if len(late) == 0:
        return float("nan")
    k = late[0]
    if k == 0:
        return float(times_s[0])
    return float(np.interp(EMPTIED, part[k - 1 : k + 1], times_s[k - 1 : k + 1]))


def velocity_profile(pos: np.ndarray, times_s: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Mean velocity down the slope against depth below the free surface, in the middle of a drum's bed.

    Grains count that are in the middle half of the bed along the axis and within two diameters of its middle across.
    Depth is measured along the normal of the frame's surface (`surface_slope`), from the outermost of these grains;
    velocity is the finite difference to the next frame, its component down the slope.

    Returns:
        depth of the middle of each bin of one diameter, m, (12,); velocity, m/s, (12,), nan where no grain was.
    """
    axis, across, up = drum_axes(scene)
    diameter = 2 * scene.grains.radii_m[-1]
    edges = np.arange(LAYER_DIAMETERS + 1) * diameter
    total, count = np.zeros((2, LAYER_DIAMETERS))
    for frame, velocity in zip(pos[:-1], finite_difference_velocity(pos, times_s), strict=True):
        there = present(velocity)
        at, vel, slope = frame[there], velocity[there], surface_slope(frame[there], scene)
        if not np.isfinite(slope):
            continue
        lateral = at @ across
        middle = mid_length(at, axis) & (np.abs(lateral - np.median(lateral)) <= 2 * diameter)
        height = at[middle] @ (up - slope * across) / np.hypot(1, slope)
        down = -np.sign(slope) * (across + slope * up) / np.hypot(1, slope)
        total += np.histogram(height.max() - height, edges, weights=vel[middle] @ down)[0]
        count += np.histogram(height.max() - height, edges)[0]
    with np.errstate(invalid="ignore"):
        return (edges[1:] + edges[:-1]) / 2, total / count


def mixing_index(pos: np.ndarray, scene: Scene) -> np.ndarray:
    """Lacey's index of two halves of a drum's bed that lie side by side across the axis in the first frame: 0 where
    they are apart, 1 where they are mixed as at random.

    M = (s_0^2 - s^2) / (s_0^2 - s_r^2), with s^2 the variance of one half's share over cubic cells of four diameters
    (weighted by their grains; cells of fewer than five left out), s_0^2 = p (1 - p) and s_r^2 = p (1 - p) / n the
    variances of a separated and of a random mixture, n the mean number in a cell (Lacey 1954).

    Returns:
        (n_frames,); nan where no cell has enough grains.
    """
    across = drum_axes(scene)[1]
    lateral = pos[0] @ across
    half = lateral > np.nanmedian(lateral)
    return np.array([_lacey(frame[there], half[there], scene) for frame, there in zip(pos, present(pos), strict=True)])


def _lacey(pos: np.ndarray, half: np.ndarray, scene: Scene) -> float:
    places = np.floor(pos / (CELL_DIAMETERS * 2 * scene.grains.radii_m[-1]))
    cell = np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)
    count = np.bincount(cell)
    enough = count >= LEAST_IN_CELL
    if not enough.any():
        return float("nan")
    count, ours = count[enough], np.bincount(cell, weights=half)[enough]
    share = ours.sum() / count.sum()
    apart = share * (1 - share)
    variance = np.average((ours / count - share) ** 2, weights=count)
    return float((apart - variance) / (apart - apart / count.mean()))
