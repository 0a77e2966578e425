"""The long fault run: `python -m tests.faults` (about 40 minutes of a core) writes docs/reliability.json and the
figures in docs/reliability.md; parts of it, `python -m tests.faults training sweep mesh.stl`, may run side by side."""

import fcntl
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from gns_pyg.evaluation.metrics import write_json
from tests.faults import kills, mutations, samples
from tests.faults.page import PAGE, RESULT, with_figures

FILES = {"trajectory.h5": 6500, "scene.yaml": 2300, "mesh.stl": 1400, "bundle": 600, "checkpoint.ckpt": 150}


def main(folder: Path, parts: list[str]) -> None:
    began = time.monotonic()
    for name, (work, n) in kills.works(folder / "kills").items() if not parts or {*parts} - {*FILES} else ():
        if not parts or name in parts:
            hit, recovered, wrong = kills.campaign(work, folder / "kills" / name.replace(" ", "_"), n, seed=n)
            record("killed", name, {"kills": hit, "recovered": recovered, "wrong": wrong})
            print(name, hit, recovered, *wrong, f"{time.monotonic() - began:.0f} s", sep="\n   ", flush=True)
    if not parts or {*parts} & {*FILES}:
        samples.write_samples(folder / "samples")
    for name, n in FILES.items():
        if not parts or name in parts:
            counts, wrong, peak_mb = mutations.check(name, folder / "samples", folder / "mutated" / name, range(n))
            told = {"peak_memory_mb": round(peak_mb), "unexpected": {str(seed): text for seed, text in wrong.items()}}
            record("opened", name, found := {"files": n, **counts, **told})
            print(name, found, f"{time.monotonic() - began:.0f} s", flush=True)


def record(part: str, name: str, entry: dict[str, Any]) -> None:
    """Adds what was found to reliability.json, and sums up; the other part may do so at the same time."""
    with Path(__file__).open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        found = json.loads(RESULT.read_text()) if RESULT.exists() else {"killed": {}, "opened": {}}
        found[part][name] = entry
        killed, opened = found["killed"].values(), found["opened"].values()
        found["kills"] = sum(each["kills"] for each in killed)
        found["kills_recovered"] = sum(each["recovered"] for each in killed)
        found["mutated_files"] = sum(each["files"] for each in opened)
        found["unexpected_errors"] = sum(len(each["unexpected"]) for each in opened)
        found["peak_memory_mb"] = max((each["peak_memory_mb"] for each in opened), default=None)
        write_json(RESULT, found)
        PAGE.write_text(with_figures(PAGE.read_text(encoding="utf-8"), found), encoding="utf-8")


if __name__ == "__main__":
    torch.set_num_threads(1)  # forks have none of their parent's threads and would wait for them for ever
    with tempfile.TemporaryDirectory() as place:
        main(Path(place), sys.argv[1:])
