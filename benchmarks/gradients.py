"""Gradients through unrolled steps, float32 against float64; of shipped bundles: `python -m benchmarks.gradients`.

From the recorded states of an unseen case at TIMES_S. Nothing is timed. Writes benchmarks/results/gradients.json.
"""

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch

from gns_pyg import bundle, machine
from gns_pyg.data.datamodule import EMBEDDED
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.evaluation.gradients import gradient_norms
from gns_pyg.evaluation.predict import initial_state, start_frame
from gns_pyg.state import State

OUT = Path(__file__).parent / "results" / "gradients.json"
BUNDLES, TIMES_S = ("hopper", "drum"), (0.1, 0.5, 1.0)
COUNTS = (0, 1, 2, 5, 10, 20, 50, 100)


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for name in BUNDLES:
        simulator = bundle.load(name)
        unseen = min(bundle.describe(name)["card"]["cases"]["test"])
        case = Trajectory(EMBEDDED / simulator.scene.name / unseen)
        for time_s in TIMES_S:
            state = initial_state(simulator, case, start_frame(case, time_s))
            norms = gradient_norms(simulator, state, COUNTS)
            row = {"bundle": name, "case": unseen, "time_s": time_s, "grains": len(state.pos)}
            rows.append(row | {"gradient_norm_m": norms, "float32": one_step_difference(simulator, state)})
            print(json.dumps(rows[-1]), flush=True)
    OUT.write_text(json.dumps({"machine": machine.processor(), "rows": rows}, indent=1) + "\n")


@torch.inference_mode()
def one_step_difference(simulator: Simulator, state: State) -> dict[str, Any]:
    """What float32 networks change of one step, against the same weights in float64: mean velocity over the step and
    end velocity over the data's velocity scale, spin over its own; root mean square and largest component."""
    rough, fine = simulator(state), deepcopy(simulator).double()(state)
    scales, dt_s = simulator.statistics, simulator.scene.frame_dt_s
    off = {"mean_velocity": (rough.pos - fine.pos) / dt_s / scales.velocity_m_s}
    off["velocity"] = (rough.vel - fine.vel) / scales.velocity_m_s
    if rough.ang_vel is not None and fine.ang_vel is not None:
        off["spin"] = (rough.ang_vel - fine.ang_vel) / scales.spin_rad_s
    return {
        name: {"rms": float(value.square().mean().sqrt()), "largest": float(value.abs().max())}
        for name, value in off.items()
    }


if __name__ == "__main__":
    main()
