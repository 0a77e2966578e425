"""The DEM as a competitor: Yade from the same starts as the networks, at any time step, with one core."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from trimesh import Trimesh

from data_gen.continuation import DECIMALS, stored_state
from data_gen.dem import run_dem
from data_gen.initial import Start
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.evaluation.baselines import FIRST_FRAME
from gns_pyg.evaluation.errors import position_error, positions
from gns_pyg.evaluation.metrics import CaseResult, case_result
from gns_pyg.evaluation.predict import start_frame
from gns_pyg.scene.scene import Scene

EVERY = 8  # single frames are asked for from every so many stored ones
TWIN_SHIFT_M = 1e-6  # standard deviation of the shift of every coordinate, as data_gen.twins


@dataclass(frozen=True)
class Run:
    """What Yade did: positions (n_frames, n_grains, 3), m, its processor and wall seconds of stepping, its step, s."""

    pos: np.ndarray
    cpu_s: float
    wall_s: float
    dt_s: float


def run(case: Trajectory, starts: Start | Sequence[Start], n_frames: int, dt_s: float | str) -> Run:
    """Goes on with Yade from `starts` (of a case) at the time step `dt_s`, or the next shorter one that fits a frame.

    Raises:
        DependencyError: if Yade is not installed.
        DataError: if Yade fails.
    """
    scene = Scene.from_config(case.scene)
    scene = replace(scene, dem=replace(scene.dem, dt_s=dt_s, decimals=DECIMALS))
    meshes = {name: Trimesh(part["vertices"], part["triangles"], process=False) for name, part in case.boundary.items()}
    with tempfile.TemporaryDirectory(prefix="gns_tradeoff_") as folder:
        path = Path(folder) / case.path.name
        run_dem(scene, meshes, starts, path, n_frames=n_frames)
        done = Trajectory(path)
        facts = done.run
        return Run(positions(done), float(facts["cpu_time_s"]), float(facts["wall_clock_s"]), float(facts["dt_s"]))


def from_start(case: Trajectory, start_s: float, dt_s: float | str, shift_m: float = 0.0, seed: int = 0) -> Run:
    """The roll-out's counterpart: from the stored frame at `start_s` to the case's end.

    Args:
        case: the case.
        start_s: scene time of the start.
        dt_s: Yade's time step.
        shift_m: standard deviation of a shift of every coordinate of the start.
        seed: of the shift.
    """
    frame = start_frame(case, start_s)
    start = stored_state(case, frame)
    shift = np.random.default_rng(seed).normal(0.0, shift_m, start.pos.shape) if shift_m else 0.0
    return run(case, replace(start, pos=start.pos + shift), case.n_frames - frame, dt_s)


def of_step(case: Trajectory, scene: Scene, start_s: float, dt_s: float | str) -> tuple[CaseResult, Run]:
    """Yade at a time step beside the stored run, as a network's roll-out is; single frames from every `EVERY`th frame.

    Raises:
        DataError: if Yade fails.
        NumericalError: if grains fly to infinity.
    """
    start, done = start_frame(case, start_s), from_start(case, start_s, dt_s)
    errors = np.full(case.n_frames - FIRST_FRAME, np.nan)
    frames = range(FIRST_FRAME - 1, case.n_frames - 1, EVERY)
    single = run(case, [stored_state(case, frame) for frame in frames], 2, dt_s).pos[1::2]
    truth = positions(case)
    for frame, pos in zip(frames, single, strict=True):
        errors[frame + 1 - FIRST_FRAME] = position_error(pos[None], truth[frame + 1][None])[0]
    rate = done.cpu_s / ((case.n_frames - 1 - start) * case.frame_dt_s)
    return case_result(case, scene, done.pos, start, errors, FIRST_FRAME, rate), done


def twin(case: Trajectory, scene: Scene, start_s: float, seed: int) -> CaseResult:
    """Yade at the stored run's own step from a start a micrometre away: as good as any forecast can be."""
    done = from_start(case, start_s, case.scene["dem"]["dt_s"], TWIN_SHIFT_M, seed)
    return guess(case, scene, start_s, lambda start: done.pos)


def guess(case: Trajectory, scene: Scene, start_s: float, of: Callable[[int], Any]) -> CaseResult:
    """Positions from anywhere, `of(start frame)` (n_frames - start, n_grains, 3), put beside a case as a roll-out;
    single steps are not told."""
    start = start_frame(case, start_s)
    untold = np.full(case.n_frames - FIRST_FRAME, np.nan)
    return case_result(case, scene, of(start), start, untold, FIRST_FRAME, float("nan"))
