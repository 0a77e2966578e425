"""A trajectory as VTK files that ParaView plays: grains as points with their fields, the boundary as a moving mesh."""

from collections.abc import Callable, Sequence
from pathlib import Path

import meshio
import numpy as np
import torch
from tqdm import tqdm

from gns_pyg.config import require, typed
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.files import whole
from gns_pyg.scene.motion import to_world
from gns_pyg.scene.scene import Motion

PVD = """<?xml version="1.0"?>
<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">
<Collection>
{}
</Collection>
</VTKFile>
"""


def write_vtk(trajectory: Trajectory, folder: str | Path) -> Path:
    """Writes grains.pvd and boundary.pvd, time series of the .vtu files beside them. SI units throughout.

    Points of grains carry `grain` (its number), `radius` (m), `velocity` (m/s), `speed` (m/s) and, where stored,
    `angular_velocity` (rad/s); absent grains are left out. Points of the boundary carry `velocity` and `speed`, its
    triangles `part`, in the order of the file's parts.

    Args:
        trajectory: a DEM case or a roll-out.
        folder: written whole; an earlier export there is replaced.

    Raises:
        ConfigError: if `folder` holds something else.
        StorageError: if it cannot be written.
    """
    folder = Path(folder)
    ours = not folder.exists() or (folder / "grains.pvd").is_file() or (folder.is_dir() and not any(folder.iterdir()))
    require(ours, "out", f"{folder}: in use for something else", "a new folder", "choose another one with out=...")
    with whole(folder) as temporary:
        temporary.mkdir()
        _series(temporary, "grains", trajectory.times_s, _grains(trajectory))
        parts = _boundary(trajectory)
        if parts is not None:
            moves = any(motion.moves for _, _, motion in parts)
            times_s = trajectory.times_s if moves else trajectory.times_s[:1]
            _series(temporary, "boundary", times_s, lambda frame: _placed(parts, float(times_s[frame])))
    return folder


def _series(folder: Path, name: str, times_s: np.ndarray, mesh: Callable[[int], meshio.Mesh]) -> None:
    lines = []
    for frame, time_s in enumerate(tqdm(times_s.tolist(), desc=name, unit="frame", disable=None)):
        file = f"{name}_{frame:05d}.vtu"
        mesh(frame).write(folder / file)
        lines.append(f'<DataSet timestep="{time_s!r}" file="{file}"/>')
    (folder / f"{name}.pvd").write_text(PVD.format("\n".join(lines)))


def _grains(trajectory: Trajectory) -> Callable[[int], meshio.Mesh]:
    def mesh(frame: int) -> meshio.Mesh:
        def stored(field: str) -> np.ndarray:
            return trajectory.read(field, frame, frame + 1)[0, there]

        there = np.flatnonzero(trajectory.active(frame, frame + 1)[0])
        fields = {"grain": there, "radius": trajectory.radius[there], **_moving(stored("velocity"))}
        if "angular_velocity" in trajectory.fields:
            fields["angular_velocity"] = stored("angular_velocity")
        return meshio.Mesh(stored("position"), [("vertex", np.arange(len(there))[:, None])], point_data=fields)

    return mesh


def _boundary(trajectory: Trajectory) -> Sequence[tuple[torch.Tensor, np.ndarray, Motion]] | None:
    """Every part's corners, m, at t = 0, its triangles and its motion; None without a boundary."""
    parts = trajectory.boundary
    return [
        (
            torch.from_numpy(part["vertices"]),
            part["triangles"],
            typed(Motion, part["motion"], f"{trajectory.path}: boundary.{name}.motion"),
        )
        for name, part in parts.items()
    ] or None


def _placed(parts: Sequence[tuple[torch.Tensor, np.ndarray, Motion]], time_s: float) -> meshio.Mesh:
    """All parts as one mesh, where they are at a time."""
    points, velocities, triangles, count = [], [], [], 0
    for corners, faces, motion in parts:
        pos, vel = to_world(motion, corners, torch.full((len(corners),), time_s, dtype=torch.float64))
        points.append(pos.numpy())
        velocities.append(vel.numpy())
        triangles.append(faces + count)
        count += len(corners)
    part = np.repeat(np.arange(len(parts)), [len(faces) for faces in triangles])
    cells = [("triangle", np.concatenate(triangles))]
    return meshio.Mesh(np.concatenate(points), cells, _moving(np.concatenate(velocities)), {"part": [part]})


def _moving(vel: np.ndarray) -> dict[str, np.ndarray]:
    return {"velocity": vel, "speed": np.linalg.norm(vel, axis=1)}
