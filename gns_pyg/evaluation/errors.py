"""Position errors. Positions are (n_frames, n_grains, 3) float64 numpy arrays in m everywhere in this room."""

import numpy as np


def position_error(pos_a: np.ndarray, pos_b: np.ndarray) -> np.ndarray:
    """Mean Euclidean distance between corresponding grains, per frame (equation 13 of the paper).

    Args:
        pos_a, pos_b: grain centres, m, (n_frames, n_grains, 3); one of them may have a single frame (broadcast).

    Returns:
        (n_frames,), m.
    """
    return np.linalg.norm(pos_a - pos_b, axis=2).mean(axis=1)
