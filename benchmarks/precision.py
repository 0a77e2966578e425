"""What fewer bits buy and cost: `python -m benchmarks.precision bundle`.

Evaluates a bundle trained on the embedded hopper (`python train.py experiment=hopper`) at each precision that this
machine computes in, and times the paper's width on a full-size drum state (generate its case 0 first), in turn. One
thread. Writes benchmarks/results/precision.json.
"""

import json
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.ablation import FIGURES, figures
from benchmarks.phases import FRAME, paper_wide
from benchmarks.transfer import config
from gns_pyg import machine, run
from gns_pyg.dynamics.execution import Execution

OUT = Path(__file__).parent / "results" / "precision.json"
PRECISIONS, ROUNDS = ("float32", "bfloat16"), 9


def main() -> None:
    torch.set_num_threads(1)
    ms = timed()
    rows = []
    for precision in PRECISIONS:
        with tempfile.TemporaryDirectory() as folder:
            choices = [f"bundle={sys.argv[1]}", f"folder={folder}", f"execution.precision={precision}"]
            metrics = run.evaluate(config("evaluate", *choices))
        rows.append({"precision": precision, "step_ms": ms[precision], "metrics": metrics})
    OUT.write_text(json.dumps({"machine": machine.processor(), "rows": rows}, indent=1) + "\n")
    print(table(rows))


@torch.inference_mode()
def timed() -> dict[str, float]:
    """Median milliseconds of a step."""
    simulator, *states = paper_wide("drum", *range(FRAME, FRAME + ROUNDS + 1))
    ms: dict[str, list[float]] = {precision: [] for precision in PRECISIONS}
    for state in states:
        for precision in PRECISIONS:
            simulator.execution = Execution(precision)
            begin = time.perf_counter()
            simulator(state)
            ms[precision].append(1e3 * (time.perf_counter() - begin))
    return {precision: round(median(values[1:]), 1) for precision, values in ms.items()}


def table(rows: list[dict[str, Any]]) -> str:
    """The results as Markdown."""
    columns = ["precision", "ms per step, full-size drum, width 128", *FIGURES]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for row in rows:
        cells = [row["precision"], f"{row['step_ms']:.0f}", *figures(row["metrics"])]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
