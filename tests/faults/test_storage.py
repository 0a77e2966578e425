"""A disk without room and folders that cannot be written to: a clear error, and what was there stays."""

import os
import shutil
import subprocess
import sys
from contextlib import suppress

import h5py
import numpy as np
import pytest
import torch

from gns_pyg import bundle
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import ConfigError, DataError, StorageError
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.files import held, unfinished, whole
from gns_pyg.training.checkpoint import Checkpoints
from tests import scenes
from tests.faults import samples
from tests.faults.kills import ROOT, command, wait
from tests.simulators import simulator

SIZE_KB = 4096


@pytest.fixture
def disk(tmp_path):
    """A folder of its own on a small disk; `fill` leaves no room, `lock` makes it read-only."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_KB}k", "tmpfs", str(folder)]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"mounting a small disk needs root: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def write(path, n_grains, n_frames):
    random = np.random.default_rng(0)
    pos, vel = random.normal(size=(2, n_frames, n_grains, 3))
    scenes.write_case(path, scenes.scene(n_grains, n_frames), pos, vel)


def fill(folder):
    with (folder / "filler").open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(4096)):
            pass


def lock(folder):
    subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)


def names(folder):
    return sorted(path.name for path in folder.iterdir() if path.name not in ("filler", ".lock"))


@pytest.mark.parametrize("spoil", [fill, lock])
def test_files_that_were_there_stay(disk, spoil):
    write_json(disk / "metrics.json", {"a": 1})
    bundle.save(disk / "bundle", simulator(scenes.scene(4, 5)), {})
    Checkpoints().save_checkpoint({"a": torch.zeros(10)}, disk / "last.ckpt")
    before = names(disk)
    spoil(disk)
    for change in (
        lambda: write_json(disk / "metrics.json", {"a": [0.123456] * 10**6}),
        lambda: bundle.save(disk / "bundle", simulator(scenes.scene(4, 5)), {"text": "x" * 10**7}),
        lambda: Checkpoints().save_checkpoint({"a": torch.zeros(10**7)}, disk / "last.ckpt"),
        lambda: write(disk / "case_000.h5", 2000, 300),
    ):
        with pytest.raises(StorageError, match=r"No space left|Read-only|errno = 28|errno = 30"):
            change()
    assert names(disk) == before
    assert (disk / "metrics.json").read_text() == '{\n  "a": 1\n}\n'
    assert bundle.describe(disk / "bundle")["card"] == {}
    assert Checkpoints().load_checkpoint(disk / "last.ckpt")["a"].shape == (10,)


def test_training_on_a_full_disk_says_so_and_goes_on_when_there_is_room(disk, tmp_path):
    samples.write_cases(data := tmp_path / "data")
    fill(disk)
    with pytest.raises((StorageError, OSError), match=r"No space left"):
        samples.train(data, disk / "run")
    (disk / "filler").unlink()
    samples.train(data, disk / "run")
    samples.train(data, tmp_path / "once")
    one, two = (bundle.load(folder / "bundle").state_dict() for folder in (disk / "run", tmp_path / "once"))
    assert all(torch.equal(one[key], two[key]) for key in one)


@pytest.mark.parametrize("spoil", [fill, lock])
def test_a_command_ends_with_a_message_and_status_1(disk, spoil, tmp_path):
    spoil(disk)
    short = ["experiment=hopper", "training.updates=1", "data.test_fraction=0", f"hydra.run.dir={disk / 'run'}"]
    log = tmp_path / "run.log"
    assert wait(command(lambda _: ["train.py", *short])(tmp_path / "run")) != 0
    assert "StorageError" in log.read_text()
    assert "remedy" in log.read_text()
    assert "Traceback" not in log.read_text()


@pytest.mark.yade
@pytest.mark.skipif(shutil.which("yade") is None, reason="Yade is not installed (apt-get install yade)")
def test_generating_on_a_full_disk_leaves_the_finished_cases(disk, tmp_path):
    fill(disk)
    short = ["scene=hopper_small", "scene.duration_s=0.05", f"out={disk}", f"hydra.run.dir={tmp_path / 'hydra'}"]
    assert wait(command(lambda _: ["-m", "data_gen.generate", *short])(tmp_path / "run")) != 0
    assert "No space left" in (tmp_path / "run.log").read_text() or "errno = 28" in (tmp_path / "run.log").read_text()
    assert names(disk) == []


def test_a_folder_serves_one_run_at_a_time(tmp_path):
    hold = f"""
import time, pathlib
from gns_pyg.files import held
with held(pathlib.Path({str(tmp_path)!r})):
    print("held", flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", hold], cwd=ROOT, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(ConfigError, match="in use by another process"), held(tmp_path):
            pass
        other.kill()
    with held(tmp_path):
        pass


def test_a_second_command_in_a_run_folder_is_refused(tmp_path):
    folder = tmp_path / "run"
    words = ["train.py", "experiment=hopper", "training.updates=1", f"hydra.run.dir={folder}"]
    with held(folder):
        assert wait(command(lambda _: words)(folder)) != 0
    assert f"{folder}: in use by another process" in folder.with_suffix(".log").read_text()
    assert not (folder / "checkpoints").exists()


def test_a_folder_whose_replacement_was_killed_between_its_renames_is_back(tmp_path):
    ended = subprocess.Popen(["true"])
    ended.wait()
    path = tmp_path / "bundle"
    kept = unfinished(path).name.replace(f".{os.getpid()}.part", f".{ended.pid}.old")
    (tmp_path / kept).mkdir()
    (tmp_path / kept / "bundle.json").write_text("old")
    with pytest.raises(StorageError), whole(path):
        raise OSError("no room")
    assert (path / "bundle.json").read_text() == "old"
    with whole(path) as temporary:
        temporary.mkdir()
    assert names(tmp_path) == ["bundle"]
    assert names(path) == []


def test_jobs_on_one_folder_and_readers_beside_them_see_whole_files(tmp_path):
    """Two writers of the same files and a reader, all at once, for a second."""
    code = f"""
import sys, time, pathlib
sys.path.insert(0, {str(ROOT)!r})
from gns_pyg.evaluation.metrics import write_json
from tests.faults.test_storage import write
folder, end = pathlib.Path({str(tmp_path)!r}), time.monotonic() + 2
while time.monotonic() < end:
    write(folder / "case_000.h5", 20, 10)
    write_json(folder / "rows.json", list(range(1000)))
"""
    writers = [subprocess.Popen([sys.executable, "-c", code], cwd=ROOT) for _ in range(2)]
    seen = 0
    while any(writer.poll() is None for writer in writers):
        if (path := tmp_path / "case_000.h5").exists():
            case = Trajectory(path)
            with h5py.File(path) as file:  # one opening: what is read belongs to one file
                assert file["particles/grains/position/value"].shape == (10, 20, 3)
            assert case.n_frames == 10
            seen += 1
    assert [writer.returncode for writer in writers] == [0, 0]
    assert seen > 20
    assert names(tmp_path) == ["case_000.h5", "rows.json"]


def fail_halfway(path):
    path.write_text("half")
    raise DataError("a", "b", "c", "d")


def test_whole_takes_nothing_from_an_error_of_ours(tmp_path):
    with pytest.raises(DataError, match="remedy"), whole(tmp_path / "file") as temporary:
        fail_halfway(temporary)
    assert names(tmp_path) == []
