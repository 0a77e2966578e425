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
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.phases import paper_wide
from gns_pyg import machine
from gns_pyg.dynamics.execution import Execution
from gns_pyg.state import State

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
    simulator, bed = paper_wide("drum", 150, 1)
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


def side_by_side(state: State, copies: int) -> State:
    """Copies of a bed, next to each other along three axes."""
    extent = state.pos.amax(0) - state.pos.amin(0) + 2 * state.radius.max()
    side = math.ceil(copies ** (1 / 3))
    places = torch.cartesian_prod(*[torch.arange(side)] * 3)[:copies].to(extent) * extent
    return replace(
        state,
        pos=(state.pos + places[:, None]).flatten(0, 1),
        vel=state.vel.repeat(copies, 1),
        ang_vel=None if state.ang_vel is None else state.ang_vel.repeat(copies, 1),
        radius=state.radius.repeat(copies),
        batch=state.batch.repeat(copies),
    )


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
