"""Time and memory against the number of grains: `python -m benchmarks.scaling`.

Copies of a recorded drum bed (generate case 0 of the full-size drum first), put beside each other in space without
walls, are stepped by an untrained simulator of the paper's width on one thread. Each size runs in a process of its own,
so that its peak memory can be told. From TILE grains on, tiles are used. Writes benchmarks/results/scaling.json.
"""

import json
import math
import resource
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.phases import FRAME, paper_wide, side_by_side
from gns_pyg import machine
from gns_pyg.dynamics.execution import Execution

OUT = Path(__file__).parent / "results" / "scaling.json"
SIZES = {2_530: 9, 25_300: 5, 253_000: 3, 1_001_880: 2}  # grains: counted steps
TILE = 125_000


def main() -> None:
    if sys.argv[1:]:
        print(json.dumps(measured(int(sys.argv[1]))))
        return
    rows = []
    for n_grains in SIZES:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.scaling", str(n_grains)], capture_output=True, text=True, check=True
        )
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(rows[-1], flush=True)
    first, last = rows[0], rows[-1]
    exponent = math.log(last["seconds"] / first["seconds"]) / math.log(last["grains"] / first["grains"])
    found = {"machine": machine.processor(), "threads": 1, "exponent": round(exponent, 3), "rows": rows}
    OUT.write_text(json.dumps(found, indent=1) + "\n")
    print(table(found))


@torch.inference_mode()
def measured(n_grains: int) -> dict[str, Any]:
    """Median seconds of a step, after one that warms up, and the process's peak memory."""
    torch.set_num_threads(1)
    simulator, bed = paper_wide("drum", FRAME)
    simulator.boundary = simulator.wall_network = None
    state = side_by_side(bed, n_grains // len(bed.pos))
    simulator.execution = Execution(tile_grains=TILE)
    seconds = []
    for _ in range(SIZES[n_grains] + (n_grains < TILE)):
        begin = time.perf_counter()
        simulator(state)
        seconds.append(time.perf_counter() - begin)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    edges = simulator.edges_done // len(seconds)
    row = {
        "grains": len(state.pos),
        "edges_with_margins": edges,
        "seconds": round(median(seconds[n_grains < TILE :]), 3),
    }
    return row | {"peak_memory_gib": round(peak, 2), "tiles": len(state.pos) > TILE}


def table(found: dict[str, Any]) -> str:
    """The results as Markdown."""
    lines = [
        "| grains | edges, margins of tiles too | seconds per step | microseconds per grain | peak memory, GiB |",
        "|---" * 5 + "|",
    ]
    for row in found["rows"]:
        each = 1e6 * row["seconds"] / row["grains"]
        cells = [f"{row['grains']:,}", f"{row['edges_with_margins']:,}", f"{row['seconds']:.3g}", f"{each:.0f}"]
        lines.append(f"| {' | '.join(cells)} | {row['peak_memory_gib']:.2f} |")
    return "\n".join([*lines, f"\nGrowth exponent: {found['exponent']}."])


if __name__ == "__main__":
    main()
