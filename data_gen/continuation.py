"""Goes on with the DEM from a frame of a stored case, in that case's own scene, meshes and time step.

What a stored frame lacks, a continuation starts without: the contacts' tangential springs begin unloaded, and values
are rounded (`scene.dem.decimals`; data_gen/restart.py says what both cost).
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from omegaconf import DictConfig
from trimesh import Trimesh

from data_gen.dem import run_dem
from data_gen.initial import Start
from gns_pyg.config import require
from gns_pyg.data.datamodule import check_same_scene, find_cases
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.evaluation.errors import positions
from gns_pyg.scene.scene import Scene

DECIMALS = {"position": 10, "velocity": 8, "angular_velocity": 6}  # of continuations: rounding must not add to them


def open_case(cfg: DictConfig) -> tuple[Trajectory, Scene]:
    """The stored case number `cfg.case` (in the order of the files) of `cfg.scene`, and the scene stored in it.

    The stored scene is that of the config as far as grains can feel it, but holds the DEM time step of the run.

    Raises:
        ConfigError: if there is no such case.
        DataError: if the scene has no cases, or the case is damaged or of another scene.
    """
    scene = Scene.from_config(cfg.scene)
    paths = find_cases(scene, cfg.data.dir)
    known = isinstance(cfg.case, int) and 0 <= cfg.case < len(paths)
    require(known, "case", cfg.case, f"0 to {len(paths) - 1}, an index of {paths[0].parent}/case_*.h5", "pick one")
    trajectory = Trajectory(paths[cfg.case])
    check_same_scene(trajectory, scene)
    return trajectory, Scene.from_config(trajectory.scene)


def frame_at(trajectory: Trajectory, time_s: float, key: str, first: int = 0) -> int:
    """The frame nearest to `time_s` that another one follows; not before the frame `first`.

    Raises:
        ConfigError: if the time lies outside those frames; names the config key `key`.
    """
    times = trajectory.times_s[first:-1]
    require(len(times) > 0, "case", f"{trajectory.n_frames} frames", f"at least {first + 2}", "choose a longer case")
    span = f"{times[0]:g} to {times[-1]:g} s ({trajectory.path.name})"
    off_s = np.abs(times - time_s) if isinstance(time_s, int | float) else np.array([np.inf])
    near = bool(off_s.min() <= 0.501 * trajectory.frame_dt_s)
    require(near, key, time_s, span, "choose a time in seconds within the run")
    return first + int(off_s.argmin())


def stored_state(trajectory: Trajectory, frame: int) -> Start:
    """All that a stored frame holds: positions, instantaneous velocities, angular velocities, its time."""
    names = ("position", "velocity", "angular_velocity")
    pos, vel, ang_vel = (trajectory.read(name, frame, frame + 1)[0] for name in names)
    there = trajectory.active(frame, frame + 1)[0]
    return Start(pos, vel, ang_vel, trajectory.radius, there, float(trajectory.times_s[frame]))


def continue_dem(trajectory: Trajectory, scene: Scene, start: Start, n_frames: int) -> np.ndarray:
    """Runs the DEM of a stored case from `start`.

    Args:
        trajectory: the case, for its meshes.
        scene: the scene stored with it.
        start: state and time to start from; moving walls start in their pose at that time.
        n_frames: frames to return, the start included.

    Returns:
        Grain centres, m, (n_frames, n_grains, 3); nan where a grain is not there.

    Raises:
        DependencyError: if Yade is not installed.
        DataError: if Yade fails.
    """
    fine = replace(scene, dem=replace(scene.dem, decimals=DECIMALS))
    meshes = {
        name: Trimesh(part["vertices"], part["triangles"], process=False) for name, part in trajectory.boundary.items()
    }
    with tempfile.TemporaryDirectory(prefix="gns_continued_") as folder:
        path = Path(folder) / trajectory.path.name
        run_dem(fine, meshes, start, path, n_frames=n_frames)
        return positions(Trajectory(path))


def millimetres(length_m: float) -> str:
    """A length in mm, four decimals."""
    return f"{1e3 * length_m:.4f}"


def layout(
    heading: Sequence[str],
    rows: Sequence[tuple[str, Sequence[float]]],
    show: Callable[[float], str] = millimetres,
) -> str:
    """A plain-text table.

    Args:
        heading: of every column, that of the labels first.
        rows: (label, values).
        show: a value as text.
    """
    texts = [list(heading), *([label, *map(show, values)] for label, values in rows)]
    widths = [max(len(text) for text in column) for column in zip(*texts, strict=True)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *(text.rjust(w) for text, w in zip(row[1:], widths[1:], strict=True))])
        for row in texts
    )
