"""What a bundle answers to grains that stand deep in a wall: `python -m benchmarks.deep_in_walls bundle=hopper_full`.

Up to 60 grains that touch a wall in the middle of a case (`trajectory=`; by itself the first that the bundle has not
seen) are stopped and moved into it; how far they are some steps later from there, outwards, median and worst. No DEM
run has such states; a roll-out that errs can get there. Keys are rollout.py's. Adds rows to
benchmarks/results/deep_in_walls.json.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir

from gns_pyg import bundle, run
from gns_pyg.config import CONF
from gns_pyg.data.datamodule import open_to_compare
from gns_pyg.dynamics.projection import nearest_walls
from gns_pyg.evaluation.predict import initial_state
from gns_pyg.graph.features import dot

DEPTHS, STEPS, MOST = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8), (1, 4, 8), 60
TOUCHING = 1.01  # radii
OUT = Path(__file__).parent / "results" / "deep_in_walls.json"


@torch.inference_mode()
def main() -> None:
    with initialize_config_dir(CONF, version_base="1.3"):
        config = compose("rollout", sys.argv[1:])
    simulator, card = run.load_bundle(config), bundle.card(config.bundle)
    if config.trajectory is None:
        case = run.unseen_cases(simulator.scene, None, card, None)[0]
    else:
        case = open_to_compare(config.trajectory, simulator.scene)
    if simulator.boundary is None:
        raise SystemExit(f"{simulator.scene.name} has no boundary to be deep in")
    state = initial_state(simulator, case, case.n_frames // 2)
    radius = state.radius[0]
    grain, point, normal, _ = nearest_walls(state, *simulator.boundary.contacts(state))
    at = (dot(state.pos[grain] - point, normal) < TOUCHING * radius).nonzero().flatten()[:MOST]
    chosen, outwards, still = grain[at], normal[at], torch.zeros(len(at), 3, dtype=state.vel.dtype)
    start = replace(state, vel=state.vel.index_copy(0, chosen, still))
    rows = []
    for depth in DEPTHS:
        before = start.pos[chosen] - depth * radius * outwards
        now = replace(start, pos=start.pos.index_copy(0, chosen, before))
        row = {"bundle": config.bundle, "grains": len(chosen), "pushed_in_radii": depth}
        for step in range(1, max(STEPS) + 1):
            now = simulator(now)
            if step in STEPS:
                out = ((now.pos[chosen] - before) * outwards).sum(1) / radius
                row |= {f"out_after_{step}": round(float(out.median()), 3)}
                row |= {f"worst_after_{step}": round(float(out.min()), 3)}
        print(json.dumps(row), flush=True)
        rows.append(row)
    others = json.loads(OUT.read_text()) if OUT.exists() else []
    OUT.write_text(json.dumps([o for o in others if o["bundle"] != config.bundle] + rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
