"""Running a simulator against a recorded case."""

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, fields, replace
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from gns_pyg.config import require
from gns_pyg.data.trajectory import Trajectory, TrajectoryWriter
from gns_pyg.data.windows import read_window
from gns_pyg.dynamics.captured import Captured
from gns_pyg.dynamics.rollout import rollout
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import DataError, NumericalError
from gns_pyg.evaluation.errors import position_error
from gns_pyg.models.mlp import fixed_weights
from gns_pyg.state import State, Window

log = logging.getLogger(__name__)
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


def steps_per_frame(simulator: Simulator, trajectory: Trajectory) -> int:
    """The simulator's steps from one frame of a case to the next.

    Raises:
        ConfigError: if there are several, but the state holds differences of successive frames.
    """
    steps = max(1, round(trajectory.frame_dt_s / simulator.scene.frame_dt_s))
    fits = steps == 1 or simulator.requires.state != "differences"
    found = f"frames {trajectory.frame_dt_s:g} s apart, steps of {simulator.scene.frame_dt_s:g} s, state differences"
    require(fits, str(trajectory.path), found, "frames one step apart", "record the case with the bundle's frame_dt_s")
    return steps


def initial_state(simulator: Simulator, trajectory: Trajectory, frame: int) -> State:
    """The recorded state at `frame`."""
    return _recorded(simulator, trajectory, range(frame, frame + 1))[0]


def perturbed(state: State, copies: int, shift_m: float, seed: int) -> State:
    """`copies` of a single graph's state as one batch, every coordinate of every grain shifted at random.

    Args:
        state: n_grains grains of one graph.
        copies: how many.
        shift_m: standard deviation of the shifts, m.
        seed: of the shifts.

    Returns:
        copies * n_grains grains of `copies` graphs.
    """
    generator = torch.Generator().manual_seed(seed)
    repeated = {
        field.name: value.repeat(copies, *[1] * (value.dim() - 1))
        for field in fields(state)
        if isinstance(value := getattr(state, field.name), torch.Tensor)
    }
    shift = torch.randn(repeated["pos"].shape, generator=generator, dtype=state.pos.dtype)
    repeated["pos"] = repeated["pos"] + shift_m * shift
    repeated["batch"] = torch.arange(copies).repeat_interleave(len(state.pos))
    return replace(state, **repeated)


def _recorded(simulator: Simulator, trajectory: Trajectory, frames: range, after: int = 0) -> tuple[State, Window]:
    """The recorded states at `frames`, all at least 1, batched, and windows of the frames that they are read from and
    `after` more."""
    steps = steps_per_frame(simulator, trajectory)
    before = min(simulator.integrator.before(steps), frames.start)
    window = Window.collate([read_window(trajectory, frame - before, before + 1 + after) for frame in frames])
    times_s = torch.from_numpy(trajectory.times_s[frames.start : frames.stop])
    return replace(simulator.integrator.read(window, before, steps), time_s=times_s), window


def write_rollout(simulator: Simulator, trajectory: Trajectory, start: int, path: Path) -> float:
    """Rolls out from the recorded frame `start` and writes every frame to `path`, in the data's own schema.

    A thread of its own writes while the next frames are computed.

    Returns:
        Wall seconds per simulated second, without the writing.

    Raises:
        NumericalError: if the roll-out diverges; the frames before lie beside `path` as NAME_stopped.h5.
    """
    scene, n_steps, state = (
        replace(simulator.scene, frame_dt_s=steps_per_frame(simulator, trajectory) * simulator.scene.frame_dt_s),
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

        stopped: NumericalError | None = None
        try:
            seconds = _run(simulator, state, n_steps, steps_per_frame(simulator, trajectory), hand_over)
        except NumericalError as error:  # what was good so far is kept, under another name
            stopped, seconds, writer.path = error, math.nan, path.with_name(f"{path.stem}_stopped{path.suffix}")
        for frame in waiting:
            frame.result()
        writer.finish(
            {
                "wall_clock_s": seconds,
                "cores": torch.get_num_threads(),
                "steps": n_steps * steps_per_frame(simulator, trajectory),
                "dt_s": simulator.scene.frame_dt_s,
                "creator": "gns_pyg",
                "creator_version": version("gns_pyg"),
                "start_from": trajectory.path.name,
            }
        )
    if stopped is not None:
        stopped.remedy += f"; the frames before are in {writer.path}"
        raise stopped
    return seconds / (n_steps * scene.frame_dt_s)


def roll_out(simulator: Simulator, trajectory: Trajectory, start: int) -> tuple[np.ndarray, float]:
    """Rolls out from the recorded frame `start` to the case's end.

    Returns:
        Positions, m, (n_frames - start, n_grains, 3), the start first, nan where a grain is absent, and wall seconds
        per simulated second.
    """
    pos, seconds = roll_out_from(simulator, trajectory, start, initial_state(simulator, trajectory, start))
    return pos[0], seconds


def roll_out_from(simulator: Simulator, trajectory: Trajectory, start: int, state: State) -> tuple[np.ndarray, float]:
    """Rolls out from `state`, one or more copies of a case's grains at its frame `start`, to the case's end.

    Returns:
        Positions, m, (copies, n_frames - start, n_grains, 3), the start first, nan where a grain is absent, and wall
        seconds per simulated second, of all copies together.
    """
    n_frames = trajectory.n_frames - start
    pos = np.full((state.n_graphs, n_frames, trajectory.n_grains, 3), np.nan)

    def keep(frame: int, state: State) -> None:
        there = torch.ones_like(state.batch, dtype=torch.bool) if state.active is None else state.active
        shape = (state.n_graphs, trajectory.n_grains, 3)
        pos[:, frame] = torch.where(there[:, None], state.pos, torch.nan).numpy().reshape(shape)

    seconds = _run(simulator, state, n_frames - 1, steps_per_frame(simulator, trajectory), keep)
    return pos, seconds / ((n_frames - 1) * trajectory.frame_dt_s)


def _run(simulator: Simulator, state: State, n_frames: int, steps: int, see: Callable[[int, State], None]) -> float:
    """Shows `see` the state and the `n_frames` that follow it, each `steps` steps after the last, on the CPU; returns
    the wall seconds of the roll-out."""
    simulator.check_place(state)
    see(0, state)
    step = Captured(simulator) if simulator.execution.capture else simulator
    state, reach_m = state.to(simulator.scale.device), simulator.cutoff_m
    states, seconds = rollout(step, state, n_frames * steps, settles=simulator.settles, reach_m=reach_m), 0.0
    simulator.guard.reset()
    with fixed_weights(simulator):
        for number in tqdm(range(1, n_frames + 1), desc="roll-out", unit="frame", leave=False, disable=None):
            begin = time.perf_counter()
            following = deque(islice(states, steps), maxlen=1)[0].to("cpu")
            seconds += time.perf_counter() - begin
            see(number, following)
    if (first := simulator.guard.first) is not None:
        log.warning(
            "%d times a grain would have gone through a wall and was stopped there, first grain %d at %.3g m/s at "
            "t = %.4g s (%s)",
            simulator.guard.crossings,
            first.grain,
            first.speed_m_s,
            first.time_s,
            first.part,
        )
    return seconds


@torch.inference_mode()
def one_step_errors(simulator: Simulator, trajectory: Trajectory, batch_size: int = 4) -> np.ndarray:
    """Mean position error (the paper's (13)), m, one frame after every recorded state: of frames 2 to the last, over
    the grains present in the frame and the two before it (see `trivial_errors`)."""
    errors, steps = [], steps_per_frame(simulator, trajectory)
    for first in range(1, trajectory.n_frames - 1, batch_size):
        frames = range(first, min(first + batch_size, trajectory.n_frames - 1))
        state, window = _recorded(simulator, trajectory, frames, after=1)
        state, truth = state.to(simulator.scale.device), window.pos[-1]
        for _ in range(steps):
            state = simulator(state)
        if window.active is not None:
            truth = torch.where(window.active[-3:].all(dim=0)[:, None], truth, torch.nan)
        shape = (len(frames), trajectory.n_grains, 3)
        errors.append(position_error(state.pos.cpu().numpy().reshape(shape), truth.numpy().reshape(shape)))
    return np.concatenate(errors)
