"""The long fault run: `python -m tests.faults` (about 40 minutes on two cores) writes docs/reliability.json."""

import json
import resource
import sys
import tempfile
import time
from pathlib import Path

from gns_pyg.evaluation.metrics import write_json
from tests.faults import kills, mutations, samples

FILES = {"trajectory.h5": 5000, "bundle": 2500, "scene.yaml": 2000, "mesh.stl": 1500, "checkpoint.ckpt": 600}
RESULT = Path(__file__).parents[2] / "docs" / "reliability.json"


def main(folder: Path, parts: list[str]) -> None:
    found = json.loads(RESULT.read_text()) if RESULT.exists() else {"killed": {}, "opened": {}}
    began = time.monotonic()
    if "kills" in parts:
        for name, (work, n) in kills.works(folder / "kills").items():
            hit, recovered, wrong = kills.campaign(work, folder / "kills" / name.replace(" ", "_"), n, seed=n)
            found["killed"][name] = {"kills": hit, "recovered": recovered, "wrong": wrong}
            print(name, hit, recovered, *wrong, f"{time.monotonic() - began:.0f} s", sep="\n   ", flush=True)
    if "mutations" in parts:
        samples.write_samples(folder / "samples")
        for name, n in FILES.items():
            counts, wrong, peak_mb = mutations.check(name, folder / "samples", folder / "mutated" / name, range(n))
            told = {"peak_memory_mb": round(peak_mb), "unexpected": {str(seed): text for seed, text in wrong.items()}}
            found["opened"][name] = {"files": n, **counts, **told}
            print(name, found["opened"][name], f"{time.monotonic() - began:.0f} s", flush=True)
    found["kills"] = sum(each["kills"] for each in found["killed"].values())
    found["kills_recovered"] = sum(each["recovered"] for each in found["killed"].values())
    found["mutated_files"] = sum(each["files"] for each in found["opened"].values())
    found["unexpected_errors"] = sum(len(each["unexpected"]) for each in found["opened"].values())
    found["peak_memory_mb"] = max(
        [each["peak_memory_mb"] for each in found["opened"].values()]
        or [resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024]
    )
    write_json(RESULT, found)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        main(Path(place), sys.argv[1:] or ["kills", "mutations"])
