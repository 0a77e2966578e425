"""What the margin of `requires.touching_pairs` misses: `python -m benchmarks.touching_pairs scene=hopper data.dir=...`.

Of up to 40 recorded states of a scene's first case: the share of pairs within the cutoff that stay edges, per margin
(grain radii), and the share of Yade's contacts, at the state or a frame later, whose pair would be none. Keys are
train.py's. Adds a row to benchmarks/results/touching_pairs.json.
"""

import json
import sys
from pathlib import Path

import torch

from benchmarks.untrained import untrained
from gns_pyg.data.windows import read_window
from gns_pyg.dynamics.free_grains import can_meet
from gns_pyg.state import State

MARGINS, STATES = (0.02, 0.05, 0.1, 0.2), 40
OUT = Path(__file__).parent / "results" / "touching_pairs.json"


def main() -> None:
    (case,), simulator_with = untrained(*sys.argv[1:])
    simulator = simulator_with(free_grains=False)
    scene = simulator.scene
    pairs, kept = 0, dict.fromkeys(MARGINS, 0)
    contacts, missed = 0, dict.fromkeys((None, *MARGINS), 0)
    for frame in range(1, case.n_frames - 2, max(1, case.n_frames // STATES)):
        window = read_window(case, frame - 1, 3)
        state, after = (simulator.integrator.read(window, k) for k in (1, 2))
        graph, free_pos = simulator.graph(state), simulator.integrator.without_contact(state).pos
        touch, edges = touching(state) | touching(after), graph.grain_edges
        pairs, contacts = pairs + edges.shape[1], contacts + int(touch.sum())
        missed[None] += without(touch, edges)
        for margin in MARGINS:
            near = edges[:, can_meet(state, free_pos, graph, scene.frame_dt_s, margin * state.radius)[0]]
            kept[margin] += near.shape[1]
            missed[margin] += without(touch, near)
    row = {"scene": scene.name, "frame_ms": round(1e3 * scene.frame_dt_s, 3), "contacts": contacts // 2}
    row |= {"missed_by_the_cutoff": round(missed[None] / contacts, 6)}
    row |= {f"kept_{m}": round(n / pairs, 4) for m, n in kept.items()}
    row |= {f"missed_{m}": round(missed[m] / contacts, 6) for m in MARGINS}
    others = json.loads(OUT.read_text()) if OUT.exists() else []
    same = [other for other in others if (other["scene"], other["frame_ms"]) != (row["scene"], row["frame_ms"])]
    OUT.write_text(json.dumps([*same, row], indent=1) + "\n")
    print(json.dumps(row))


def touching(state: State) -> torch.Tensor:
    """Which pairs of grains overlap, bool (n_grains, n_grains)."""
    apart = torch.cdist(state.pos, state.pos) >= state.radius[:, None] + state.radius
    return ~apart.fill_diagonal_(True)


def without(touch: torch.Tensor, edges: torch.Tensor) -> int:
    """How many of the touching pairs, in both directions, no edge joins."""
    there = torch.zeros_like(touch)
    there[edges[0], edges[1]] = there[edges[1], edges[0]] = True
    return int((touch & ~there).sum())


if __name__ == "__main__":
    main()
