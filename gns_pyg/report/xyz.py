"""A trajectory as extended XYZ, the text file that OVITO (and much else) opens with radii and velocities."""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.files import whole

COLUMNS = "species:S:1:pos:R:3:velo:R:3:radius:R:1:id:I:1"  # the names that OVITO knows


def write_xyz(trajectory: Trajectory, path: str | Path) -> Path:
    """Writes all frames to one file, m and m/s, `Time` (s) in every frame's comment line; absent grains are left out.

    Raises:
        StorageError: if it cannot be written.
    """
    path = Path(path)
    with whole(path) as temporary, temporary.open("w") as file:
        for frame in tqdm(range(trajectory.n_frames), desc="xyz", unit="frame", disable=None):
            there = np.flatnonzero(trajectory.active(frame, frame + 1)[0])
            pos, vel = (trajectory.read(field, frame, frame + 1)[0, there] for field in ("position", "velocity"))
            file.write(f'{len(there)}\nProperties={COLUMNS} Time={trajectory.times_s[frame]:.9g} pbc="F F F"\n')
            rows = np.column_stack([pos, vel, trajectory.radius[there], there])
            np.savetxt(file, rows, fmt="grain" + 7 * " %.9g" + " %d")
    return path
