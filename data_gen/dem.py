"""Starts Yade on one job, follows its progress, and leaves either a complete file or none."""

import json
import os
import shutil
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from trimesh import Trimesh

from data_gen.initial import Start
from gns_pyg.config import plain
from gns_pyg.errors import DataError, DependencyError
from gns_pyg.files import clean_stale
from gns_pyg.scene.inlet import entries
from gns_pyg.scene.scene import Scene

SCRIPT = Path(__file__).with_name("yade_case.py")
Progress = Callable[[int, int, float], None]  # frames done, frames in all, seconds of stepping so far


def run_dem(
    scene: Scene,
    meshes: Mapping[str, Trimesh],
    starts: Start | Sequence[Start],
    path: Path,
    case: int = 0,
    cores: int = 1,
    n_frames: int | None = None,
    facts: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> None:
    """Runs Yade from `starts` and writes the trajectory to `path`.

    Args:
        scene: what is simulated; stored in the file as resolved.
        meshes: mesh of every boundary part in its body frame, m.
        starts: grains and time that the run starts from; any stored frame will do. Several are run one after the other,
            their frames stored in a row.
        path: final name of the file; it appears only when the run is complete.
        case: number stored with the run.
        cores: threads of Yade.
        n_frames: frames to store, the start included; the whole scene's when None.
        facts: stored with the facts of the run.
        progress: called after every stored frame.

    Raises:
        DependencyError: if Yade, or h5py for its Python, is not installed.
        DataError: if Yade fails; its last lines are shown.
    """
    yade = shutil.which("yade")
    if yade is None:
        raise DependencyError(
            "data generation",
            "no program `yade` on the PATH",
            "Yade 2022 or newer",
            "apt-get install yade python3-h5py",
        )
    path = path.resolve()
    with tempfile.TemporaryDirectory(prefix="gns_job_") as folder:
        job = {
            "scene": plain(scene),
            "path": str(path),
            "case": case,
            "cores": cores,
            "n_frames": n_frames or scene.n_frames,
            "facts": dict(facts or {}),
            "parent": os.getpid(),
        }
        (Path(folder) / "job.json").write_text(json.dumps(job))
        plan = entries(scene)
        arrays: dict[str, Any] = {"entry_time_s": plan.time_s, "entry_pos": plan.pos, "entry_vel": plan.vel}
        starts = [starts] if isinstance(starts, Start) else starts
        for name in ("pos", "vel", "ang_vel", "active", "time_s"):
            arrays[name] = np.stack([getattr(start, name) for start in starts])
        arrays["radius"] = starts[0].radius
        for name, mesh in meshes.items():
            arrays[f"vertices/{name}"], arrays[f"triangles/{name}"] = np.array(mesh.vertices), np.array(mesh.faces)
        np.savez(Path(folder) / "arrays.npz", **arrays)
        command = [yade, "-n", "-x", f"-j{cores}", str(SCRIPT), folder, str(SCRIPT.parents[1])]
        try:
            status, tail = _follow(command, progress or (lambda *_: None))
        finally:
            clean_stale(path)
    if status != 0 or not path.is_file():
        if any("No module named 'h5py'" in line for line in tail):
            found = "no h5py in Yade's own Python"
            raise DependencyError("data generation", found, "h5py", "apt-get install python3-h5py")
        raise DataError(
            path,
            f"Yade ended with status {status}; its last lines:\n    " + "\n    ".join(tail),
            "a complete run",
            "see Yade's lines above; an instability shows as values that are not finite: lower scene.dem.dt_s",
        )


def _follow(command: list[str], progress: Progress) -> tuple[int, list[str]]:
    """Runs `command` to its end; returns its exit status and its last lines of chatter."""
    tail: deque[str] = deque(maxlen=15)
    popen = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,  # Ctrl-C reaches this process alone, which then ends Yade
    )
    with popen as process:
        try:
            for line in process.stdout or ():
                words = line.split()
                if words[:1] == ["frame"] and len(words) == 4:
                    progress(int(words[1]), int(words[2]), float(words[3]))
                elif words:
                    tail.append(line.rstrip())
        except BaseException:
            process.kill()
            raise
    return process.returncode, list(tail)
