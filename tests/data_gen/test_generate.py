"""The command line of data generation on real Yade: physics known by hand, resuming, refusing, interruptions."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from data_gen import dem
from data_gen.dem import run_dem
from data_gen.generate import generate
from data_gen.initial import Start
from gns_pyg.config import CONF
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import DataError, DependencyError
from gns_pyg.files import clean_stale
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene
from tests import scenes

HOST = socket.gethostname()
ROOT = Path(__file__).resolve().parents[2]
TINY = ["scene=hopper_small", "scene.grains.count=20", "scene.duration_s=0.05"]
needs_yade = [
    pytest.mark.yade,
    pytest.mark.skipif(shutil.which("yade") is None, reason="Yade is not installed (apt-get install yade)"),
]


def config(folder: Path, *overrides: str):
    with initialize_config_dir(CONF, version_base=None):
        return compose("generate", [*TINY, f"out={folder}", *overrides])


def command(folder: Path, *overrides: str) -> list[str]:
    words = sorted([*TINY, f"out={folder}", *overrides], key=lambda word: word != "-m")  # the option goes first
    return [sys.executable, "-m", "data_gen.generate", *words]


def run(folder: Path, *overrides: str) -> subprocess.CompletedProcess:
    return subprocess.run(command(folder, *overrides), capture_output=True, text=True, cwd=ROOT, timeout=120)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != ".lock")


def dem_run(path: Path, scene: Scene, start: Start, **arguments) -> Trajectory:
    meshes = {name: build_mesh(name, part) for name, part in scene.boundary.items()}
    run_dem(scene, meshes, start, path, **arguments)
    return Trajectory(path)


def still(pos: list[list[float]], **changes) -> Start:
    zeros, ones = np.zeros((len(pos), 3)), np.ones(len(pos))
    values = {"pos": np.array(pos), "vel": zeros, "ang_vel": zeros, "radius": scenes.RADIUS_M * ones}
    return Start(**(values | {"active": ones.astype(bool)} | changes))


class TestWithoutYade:
    def test_a_missing_yade_says_how_to_get_it(self, tmp_path, monkeypatch) -> None:
        monkeypatch.setattr(dem.shutil, "which", lambda _: None)
        with pytest.raises(DependencyError, match="apt-get install yade python3-h5py"):
            generate(config(tmp_path))
        assert names(tmp_path) == []

    def test_unfinished_files_of_dead_processes_go_and_those_of_live_ones_stay(self, tmp_path) -> None:
        ended = subprocess.Popen(["true"])
        ended.wait()
        mine, theirs = (f".case_000.h5.{host}.{pid}.part" for host, pid in ((HOST, os.getpid()), ("other", ended.pid)))
        for name in (mine, theirs, f".case_000.h5.{HOST}.{ended.pid}.part"):
            (tmp_path / name).touch()
        (tmp_path / f".case_001.h5.{HOST}.{ended.pid}.part").touch()
        clean_stale(tmp_path / "case_000.h5")
        assert names(tmp_path) == sorted([mine, theirs, f".case_001.h5.{HOST}.{ended.pid}.part"])

    def test_unfinished_files_of_processes_that_nobody_has_waited_for_go(self, tmp_path) -> None:
        ended = subprocess.Popen(["true"])
        os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)  # it is a zombie from here on
        (tmp_path / f".case_000.h5.{HOST}.{ended.pid}.part").touch()
        clean_stale(tmp_path / "case_000.h5")
        assert names(tmp_path) == []
        ended.wait()

    def test_a_user_error_is_printed_without_traceback(self, tmp_path) -> None:
        done = run(tmp_path, "scene.initial.z_min_m=9.0")
        assert done.returncode == 1
        assert "remedy" in done.stderr
        assert "Traceback" not in done.stderr


@needs_yade[0]
@needs_yade[1]
class TestPhysics:
    def test_free_fall_is_the_damped_one(self, tmp_path) -> None:
        scene = scenes.scene(1, 11, damping=0.2)
        fall = dem_run(tmp_path / "fall.h5", scene, still([[0.0, 0.0, 0.0]]))
        assert fall.read("velocity")[-1, 0] == pytest.approx([0, 0, -0.8 * 9.81 * 0.1], rel=1e-3, abs=1e-9)

    def test_free_fall_without_damping_on_gravity_is_g(self, tmp_path) -> None:
        scene = scenes.scene(1, 11, damping=0.2, damping_on_gravity=False)
        fall = dem_run(tmp_path / "fall.h5", scene, still([[0.0, 0.0, 0.0]]))
        assert fall.read("velocity")[-1, 0, 2] == pytest.approx(-0.981, rel=1e-3)

    def test_a_turning_wall_carries_a_grain_along(self, tmp_path) -> None:
        drum = {"kind": "cylinder", "radius_m": 0.1, "length_m": 0.1, "axis": [1.0, 0.0, 0.0]}
        motion = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 3.0}
        part = {"shape": drum, "points": 10, "friction_angle_rad": 0.5, "motion": motion}
        scene = scenes.scene(1, 21, boundary={"drum": part})
        pos = dem_run(tmp_path / "drum.h5", scene, still([[0.0, 0.0, -0.0899]])).read("position")
        assert pos[-1, 0, 1] > 0.01  # about +x the lowest point of the drum moves along +y
        assert np.hypot(*pos[:, 0, 1:].T).max() < 0.0905

    def test_a_run_may_start_anywhere_in_time_with_the_walls_in_their_pose(self, tmp_path) -> None:
        box = {"kind": "box", "size_m": [0.2, 0.2, 0.024]}
        motion = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 1.0}
        part = {"shape": box, "points": 10, "friction_angle_rad": 0.5, "motion": motion}
        scene = scenes.scene(1, 3, gravity_m_s2=[0.0, 0.0, 0.0], boundary={"box": part})
        quarter_turn_s = np.pi / 2  # the flat box now stands upright: room along z, none along y
        start = still([[0.0, 0.0, 0.05]], vel=np.array([[0.0, 0.0, 0.5]]), time_s=quarter_turn_s)
        trajectory = dem_run(tmp_path / "box.h5", scene, start)
        assert trajectory.times_s == pytest.approx(quarter_turn_s + 0.01 * np.arange(3))
        assert trajectory.read("velocity")[-1, 0, 2] == pytest.approx(0.5, abs=0.05)

    def test_the_first_frame_is_the_start_and_runs_repeat_exactly(self, tmp_path) -> None:
        first, again = Trajectory(generate(config(tmp_path / "a"))), Trajectory(generate(config(tmp_path / "b")))
        assert first.content_hash() == again.content_hash()
        assert (first.n_frames, first.n_grains) == (6, 20)
        assert np.abs(first.read("velocity")[0]).max() <= 0.5
        assert first.read("angular_velocity")[0] == pytest.approx(0, abs=1e-12)
        assert np.ptp(first.read("position"), axis=0).min() > 0  # no frame is a live reference to the last one

    def test_dem_steps_divide_a_frame_and_never_exceed_what_was_asked(self, tmp_path) -> None:
        run = Trajectory(generate(config(tmp_path, "scene.dem.dt_s=3e-5", "scene.duration_s=0.02"))).run
        assert run["dt_s"] <= 3e-5
        assert run["steps"] * run["dt_s"] == pytest.approx(0.02)
        assert run["wall_clock_s"] > 0
        assert (run["case"], run["cores"], run["creator"]) == (0, 1, "Yade")


@needs_yade[0]
@needs_yade[1]
class TestCommand:
    def test_a_finished_case_is_skipped_and_one_of_another_scene_refused(self, tmp_path) -> None:
        assert run(tmp_path).returncode == 0
        written = (tmp_path / "case_000.h5").stat().st_mtime_ns
        again = run(tmp_path, "scene.cases=3")
        assert again.returncode == 0
        assert "nothing to do" in again.stdout
        changed = run(tmp_path, "scene.damping=0.3")
        assert changed.returncode == 1
        assert "damping: 0.2 in the file, 0.3 now" in changed.stderr
        assert "delete the file" in changed.stderr
        assert (tmp_path / "case_000.h5").stat().st_mtime_ns == written
        assert names(tmp_path) == ["case_000.h5"]

    def test_two_commands_for_one_case_run_it_once(self, tmp_path) -> None:
        words = command(tmp_path, "scene.duration_s=0.2")
        both = [subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) for _ in range(2)]
        said = sorted(process.communicate(timeout=120)[0] for process in both)
        assert [process.returncode for process in both] == [0, 0]
        assert ["complete;" in text for text in said].count(True) == 1
        assert ["nothing to do" in text for text in said].count(True) == 1
        assert names(tmp_path) == ["case_000.h5"]

    def test_many_cases_run_side_by_side_with_progress_per_case(self, tmp_path) -> None:
        overrides = ["case=0,1", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", f"hydra.sweep.dir={tmp_path}/runs"]
        done = run(tmp_path / "data", "-m", *overrides)
        assert done.returncode == 0, done.stderr
        assert names(tmp_path / "data") == ["case_000.h5", "case_001.h5"]
        assert "case 000: frame" in done.stdout
        assert "case 001: frame" in done.stdout
        assert "s left" in done.stdout

    def test_a_failing_yade_shows_its_last_lines(self, tmp_path) -> None:
        scene = scenes.scene(1, 2)
        with pytest.raises(DataError, match=r"status 1[\s\S]*not finite"):
            dem_run(tmp_path / "case.h5", scene, still([[0.0, 0.0, 0.0]], vel=np.full((1, 3), np.nan)))
        assert names(tmp_path) == []

    def test_a_yade_without_h5py_says_what_to_install(self, tmp_path, monkeypatch) -> None:
        (tmp_path / "h5py.py").write_text("raise ModuleNotFoundError(\"No module named 'h5py'\")")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        with pytest.raises(DependencyError, match="apt-get install python3-h5py"):
            dem_run(tmp_path / "case.h5", scenes.scene(1, 2), still([[0.0, 0.0, 0.0]]))

    @pytest.mark.parametrize("victim", ["yade", "generate"])
    def test_kill_9_leaves_nothing_under_the_final_name(self, tmp_path, victim) -> None:
        process = subprocess.Popen(
            command(tmp_path, "scene.duration_s=100"), cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        part = wait_for(lambda: next(tmp_path.glob(".case_000.h5.*.part"), None))
        yade_pid = int(part.name.split(".")[-2])
        os.kill(yade_pid if victim == "yade" else process.pid, signal.SIGKILL)
        assert process.wait(timeout=30) != 0
        wait_for(lambda: not Path(f"/proc/{yade_pid}").exists())
        assert names(tmp_path) == []
        if victim == "yade":
            assert b"status -9" in process.stderr.read()
        process.stderr.close()

    @pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
    def test_ctrl_c_and_a_cluster_end_yade_and_leave_nothing(self, tmp_path, stop) -> None:
        process = subprocess.Popen(
            command(tmp_path, "scene.duration_s=100"),
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # background jobs inherit it ignored
        )
        part = wait_for(lambda: next(tmp_path.glob(".case_000.h5.*.part"), None))
        process.send_signal(stop)
        assert process.wait(timeout=30) != 0
        wait_for(lambda: not Path(f"/proc/{part.name.split('.')[-2]}").exists())
        assert names(tmp_path) == []


def wait_for(condition, seconds: float = 60):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := condition():
            return found
        time.sleep(0.05)
    raise TimeoutError("the run did not get there")
