"""The long fault run: `python -m tests.faults` (about 40 minutes of a core) writes docs/reliability.json; its parts,
`python -m tests.faults kills` and `... mutations`, may run side by side."""

import fcntl
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from gns_pyg.evaluation.metrics import write_json
from tests.faults import kills, mutations, samples

FILES = {"trajectory.h5": 6500, "bundle": 1000, "scene.yaml": 2200, "mesh.stl": 1500, "checkpoint.ckpt": 200}
RESULT = Path(__file__).parents[2] / "docs" / "reliability.json"


def main(folder: Path, parts: list[str]) -> None:
    began = time.monotonic()
    if "kills" in parts:
        for name, (work, n) in kills.works(folder / "kills").items():
            hit, recovered, wrong = kills.campaign(work, folder / "kills" / name.replace(" ", "_"), n, seed=n)
            record("killed", name, {"kills": hit, "recovered": recovered, "wrong": wrong})
            print(name, hit, recovered, *wrong, f"{time.monotonic() - began:.0f} s", sep="\n   ", flush=True)
    if "mutations" in parts:
        samples.write_samples(folder / "samples")
        for name, n in FILES.items():
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


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        main(Path(place), sys.argv[1:] or ["kills", "mutations"])
