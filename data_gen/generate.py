"""Generates one case with Yade: `python -m data_gen.generate scene=hopper case=0` (config: conf/generate.yaml).

A Hydra launcher runs many side by side: `-m 'case=range(20)' hydra/launcher=joblib hydra.launcher.n_jobs=2`.
"""

import sys
import time
from collections.abc import Mapping
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from tqdm import tqdm
from trimesh import Trimesh

from data_gen.dem import run_dem
from data_gen.initial import initial_state
from gns_pyg.config import flat, plain, require
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import DataError
from gns_pyg.files import held
from gns_pyg.launch import launch
from gns_pyg.scene.mesh import build_mesh, same_mesh
from gns_pyg.scene.scene import Scene

READ_LATER = ("cases", "angle_of_repose", "state", "vary")  # keys that do not influence a DEM run; nor do points


def generate(config: DictConfig) -> Path:
    """Generates the case that `config` describes unless its file is there already; returns the file's path. Several
    processes may be told to: one generates it, the others wait for it.

    Raises:
        GnsError: for an impossible scene, a file from another scene, Yade missing or failing.
    """
    require(config.case >= 0, "case", config.case, "at least 0", "number cases from 0")
    scene = Scene.from_config(config.scene).of_case(config.case)
    require(config.cores >= 1, "cores", config.cores, "at least 1", "set cores=1")
    path = Path(config.out) / f"case_{config.case:03d}.h5"
    meshes = {name: build_mesh(name, part) for name, part in scene.boundary.items()}
    if not path.exists():
        with held(path.parent, config.case, waiting=lambda: say(f"{path}: another process generates it; waiting")):
            if not path.exists():
                make(path, scene, meshes, config)
                return path
    say(f"{path}: already there, nothing to do{check_finished(path, scene, meshes)}")
    return path


def make(path: Path, scene: Scene, meshes: Mapping[str, Trimesh], config: DictConfig) -> None:
    """Runs the DEM and says how long it took."""
    start = initial_state(scene, meshes, config.case)
    progress = Progress(f"{scene.name} case {config.case:03d}")
    try:
        run_dem(scene, meshes, start, path, config.case, config.cores, progress=progress)
    finally:
        progress.close()
    run = Trajectory(path).run
    rate = run["steps"] / max(run["wall_clock_s"], 1e-9)
    say(f"{path}: complete; {run['steps']} steps of {run['dt_s']:.3g} s in {run['wall_clock_s']:.1f} s ({rate:.0f}/s)")


def check_finished(path: Path, scene: Scene, meshes: Mapping[str, Trimesh]) -> str:
    """Compares a finished file with the scene at hand; returns a note on differences that do not matter to the run.

    Raises:
        DataError: if the file is unreadable or comes from another scene; the differences are named.
    """
    trajectory = Trajectory(path)
    stored, wanted = flat(plain(Scene.from_config(trajectory.scene))), flat(plain(scene))
    differences = {
        key: f"{key}: {stored.get(key, 'not set')} in the file, {wanted.get(key, 'not set')} now"
        for key in sorted({*stored, *wanted})
        if stored.get(key) != wanted.get(key)
    }
    later = {key for key in differences if key.split(".")[0] in READ_LATER or key.endswith(".points")}
    serious = [text for key, text in differences.items() if key not in later]
    for name, part in trajectory.boundary.items():
        if name in meshes and not same_mesh(part, meshes[name]):  # a mesh file can change behind an equal path
            serious.append(f"boundary.{name}: another mesh than the file's")
    if serious:
        raise DataError(
            path,
            "a finished case of another scene: " + "; ".join(serious),
            "the scene at hand, or no file",
            "delete the file to generate it anew, or choose another folder with out=...",
        )
    return f" (it keeps {'; '.join(differences.values())})" if differences else ""


class Progress:
    """Frames done and time left: a bar on a terminal, else (and where runs share a terminal) a line per tenth."""

    def __init__(self, label: str) -> None:
        self.label, self.bar, self.tenth, self.started = label, None, 0, time.monotonic()
        if sys.stderr.isatty() and HydraConfig.initialized() and HydraConfig.get().mode == RunMode.RUN:
            self.bar = tqdm(desc=label, unit="frame")

    def __call__(self, done: int, total: int, stepping_s: float) -> None:
        if self.bar is not None:
            self.bar.total = total
            self.bar.update(done - self.bar.n)
        elif 10 * done // total > self.tenth:
            self.tenth = 10 * done // total
            left = (time.monotonic() - self.started) * (total - done) / done
            say(f"{self.label}: frame {done} of {total}, about {left:.0f} s left")

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()


def say(text: str) -> None:
    print(text, flush=True)


def main() -> None:
    """gns-generate"""
    launch("generate", generate)


if __name__ == "__main__":
    main()
