"""Where a step's time goes: `python -m benchmarks.phases`.

    python -m data_gen.generate scene=drum case=0 scene.dem.dt_s=auto scene.duration_s=0.5    # first

Steps an untrained simulator of the paper's width from recorded states of the full-size drum, another one in every
round, then 10 and 100 such drums, walls and all, as one batch; on one thread. Writes benchmarks/results/phases.json:
medians of the milliseconds of every phase.
"""

import json
import math
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

import torch

from benchmarks.untrained import untrained
from gns_pyg import machine
from gns_pyg.data.windows import read_window
from gns_pyg.dynamics import simulator as steps
from gns_pyg.dynamics.boundary import BoundaryPart
from gns_pyg.dynamics.integrator import Integrator
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.evaluation.predict import perturbed
from gns_pyg.graph import features
from gns_pyg.state import State

OUT = Path(__file__).parent / "results" / "phases.json"
PHASES: dict[str, list[tuple[Any, str]]] = {
    "neighbour search": [(Simulator, "pairs_in_reach"), (BoundaryPart, "within")],
    "walls placed": [(BoundaryPart, "at")],
    "who flies free": [(steps, "can_touch"), (steps, "among")],
    "features": [
        (features, "grain_edges"),
        (features, "wall_edges"),
        (Simulator, "_grain_features"),
        (Simulator, "_wall_features"),
    ],
    "integration": [(Integrator, "integrate")],
}
NETWORKS = {"boundary network": "wall_network", "particle network": "grain_network"}
ROUNDS, FRAME, EARLY = 9, 150, 40  # EARLY: what a short run has too


def main() -> None:
    torch.set_num_threads(1)
    rows = [profile(copies) for copies in (1, 10, 100)]
    OUT.write_text(json.dumps({"machine": machine.processor(), "rows": rows}, indent=1) + "\n")
    print(table(rows))


@torch.inference_mode()
def profile(copies: int) -> dict[str, Any]:
    rounds = max(3, ROUNDS // copies) + 1
    simulator, *states = paper_wide("drum", *range(EARLY, EARLY + rounds))
    states = [perturbed(state, copies, 0.0, seed=0) for state in states]
    seconds: dict[str, list[float]] = defaultdict(list)
    walls: list[float] = []
    for state in states:
        spent: dict[str, float] = defaultdict(float)
        patches = [
            patch.object(owner, name, timed(getattr(owner, name), spent, phase))
            for phase, owner, name in hooks(simulator)
        ]
        for change in patches:
            change.start()
        begin = time.perf_counter()
        simulator(state)
        walls.append(time.perf_counter() - begin)
        for change in patches:
            change.stop()
        for phase in (*PHASES, *NETWORKS):
            seconds[phase].append(spent[phase])
    row: dict[str, Any] = {"grains": len(state.pos), "edges": n_edges(simulator, state)}
    row["step_ms"] = round(1e3 * median(walls[1:]), 2)
    for phase, values in seconds.items():
        row[f"{phase}, ms"] = round(1e3 * median(values[1:]), 2)
    return row


def hooks(simulator: Simulator) -> list[tuple[str, Any, str]]:
    networks = [(phase, getattr(simulator, name), "forward") for phase, name in NETWORKS.items()]
    return [(phase, owner, name) for phase, places in PHASES.items() for owner, name in places] + networks


def timed(function: Callable, spent: dict[str, float], phase: str) -> Callable:
    def call(*args: Any, **kwargs: Any) -> Any:
        begin = time.perf_counter()
        result = function(*args, **kwargs)
        spent[phase] += time.perf_counter() - begin
        return result

    return call


def paper_wide(name: str, *frames: int) -> tuple[Any, ...]:
    """An untrained simulator of width 128 and recorded states of a scene."""
    (case,), simulator_of = untrained(f"scene={name}", "model=contact", "model.hidden=128")
    simulator = simulator_of()
    return simulator, *(simulator.integrator.read(read_window(case, frame, 2), 1) for frame in frames)


def side_by_side(state: State, copies: int) -> State:
    """Copies of a bed, next to each other along three axes."""
    extent = state.pos.amax(0) - state.pos.amin(0) + 2 * state.radius.max()
    side = math.ceil(copies ** (1 / 3))
    places = torch.cartesian_prod(*[torch.arange(side)] * 3)[:copies].to(extent) * extent
    return replace(
        state,
        pos=(state.pos + places[:, None]).flatten(0, 1),
        vel=state.vel.repeat(copies, 1),
        drift=None if state.drift is None else state.drift.repeat(copies, 1),
        ang_vel=None if state.ang_vel is None else state.ang_vel.repeat(copies, 1),
        radius=state.radius.repeat(copies),
        batch=state.batch.repeat(copies),
    )


def n_edges(simulator: Simulator, state: State) -> int:
    graph = simulator.graph(state)
    return graph.grain_edges.shape[1] + graph.wall_edges.shape[1]


def table(rows: list[dict[str, Any]]) -> str:
    """The results as Markdown: milliseconds, and shares of the step."""
    phases = (*PHASES, *NETWORKS)
    lines = ["| grains | edges | step, ms | " + " | ".join(phases) + " | rest |", "|---" * (4 + len(phases)) + "|"]
    for row in rows:
        spent = [row[f"{phase}, ms"] for phase in phases]
        cells = [f"{ms:.1f} ({ms / row['step_ms']:.0%})" for ms in [*spent, row["step_ms"] - sum(spent)]]
        lines.append(f"| {row['grains']:,} | {row['edges']:,} | {row['step_ms']:.0f} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
