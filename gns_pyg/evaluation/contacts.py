"""What touching grains say: overlap and coordination number. Grains touch where d < r_i + r_j; walls are not counted.

Positions `pos` are grain centres, m, (n_frames, n_grains, 3) float64, nan where a grain is absent; `radius` is
(n_grains,), m.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from gns_pyg.evaluation.errors import present


def overlap_ratios(pos: np.ndarray, radius: np.ndarray) -> list[np.ndarray]:
    """Overlap of every touching pair as a part of their mean diameter, (r_i + r_j - d) / (r_i + r_j), frame by frame.

    Returns:
        n_frames arrays (n_touching,), dimensionless (0.01 is one per cent of a diameter).
    """
    return [_overlaps(frame[there], radius[there]) for frame, there in zip(pos, present(pos), strict=True)]


def mean_overlap_ratio(pos: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Mean of `overlap_ratios`, per frame, (n_frames,); 0 where no pair touches."""
    return means(overlap_ratios(pos, radius))


def means(ratios: Sequence[np.ndarray]) -> np.ndarray:
    """Mean of every frame's ratios, (n_frames,); 0 where there are none."""
    return np.array([frame.mean() if len(frame) else 0.0 for frame in ratios])


def coordination_number(ratios: Sequence[np.ndarray], pos: np.ndarray) -> np.ndarray:
    """Mean number of grains that a grain touches, 2 N_contacts / N_grains, per frame, (n_frames,); nan without grains.
    `ratios` are the `overlap_ratios` of `pos`.

    Source: the textbook definition, e.g. Andreotti, Forterre and Pouliquen 2013, Granular Media, section 3.1; grains
    without contact ("rattlers") count as grains.
    """
    contacts = np.array([len(frame) for frame in ratios])
    with np.errstate(invalid="ignore"):
        return 2 * contacts / present(pos).sum(axis=1)


def contacts_per_grain(pos: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Number of grains that every grain touches, (n_frames, n_grains); nan where a grain is absent."""
    counts = np.full(pos.shape[:2], np.nan)
    for count, frame, there in zip(counts, pos, present(pos), strict=True):
        pairs = _touching(frame[there], radius[there])[0]
        count[there] = np.bincount(pairs.ravel(), minlength=there.sum())
    return counts


def _overlaps(pos: np.ndarray, radius: np.ndarray) -> np.ndarray:
    return _touching(pos, radius)[1]


def _touching(pos: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (n, 2) of one frame's grains that touch, and the overlap of each (see `overlap_ratios`)."""
    if len(pos) == 0:
        return np.empty((0, 2), int), np.empty(0)
    pairs = cKDTree(pos).query_pairs(2 * radius.max(), output_type="ndarray")
    first, second = pairs.T
    ratio = 1 - np.linalg.norm(pos[first] - pos[second], axis=1) / (radius[first] + radius[second])
    return pairs[ratio > 0], ratio[ratio > 0]
