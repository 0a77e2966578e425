"""A trajectory as the H5MD file that MDAnalysis reads: the group `trajectory`, lengths in nm."""

from pathlib import Path

import h5py
import numpy as np
from tqdm import tqdm

from gns_pyg.data.schema import H5MD_VERSION
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.files import whole

NM = 1e9  # in a metre


def write_mdanalysis(trajectory: Trajectory, path: str | Path) -> Path:
    """Writes positions (nm) and velocities (m s-1) of all grains; one that is absent keeps the place that the
    trajectory file gives it, since MDAnalysis wants the same particles in every frame.

    Raises:
        StorageError: if it cannot be written.
    """
    path = Path(path)
    shape = (trajectory.n_frames, trajectory.n_grains, 3)
    with whole(path) as temporary, h5py.File(temporary, "w") as file:
        header = file.create_group("h5md")
        header.attrs["version"] = H5MD_VERSION
        header.create_group("author").attrs["name"] = "gns_pyg"
        creator = header.create_group("creator")
        creator.attrs["name"], creator.attrs["version"] = trajectory.run["creator"], trajectory.run["creator_version"]
        grains = file.create_group("particles/trajectory")
        box = grains.create_group("box")
        box.attrs["dimension"], box.attrs["boundary"] = 3, ["none"] * 3
        for field, unit, factor in (("position", "nm", NM), ("velocity", "m s-1", 1.0)):
            group = grains.create_group(field)
            group["step"] = np.arange(trajectory.n_frames)
            group["time"] = trajectory.times_s
            group["time"].attrs["unit"] = "s"
            value = group.create_dataset("value", shape, np.float64, chunks=(1, *shape[1:]), compression="gzip")
            value.attrs["unit"] = unit
            for frame in tqdm(range(trajectory.n_frames), desc=field, unit="frame", disable=None):
                value[frame] = factor * trajectory.read(field, frame, frame + 1)[0]
    return path
