"""Running a simulator against a recorded case."""

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gns_pyg.config import require
from gns_pyg.data.trajectory import Trajectory, TrajectoryWriter
from gns_pyg.data.windows import read_window
from gns_pyg.dynamics.captured import Captured
from gns_pyg.dynamics.rollout import rollout
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import DataError
from gns_pyg.evaluation.errors import position_error
from gns_pyg.state import State, Window

MOST_WAITING = 8  # frames that may wait to be written


def start_frame(trajectory: Trajectory, start_s: Any) -> int:
    """The frame at `start_s`; at least 1, since a state of differences needs the frame before.

    Raises:
        ConfigError: if `start_s` is not a number of seconds.
        DataError: if the case ends before.
    """
    number = isinstance(start_s, int | float) and start_s >= 0
    require(number, "start_s", start_s, "seconds, at least 0", "0.1 is the paper's")
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


def write_rollout(simulator: Simulator, trajectory: Trajectory, start: int, path: Path) -> float:
    """Rolls out from the recorded frame `start` and writes every frame to `path`, in the data's own schema.

    A thread of its own writes while the next frames are computed.

    Returns:
        Wall seconds per simulated second, without the writing.
    """
    scene, n_steps, state = (
        simulator.scene,
        trajectory.n_frames - 1 - start,
        initial_state(simulator, trajectory, start),
    )
    stored = {key: n for key, n in scene.dem.decimals.items() if key != "angular_velocity" or state.ang_vel is not None}
    of_case = asdict(scene) | {key: trajectory.scene[key] for key in ("grains", "damping")}  # they may vary
    radius, mass, absence = trajectory.radius, trajectory.mass, state.active is not None
    with (
        TrajectoryWriter(path, of_case, radius, mass, trajectory.boundary, stored, absence) as writer,
        ThreadPoolExecutor(1) as pool,
    ):
        waiting: deque[Future[None]] = deque()

        def write(step: int, state: State) -> None:
            spin, active = (None if field is None else field.numpy() for field in (state.ang_vel, state.active))
            writer.append(step, float(state.time_s[0]), state.pos.numpy(), state.vel.numpy(), spin, active)

        def hand_over(step: int, state: State) -> None:
            waiting.append(pool.submit(write, step, state))
            if len(waiting) > MOST_WAITING:
                waiting.popleft().result()

        seconds = _run(simulator, state, n_steps, hand_over)
        for frame in waiting:
            frame.result()
        writer.finish(
            {
                "wall_clock_s": seconds,
                "cores": torch.get_num_threads(),
                "steps": n_steps,
                "dt_s": scene.frame_dt_s,
                "creator": "gns_pyg",
                "creator_version": version("gns_pyg"),
                "start_from": trajectory.path.name,
            }
        )
    return seconds / (n_steps * scene.frame_dt_s)


def roll_out(simulator: Simulator, trajectory: Trajectory, start: int) -> tuple[np.ndarray, float]:
    """Rolls out from the recorded frame `start` to the case's end.

    Returns:
        Positions, m, (n_frames - start, n_grains, 3), the start first, nan where a grain is absent, and wall seconds
        per simulated second.
    """
    n_steps = trajectory.n_frames - 1 - start
    pos = np.full((n_steps + 1, trajectory.n_grains, 3), np.nan)

    def keep(step: int, state: State) -> None:
        there = slice(None) if state.active is None else state.active.numpy()
        pos[step, there] = state.pos.numpy()[there]

    seconds = _run(simulator, initial_state(simulator, trajectory, start), n_steps, keep)
    return pos, seconds / (n_steps * simulator.scene.frame_dt_s)


def _run(simulator: Simulator, state: State, n_steps: int, see: Callable[[int, State], None]) -> float:
    """Shows `see` the state and the `n_steps` that follow it, on the CPU; returns the wall seconds of the roll-out."""
    see(0, state)
    step = Captured(simulator) if simulator.execution.capture else simulator
    states, seconds = rollout(step, state.to(simulator.scale.device), n_steps), 0.0
    for number in range(1, n_steps + 1):
        begin = time.perf_counter()
        following = next(states).to("cpu")
        seconds += time.perf_counter() - begin
        see(number, following)
    return seconds


@torch.inference_mode()
def one_step_errors(simulator: Simulator, trajectory: Trajectory, batch_size: int = 4) -> np.ndarray:
    """Mean position error (the paper's (13)), m, of one step from every recorded state: of frames 2 to the last, over
    the grains present in the frame and the two before it (see `trivial_errors`)."""
    errors = []
    for first in range(0, trajectory.n_frames - 2, batch_size):
        frames = range(first, min(first + batch_size, trajectory.n_frames - 2))
        window = Window.collate([read_window(trajectory, frame, 3) for frame in frames]).to(simulator.scale.device)
        predicted, truth = simulator(simulator.integrator.read(window, 1)).pos, window.pos[2]
        if window.active is not None:
            truth = torch.where(window.active.all(dim=0)[:, None], truth, torch.nan)
        shape = (len(frames), trajectory.n_grains, 3)
        errors.append(position_error(predicted.cpu().numpy().reshape(shape), truth.cpu().numpy().reshape(shape)))
    return np.concatenate(errors)
