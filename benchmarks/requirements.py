"""What leaving out saves, per scene and row: `python benchmarks/requirements.py [scene ...]`.

Steps an untrained simulator of the default size from recorded states of each scene, once as the scene requires it
("with" the row) and once with that row forced the other way ("without"), side by side, on one thread, and writes
benchmarks/results/requirements.json. Grains that fly free are compared with Yade's next frame too.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Any

import torch

from benchmarks.untrained import untrained
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import read_window
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.state import State

SCENES = (
    *("hopper_small", "drum_small", "pile", "free", "inclined_drum", "hopper_discharge", "silo_stl"),
    *("drum_bidisperse", "hopper_friction"),
)
ROWS = {  # row -> whether leaving it out changes nothing at all
    "wall_network": True,
    "wall_velocity": True,
    "wall_friction": False,
    "static_walls": True,
    "reachable_points": True,
    "free_grains": False,
    "free_grains (first 0.2 s)": False,
    "radius_features": False,
    "material_features": False,
    "active_mask": True,
}
OF_WALLS = ("wall_velocity", "wall_friction", "static_walls", "reachable_points")
COLUMNS = {"parameters": ",", "edges": ",.0f", "ms": ".1f"}
FRAMES, ROUNDS, EARLY_S = 12, 15, 0.2
OUT = Path(__file__).parent / "results" / "requirements.json"


def main() -> None:
    torch.set_num_threads(1)
    for name in sys.argv[1:] or SCENES:
        others = [row for row in json.loads(OUT.read_text()) if row["scene"] != name] if OUT.exists() else []
        results = sorted([*others, *of_scene(name)], key=lambda row: SCENES.index(row["scene"]))
        OUT.write_text(json.dumps(results, indent=1) + "\n")
    print(table(results))


def of_scene(name: str) -> list[dict[str, Any]]:
    """The rows that the scene does without, and what each saves."""
    (case, *_), simulator = untrained(f"scene={name}", "model=contact", first=3)
    own = simulator()
    last, early = case.n_frames - 3, int(EARLY_S / own.scene.frame_dt_s) - 1
    rows = []
    for row, exact in ROWS.items():
        row, _, when = row.partition(" ")
        prunes = row in ("static_walls", "reachable_points", "free_grains")
        if prunes != bool(getattr(own.requires, row)) or (row in OF_WALLS and own.boundary is None):
            continue
        starts = torch.linspace(0, early if when else last, FRAMES).long().tolist()
        states = other_states = [own.integrator.read(read_window(case, start, 3), 1) for start in starts]
        other = simulator(**{row: not prunes})
        if row == "active_mask":
            everyone = torch.ones(case.n_grains, dtype=torch.bool)
            other_states = [replace(state, active=everyone) for state in states]
        with_ms, without_ms = timed([(own, states), (other, other_states)])
        found: dict[str, Any] = {
            "scene": name,
            "row": f"{row} {when}".strip(),
            "exact": exact,
            "parameters_with": n_parameters(own),
            "parameters_without": n_parameters(other),
            "edges_with": mean(n_edges(own, state) for state in states),
            "edges_without": mean(n_edges(other, state) for state in states),
            "ms_with": with_ms,
            "ms_without": without_ms,
        }
        if row == "free_grains":
            found |= against_yade(own, other, case, early + 2 if when else last + 1)
        print(json.dumps(found), flush=True)
        rows.append(found)
    return rows


@torch.inference_mode()
def timed(pairs: list) -> list[float]:
    """Milliseconds per step: medians over rounds for every state, then their mean; the variants take turns."""
    ms = torch.zeros(len(pairs), len(pairs[0][1]), ROUNDS)
    for number in range(-1, ROUNDS):  # the first round warms up
        for place in range(ms.shape[1]):
            for index in sorted(range(len(pairs)), reverse=bool(number % 2)):
                simulator, states = pairs[index]
                begin = time.perf_counter()
                simulator(states[place])
                ms[index, place, number] = 1e3 * (time.perf_counter() - begin)
    return [round(value, 3) for value in ms.median(dim=2).values.mean(dim=1).tolist()]


def n_parameters(simulator: Simulator) -> int:
    return sum(parameter.numel() for parameter in simulator.parameters())


def n_edges(simulator: Simulator, state: State) -> int:
    graph = simulator.graph(state if state.active is None else state.pick(state.active))
    return graph.grain_edges.shape[1] + graph.wall_edges.shape[1]


def against_yade(own: Simulator, other: Simulator, case: Trajectory, n_frames: int) -> dict[str, float]:
    """Grains that fly free because of the row, and those that no edge reaches anyway, in the first frames: their share,
    how far Yade's next position is from free flight's, and the part that is hit (more than 0.1 mm off)."""
    n_grains, errors = 0, {"free": torch.empty(0), "alone": torch.empty(0)}
    for frame in range(min(n_frames, case.n_frames - 2)):
        window = read_window(case, frame, 3)
        state, following = (own.integrator.read(window, k) for k in (1, 2))
        there = torch.from_numpy(case.active(frame + 1, frame + 3).all(axis=0))
        state, following = state.pick(there), following.pick(there)
        error = (own.integrator.without_contact(state).pos - following.pos).norm(dim=1)
        outside, alone = (unreached(simulator, state) for simulator in (own, other))
        n_grains += len(alone)
        for name, grains in (("free", outside & ~alone), ("alone", alone)):
            errors[name] = torch.cat([errors[name], error[grains]])
    found: dict[str, float] = {}
    for name, error in errors.items():
        found[f"{name}_share"] = round(len(error) / n_grains, 4)
        found[f"{name}_error_mean_mm"] = round(1e3 * float(error.mean()), 4) if len(error) else 0.0
        found[f"{name}_error_median_mm"] = round(1e3 * float(error.median()), 4) if len(error) else 0.0
        found[f"{name}_hit_share"] = round(float((error > 1e-4).double().mean()), 4) if len(error) else 0.0
    return found


def unreached(simulator: Simulator, state: State) -> torch.Tensor:
    """Grains without an edge, bool (n_grains,)."""
    graph, alone = simulator.graph(state), torch.ones(len(state.pos), dtype=torch.bool)
    alone[graph.grain_edges[1]] = False
    alone[graph.wall_edges[1]] = False
    return alone


def table(results: list[dict[str, Any]]) -> str:
    """The results as Markdown."""
    lines = ["| scene | row | parameters | edges | ms per step | time saved |", "|---|---|---|---|---|---|"]
    for r in results:
        saved = 1 - r["ms_with"] / r["ms_without"]
        pairs = [f"{r[f'{key}_with']:{form}} / {r[f'{key}_without']:{form}}" for key, form in COLUMNS.items()]
        lines.append(f"| {' | '.join([r['scene'], r['row'], *pairs, f'{saved:.0%}'])} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
