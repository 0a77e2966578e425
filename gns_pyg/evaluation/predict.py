"""Running a simulator against a recorded case."""

import time

import numpy as np
import torch

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import read_window
from gns_pyg.dynamics.rollout import rollout
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import DataError
from gns_pyg.evaluation.errors import position_error
from gns_pyg.state import State, Window


def start_frame(trajectory: Trajectory, start_s: float) -> int:
    """The frame at `start_s`; at least 1, since a state of differences needs the frame before.

    Raises:
        DataError: if the case ends before.
    """
    frame = max(1, int(np.searchsorted(trajectory.times_s, start_s - 1e-9)))
    if frame >= trajectory.n_frames - 1:
        raise DataError(
            trajectory.path,
            f"{trajectory.n_frames} frames up to {trajectory.times_s[-1]:g} s",
            f"frames after the start at {start_s:g} s",
            "lower start_s or use a longer case",
        )
    return frame


def initial_state(simulator: Simulator, trajectory: Trajectory, frame: int) -> State:
    """The recorded state at `frame`."""
    return simulator.integrator.read(read_window(trajectory, frame - 1, 2), 1)


def roll_out(simulator: Simulator, trajectory: Trajectory, start: int) -> tuple[np.ndarray, float]:
    """Rolls out from the recorded frame `start` to the case's end.

    Returns:
        Positions, m, (n_frames - start, n_grains, 3), the start first, and wall seconds per simulated second.
    """
    state = initial_state(simulator, trajectory, start).to(simulator.scale.device)
    n_steps = trajectory.n_frames - 1 - start
    pos = np.empty((n_steps + 1, trajectory.n_grains, 3))
    pos[0] = state.pos.cpu()
    begin = time.perf_counter()
    for step, following in enumerate(rollout(simulator, state, n_steps), 1):
        pos[step] = following.pos.cpu()
    return pos, (time.perf_counter() - begin) / (n_steps * simulator.scene.frame_dt_s)


@torch.inference_mode()
def one_step_errors(simulator: Simulator, trajectory: Trajectory, batch_size: int = 4) -> np.ndarray:
    """Mean position error (the paper's (13)), m, of one step from every recorded state: of frames 2 to the last."""
    errors = []
    for first in range(0, trajectory.n_frames - 2, batch_size):
        frames = range(first, min(first + batch_size, trajectory.n_frames - 2))
        window = Window.collate([read_window(trajectory, frame, 3) for frame in frames]).to(simulator.scale.device)
        predicted = simulator(simulator.integrator.read(window, 1)).pos
        shape = (len(frames), trajectory.n_grains, 3)
        errors.append(
            position_error(predicted.cpu().numpy().reshape(shape), window.pos[2].cpu().numpy().reshape(shape))
        )
    return np.concatenate(errors)
