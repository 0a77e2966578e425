"""Training on regions of a scene against training on all of it: `python -m benchmarks.regions [seconds]`.

Trains the default model on the full-size hopper (generate cases 0 to 4 first) for the same processor time, with the
gradient of all grains and with that of a region of each window, every run in a process of its own, and writes
benchmarks/results/regions.json: updates, peak memory and error on an unseen case.
"""

import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

from benchmarks.ablation import FIGURES, TRIAL, Clock, figures, train
from gns_pyg import machine

OUT = Path(__file__).parent / "results" / "regions.json"
VARIANTS = {"all grains": "null", "300 grains": "300", "30 grains": "30"}
SECONDS = 300.0
DATA = ["data.val_cases=0", "data.test_fraction=0.25"]


def main() -> None:
    torch.set_num_threads(1)
    if len(sys.argv) > 2:
        print(json.dumps(trained(sys.argv[2], float(sys.argv[1]))))
        return
    rows = []
    for name in VARIANTS:
        seconds = sys.argv[1] if sys.argv[1:] else str(SECONDS)
        command = [sys.executable, "-m", "benchmarks.regions", seconds, name]
        rows.append(
            json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()[-1])
        )
        OUT.write_text(json.dumps({"machine": machine.processor(), "rows": rows}, indent=1) + "\n")
    print(table(rows))


def trained(name: str, seconds: float) -> dict[str, Any]:
    """One variant."""
    common = [*DATA, f"training.region_grains={VARIANTS[name]}"]
    few = TRIAL // 3
    train("hopper", *common, f"training.updates={few}", "training.unroll_from=0", "data.test_fraction=0")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    updates = int(seconds * few / Clock.seconds)
    metrics = train("hopper", *common, f"training.updates={updates}")
    row = {"variant": name, "updates": updates, "training_cpu_s": round(Clock.seconds, 1)}
    return row | {"peak_memory_gib": round(peak, 2), "metrics": metrics}


def table(rows: list[dict[str, Any]]) -> str:
    """The results as Markdown."""
    columns = ["gradient of", "updates", "training, CPU s", "peak memory, GiB", *FIGURES]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for row in rows:
        cost = [str(row["updates"]), f"{row['training_cpu_s']:.0f}", f"{row['peak_memory_gib']:.2f}"]
        lines.append(f"| {' | '.join([row['variant'], *cost, *figures(row['metrics'])])} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
