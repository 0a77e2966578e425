"""Which grains have left the boundary."""

import numpy as np
import torch
from trimesh import Trimesh

from gns_pyg.scene.mesh import container, distance, inside
from gns_pyg.scene.motion import to_body
from gns_pyg.scene.scene import Scene


def outside(pos: np.ndarray, times_s: np.ndarray, scene: Scene) -> np.ndarray:
    """Grains whose centre lies outside every part of the boundary that holds grains in.

    Positions are carried into each part's body frame, where its mesh is at rest. A grain below an open bottom has left
    through it and is not outside. Scenes without a part that holds grains in have no outside.

    Args:
        pos: m, (n_frames, n_grains, 3).
        times_s: (n_frames,), s; walls move with it.

    Returns:
        (n_frames, n_grains), bool.
    """
    out = np.ones(pos.shape[:2], bool)
    closed = 0
    for name, part in scene.boundary.items():
        mesh = container(name, part)
        if mesh is None:
            continue
        bottom_m = mesh.bounds[0, 2] if part.shape.get("open_bottom") else -np.inf
        closed += 1
        affordable_m = (mesh.extents.prod() / max(pos.shape[0] * pos.shape[1] / 4, 1)) ** (1 / 3)  # a cell per 4 tests
        interior = _Interior(mesh, max(2 * scene.grains.radii_m[0], affordable_m))
        for index, (frame, time_s) in enumerate(zip(pos, times_s, strict=True)):
            at = torch.full((len(frame),), float(time_s), dtype=torch.float64)
            in_body = to_body(part.motion, torch.from_numpy(np.ascontiguousarray(frame)), at).numpy()
            out[index] &= ~interior(in_body) & (in_body[:, 2] >= bottom_m)
    return out if closed else np.zeros_like(out)


class _Interior:
    """`inside(mesh, pos)`, the exact test spared for points in grid cells that the surface does not come near.

    Args:
        mesh: closed.
        cell_m: edge of the grid's cells, m.
    """

    def __init__(self, mesh: Trimesh, cell_m: float) -> None:
        self.mesh, self.cell_m, self.corner = mesh, cell_m, mesh.bounds[0]
        self.shape = np.ceil(mesh.extents / cell_m).astype(int)
        center = self.corner + (np.indices(self.shape).reshape(3, -1).T + 0.5) * cell_m
        safe = inside(mesh, center)
        safe[safe] = distance(mesh, center[safe]) > cell_m * np.sqrt(3) / 2
        self.safe = safe.reshape(self.shape)

    def __call__(self, pos: np.ndarray) -> np.ndarray:
        """bool (n,) for pos (n, 3), m, in the mesh's frame."""
        cell = np.floor((pos - self.corner) / self.cell_m)
        result = ((cell >= 0) & (cell < self.shape)).all(axis=1)
        result[result] = self.safe[tuple(cell[result].astype(int).T)]
        result[~result] = inside(self.mesh, pos[~result])
        return result
