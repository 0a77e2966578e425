"""Kills commands at random moments and gives them again: what is left must be whole, the end must be as if nothing had
been. Work in process is done in a fork, so that few of the kills fall into the loading of libraries."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file

from data_gen import generate
from gns_pyg import run
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.files import UNFINISHED
from gns_pyg.training.checkpoint import Checkpoints
from tests.faults import samples

ROOT = Path(__file__).parents[2]
CHANGING = (
    "wall_clock_s",
    "cpu_time_s",
    "training_s",
    "speed/",
    "test/factor_yade",
    "break_even",
)  # times differ from run to run


@dataclass(frozen=True)
class Work:
    """Something that writes to a folder.

    Attributes:
        start: starts it on a folder in a process group of its own; returns its process number.
        result: what must be equal in the end, by name.
    """

    start: Callable[[Path], int]
    result: Callable[[Path], dict[str, Any]]


def unsound(folder: Path) -> list[str]:
    """Files under their final names that are not whole; unfinished ones have names that begin with a dot."""
    wrong = []
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if path.is_file() and not any(part.startswith(".") for part in parts):
            try:
                check_whole(path)
            except FileNotFoundError:
                pass  # an orphan of the kill finished or gave up in this moment
            except Exception as error:
                wrong.append(f"{path.relative_to(folder)}: {type(error).__name__}: {error}")
    return wrong


def check_whole(path: Path) -> None:
    """Raises an error unless the file is complete."""
    match path.suffix:
        case ".h5":
            Trajectory(path)
        case ".json":
            json.loads(path.read_text())
        case ".ckpt":
            Checkpoints().load_checkpoint(path)
        case ".safetensors":
            load_file(path)
        case ".html" | ".svg":
            assert path.read_text().rstrip().endswith(f"</{path.suffix[1:]}>"), "cut off"
        case ".png":
            assert b"IEND" in path.read_bytes()[-12:], "cut off"


def forked(function: Callable[[Path], Any]) -> Callable[[Path], int]:
    """Starts `function` in a fork of this process, silent."""

    def start(folder: Path) -> int:
        sys.stdout.flush()
        child = os.fork()
        if child:
            return child
        os.setsid()
        os.chdir(ROOT)
        log = os.open(folder.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        try:
            function(folder)
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(1)
        os._exit(0)

    return start


def command(words: Callable[[Path], list[str]]) -> Callable[[Path], int]:
    """Starts a command line as a person would."""

    def start(folder: Path) -> int:
        with folder.with_suffix(".log").open("w") as log:
            environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
            popen = subprocess.Popen(
                [sys.executable, *words(folder)],
                cwd=ROOT,
                env=environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        popen.returncode = 0  # `wait` below is who waits for it
        return popen.pid

    return start


def wait(pid: int, seconds: float | None = None) -> int | None:
    """The exit status of a child, or None if it still runs after so long."""
    end = None if seconds is None else time.monotonic() + seconds
    while True:
        done, status = os.waitpid(pid, 0 if end is None else os.WNOHANG)
        if done:
            return status
        if end is not None and time.monotonic() > end:
            return None
        time.sleep(0.002)


def kill(pid: int, family: bool) -> None:
    """kill -9 of a process, or of it and all that it started."""
    pids = [pid, *(descendants(pid) if family else [])]
    for one in pids:
        with suppress(ProcessLookupError):
            os.kill(one, signal.SIGKILL)
    os.waitpid(pid, 0)


def descendants(pid: int) -> list[int]:
    try:
        children = [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except FileNotFoundError:
        return []
    return [each for child in children for each in (child, *descendants(child))]


def campaign(work: Work, folder: Path, kills: int, seed: int, per_round: int = 4) -> tuple[int, int, list[str]]:
    """Kills the work `kills` times, `per_round` times on the way to each end.

    Returns:
        How many kills hit it at work, how many of those left whole files and a way to the right end, what went wrong.
    """
    random = np.random.default_rng(seed)
    began = time.monotonic()
    if wait(work.start(reference := prepared(folder / "reference"))):
        return 0, 0, [f"the reference failed: {reference.with_suffix('.log').read_text()[-1000:]}"]
    took_s, wanted, wrong, hit, recovered = time.monotonic() - began, work.result(reference), [], 0, 0
    while hit < kills:
        here, in_round, told = prepared(folder / "killed"), 0, []
        for _ in range(min(per_round, kills - hit)):
            pid = work.start(here)
            if wait(pid, float(random.uniform(0, took_s))) is None:
                kill(pid, family=bool(random.random() < 0.5))
                in_round += 1
                told += unsound(here)
        status = wait(work.start(here))
        if status:
            told.append(f"status {status}: {here.with_suffix('.log').read_text()[-1000:]}")
        else:
            told += differences(wanted, work.result(here)) + leftovers(here)
        hit += in_round
        recovered += 0 if told else in_round
        wrong += told
        if len(wrong) > 20:
            break
    return hit, recovered, wrong


def leftovers(folder: Path, seconds: float = 20) -> list[str]:
    """Unfinished files that stay when all is done; an orphan of a kill may need a moment to go."""
    end = time.monotonic() + seconds
    while found := [f"{path.name} is left" for path in folder.rglob(".*") if path.suffix in UNFINISHED]:
        if time.monotonic() > end:
            break
        time.sleep(0.1)
    return found


def prepared(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def differences(one: Any, two: Any, at: str = "") -> list[str]:
    """Where nested values are not bitwise the same."""
    if type(one) is not type(two):
        return [f"{at}: {one!r:.80} became {two!r:.80}"]
    if isinstance(one, dict):
        missing = [f"{at}/{key}: only {'before' if key in one else 'now'}" for key in sorted(one.keys() ^ two.keys())]
        return missing + [t for key in one.keys() & two.keys() for t in differences(one[key], two[key], f"{at}/{key}")]
    if isinstance(one, list | tuple):
        if len(one) != len(two):
            return [f"{at}: {one!r:.300} became {two!r:.300}"]
        return [text for n, pair in enumerate(zip(one, two, strict=True)) for text in differences(*pair, f"{at}/{n}")]
    if isinstance(one, torch.Tensor):
        equal = torch.equal(one, two)
    else:
        equal = np.array_equal(one, two) if isinstance(one, np.ndarray) else bool(one == two)
    return [] if equal else [f"{at}: {one!r:.80} became {two!r:.80}"]


def files(folder: Path) -> list[str]:
    """Names of the files, without logs (one for every start) and what Hydra notes of each start."""
    names = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return sorted(str(n) for n in names if not any(part.startswith((".", "log", "multirun")) for part in n.parts))


def steady(values: Any) -> Any:
    """`values` without what differs from run to run: times, and where the run lies."""
    if isinstance(values, dict):
        return {k: steady(v) for k, v in values.items() if not any(part in k for part in CHANGING)}
    return [steady(value) for value in values] if isinstance(values, list) else values


def training_result(folder: Path) -> dict[str, Any]:
    checkpoint = Checkpoints().load_checkpoint(folder / "checkpoints" / "last.ckpt")
    card = json.loads((folder / "bundle" / "bundle.json").read_text())
    return {
        "weights": load_file(folder / "bundle" / "weights.safetensors"),
        "checkpoint": {key: checkpoint[key] for key in ("state_dict", "optimizer_states", "lr_schedulers", "identity")},
        "bundle.json": steady(card),
        "metrics": steady(json.loads((folder / "metrics.json").read_text())),
        "files": files(folder),
    }


def run_result(path: Path) -> dict[str, Any]:
    case = Trajectory(path)
    fields = ("position", "velocity", "angular_velocity")
    return {"values": [case.read(name) for name in fields], "times": case.times_s, "scene": case.scene}


def works(folder: Path) -> dict[str, tuple[Work, int]]:
    """What is killed, on data that is written to `folder`, and how often in the long run; the sweep and data
    generation from their command lines on."""
    data, tiny = folder / "data", folder / "tiny"
    if not data.exists():
        samples.write_cases(data, 4)
        samples.train(data, tiny, "data.test_fraction=0.2")
    bundle, case = f"bundle={tiny / 'bundle'}", f"trajectory={data / 'case_003.h5'}"

    def train(to: Path) -> None:
        samples.train(data, to, "data.test_fraction=0.2", "data.val_cases=1", "training.updates=40")

    def roll_out(to: Path) -> None:
        run.rollout(samples.config("rollout", to, None, bundle, case, "start_s=0.02"))

    def evaluate(to: Path) -> None:
        run.evaluate(samples.config("evaluate", to, None, bundle, f"data.dir={data}", "start_s=0.02"))

    def judged(to: Path) -> dict[str, Any]:
        return {"files": files(to), "metrics": steady(json.loads((to / "metrics.json").read_text()))}

    def make(to: Path) -> None:
        short = ["scene.duration_s=0.05", "case=0", f"out={to}", f"hydra.run.dir={to.with_suffix('.hydra')}"]
        sys.argv = ["gns-generate", "scene=hopper_small", *short]
        generate.main()

    def sweep(to: Path) -> list[str]:
        tiny_models = ["experiment=hopper", "model.hidden=4,6", "model.layers=1", "training.updates=12"]
        fast = ["data.test_fraction=0", "callbacks.checkpoint.every_n_train_steps=4", f"hydra.sweep.dir={to}"]
        return ["train.py", "-m", *tiny_models, *fast]

    found = {
        "training": (Work(forked(train), training_result), 70),
        "roll-out": (Work(forked(roll_out), lambda to: run_result(to / "rollout.h5")), 80),
        "report": (Work(forked(evaluate), judged), 30),
        "sweep": (Work(command(sweep), lambda to: {job: training_result(to / job) for job in "01"}), 16),
    }
    if shutil.which("yade"):
        found["data generation"] = (Work(forked(make), lambda to: run_result(to / "case_000.h5")), 16)
    return found
