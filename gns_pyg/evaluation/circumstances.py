"""In what circumstances a single grain is, to map errors against: how many it touches, how far from a wall it is.

Positions `pos` are grain centres, m, (n_frames, n_grains, 3) float64, nan where a grain is absent; `radius` is
(n_grains,), m.
"""

import numpy as np
import torch
from scipy.spatial import cKDTree

from gns_pyg.evaluation.errors import present
from gns_pyg.scene.mesh import build_mesh, distance
from gns_pyg.scene.motion import to_body
from gns_pyg.scene.scene import Scene


def touching(pos: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """How many grains each grain touches (d < r_i + r_j; walls are not counted), (n_frames, n_grains) float; nan where
    it is absent."""
    counts = np.full(pos.shape[:2], np.nan)
    for row, frame, there in zip(counts, pos, present(pos), strict=True):
        if not there.any():
            continue
        at, size = frame[there], radius[there]
        first, second = cKDTree(at).query_pairs(2 * size.max(), output_type="ndarray").T
        touch = np.linalg.norm(at[first] - at[second], axis=1) < size[first] + size[second]
        row[there] = np.bincount(np.concatenate([first[touch], second[touch]]), minlength=len(at))
    return counts


def wall_gap(pos: np.ndarray, times_s: np.ndarray, radius: np.ndarray, scene: Scene) -> np.ndarray:
    """Distance from each grain's surface to the nearest wall, m, (n_frames, n_grains), negative where they overlap;
    infinite without a wall, nan where the grain is absent."""
    there = present(pos)
    gaps = np.where(there, np.inf, np.nan)
    time_s = torch.from_numpy(np.broadcast_to(times_s[:, None], there.shape)[there])
    for name, part in scene.boundary.items():
        body = to_body(part.motion, torch.from_numpy(pos[there]), time_s).numpy()
        gaps[there] = np.minimum(gaps[there], distance(build_mesh(name, part), body))
    return gaps - radius
