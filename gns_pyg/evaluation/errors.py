"""Position errors. Positions are (n_frames, n_grains, 3) float64 numpy arrays in m everywhere in this room; nan where a
grain is absent: it has left through an outlet, or has yet to come through an inlet."""

import numpy as np

from gns_pyg.data.trajectory import Trajectory


def positions(trajectory: Trajectory, start: int = 0, stop: int | None = None) -> np.ndarray:
    """Grain centres of frames [start, stop) of a case, m, (n, n_grains, 3); nan where a grain is absent."""
    pos = trajectory.read("position", start, stop)
    return np.where(trajectory.active(start, stop)[:, :, None], pos, np.nan) if trajectory.has_active else pos


def present(pos: np.ndarray) -> np.ndarray:
    """Which grains are there, bool (..., n_grains), of positions (..., n_grains, 3)."""
    return np.isfinite(pos).all(axis=-1)


def mean_present(values: np.ndarray, axis: int) -> np.ndarray:
    """Mean of the finite values along an axis; nan (without a warning) where there are none."""
    finite = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(finite, values, 0.0).sum(axis=axis) / finite.sum(axis=axis)


def nanmean(values: np.ndarray) -> float:
    """Mean of the finite values; nan (without a warning) where there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")


def nanmax(values: np.ndarray) -> float:
    """Largest of the finite values; nan (without a warning) where there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.max()) if len(finite) else float("nan")


def position_error(pos_a: np.ndarray, pos_b: np.ndarray) -> np.ndarray:
    """Mean Euclidean distance between corresponding grains, per frame (equation 13 of the paper).

    Args:
        pos_a, pos_b: grain centres, m, (n_frames, n_grains, 3); one of them may have a single frame (broadcast).

    Returns:
        (n_frames,), m, over the grains present in both; nan where there are none.
    """
    return mean_present(np.linalg.norm(pos_a - pos_b, axis=2), axis=1)
