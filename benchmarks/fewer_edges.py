"""What fewer edges save in time: `python -m benchmarks.fewer_edges scene=hopper ...`.

Steps an untrained simulator from recorded states of a scene's first case, with all edges, with
`requires.touching_pairs`, with `requires.nearest_points` and with both, side by side, on one thread. Times do not
depend on the weights; what the rows cost in accuracy does, and is in docs/tradeoff.md ("Fewer edges, fewer rounds").
Keys are train.py's, for example

    python -m benchmarks.fewer_edges scene=hopper model=contact model.hidden=128 data.dir=...    # the paper's width
    python -m benchmarks.fewer_edges scene=hopper scene.frame_dt_s=0.0025 data.dir=...           # as hopper_full

Adds rows to benchmarks/results/fewer_edges.json.
"""

import json
import sys
from pathlib import Path
from statistics import mean
from typing import Any

import torch

from benchmarks.requirements import n_edges, timed
from benchmarks.untrained import untrained
from gns_pyg import machine
from gns_pyg.data.windows import read_window

OUT = Path(__file__).parent / "results" / "fewer_edges.json"
WAYS: dict[str, dict[str, Any]] = {
    "all edges": {},
    "touching_pairs": {"touching_pairs": True},
    "nearest_points": {"nearest_points": True},
    "both": {"touching_pairs": True, "nearest_points": True},
}
STATES = 8


def main() -> None:
    torch.set_num_threads(1)
    (case,), simulator_with = untrained(*sys.argv[1:])
    simulators = [simulator_with(**forced) for forced in WAYS.values()]
    scene, model = simulators[0].scene, simulators[0].config
    frames = torch.linspace(0, case.n_frames - 3, STATES).long().tolist()
    states = [simulators[0].integrator.read(read_window(case, frame, 3), 1) for frame in frames]
    ms = timed([(simulator, states) for simulator in simulators])
    about = {"scene": scene.name, "network": model.network, "width": model.hidden, "rounds": model.layers}
    about |= {"frame_ms": round(1e3 * scene.frame_dt_s, 3), "machine": machine.processor()}
    rows: list[dict[str, Any]] = []
    for way, simulator, of_step in zip(WAYS, simulators, ms, strict=True):
        edges = round(mean(n_edges(simulator, state) for state in states))
        rows.append({**about, "way": way, "edges": edges, "ms": of_step, "of_all": round(of_step / ms[0], 3)})
        print(json.dumps(rows[-1]), flush=True)
    others = json.loads(OUT.read_text()) if OUT.exists() else []
    same = ("scene", "network", "width", "frame_ms")
    kept = [row for row in others if any(row[key] != rows[0][key] for key in same)]
    OUT.write_text(json.dumps([*kept, *rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
