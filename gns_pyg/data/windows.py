"""Short stretches of consecutive frames: what a model trains on."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch.utils.data import Dataset, Sampler

from gns_pyg.config import require
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import DataError
from gns_pyg.scene.scene import PARAMETERS
from gns_pyg.state import Window


def read_window(trajectory: Trajectory, start: int, length: int) -> Window:
    """Frames [start, start + length) of a case; the arrays are fresh copies."""
    fields = ("position", "velocity", "angular_velocity")
    pos, vel, ang_vel = (torch.from_numpy(trajectory.read(field, start, start + length)) for field in fields)
    return Window(
        pos=pos,
        vel=vel,
        ang_vel=ang_vel,
        radius=torch.from_numpy(trajectory.radius),
        time_s=torch.tensor([trajectory.times_s[start]], dtype=torch.float64),
        batch=torch.zeros(trajectory.n_grains, dtype=torch.long),
        parameters=torch.tensor([parameters(trajectory)], dtype=torch.float64),
        active=torch.from_numpy(trajectory.active(start, start + length)) if trajectory.has_active else None,
    )


def parameters(trajectory: Trajectory) -> list[float]:
    """The values of `scene.PARAMETERS` that a case was made with."""
    values = {**trajectory.scene["grains"]["material"], "damping": trajectory.scene["damping"]}
    return [float(values[name]) for name in PARAMETERS]


class Windows(Dataset):
    """Every stretch of `length` frames of every case.

    Raises:
        DataError: for a case with fewer frames than `length`.
    """

    def __init__(self, trajectories: Sequence[Trajectory], length: int) -> None:
        self.trajectories, self.length = list(trajectories), length
        for trajectory in self.trajectories:
            if trajectory.n_frames < length:
                raise DataError(
                    trajectory.path,
                    f"{trajectory.n_frames} frames",
                    f"at least {length}, the length of one training window",
                    "use longer cases or lower training.unroll and training.creep_steps",
                )
        self.starts = np.cumsum([0] + [t.n_frames - length + 1 for t in self.trajectories])

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, item: int) -> Window:
        case = int(np.searchsorted(self.starts, item, side="right")) - 1
        return read_window(self.trajectories[case], item - int(self.starts[case]), self.length)


class Answers(Dataset):
    """The DEM's next frame to states that a model got into by itself; windows as of `Windows`, of length 3.

    Args:
        files: written by `data_gen.answers`: frames 2 k are such states, frames 2 k + 1 what the DEM made of them.
    """

    def __init__(self, files: Sequence[Trajectory]) -> None:
        self.files = list(files)
        self.starts = np.cumsum([0] + [file.n_frames // 2 for file in self.files])

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, item: int) -> Window:
        number = int(np.searchsorted(self.starts, item, side="right")) - 1
        file = self.files[number]
        pair = read_window(file, 2 * (item - int(self.starts[number])), 2)
        before = {"time_s": pair.time_s - file.scene["frame_dt_s"]}  # a frame before there is none; nothing reads it
        for name in ("pos", "vel", "ang_vel", "active"):
            if (values := getattr(pair, name)) is not None:
                before[name] = torch.cat([values[:1], values])
        return replace(pair, **before)


class UpdateSampler(Sampler):
    """Endless batches of shuffled items; batch number `update` is a function of the seed alone, so a resumed run
    goes on exactly where it stopped, and there is no last, smaller batch: an epoch's last items share their batch with
    the next one's first.

    Args:
        n_items: how many there are.
        batch_size: items of an update, over all processes.
        seed: of the shuffling.
        first_update: where to begin.
        process, processes: which of how many this is; each takes an equal part of every batch.

    Raises:
        ConfigError: if a batch cannot be divided among the processes.
    """

    def __init__(
        self, n_items: int, batch_size: int, seed: int, first_update: int = 0, process: int = 0, processes: int = 1
    ) -> None:
        self.n_items, self.batch_size, self.seed, self.first_update = n_items, batch_size, seed, first_update
        expected = f"a multiple of the {processes} processes (trainer.devices, trainer.num_nodes)"
        require(batch_size % processes == 0, "training.batch_size", batch_size, expected, f"e.g. {processes}")
        share = batch_size // processes
        self.part = slice(process * share, (process + 1) * share)

    def __iter__(self) -> Iterator[list[int]]:
        position, order, epoch = self.first_update * self.batch_size, np.empty(0, int), -1
        while True:
            batch = []
            for place in range(position, position + self.batch_size):
                if place // self.n_items != epoch:
                    epoch = place // self.n_items
                    order = np.random.default_rng((self.seed, epoch)).permutation(self.n_items)
                batch.append(int(order[place % self.n_items]))
            position += self.batch_size
            yield batch[self.part]
