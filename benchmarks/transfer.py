"""Trained bundles taken to scenes they have not seen, without training: `python -m benchmarks.transfer`.

Trains a bundle per scene with the default training (kept in runs/transfer/<scene>), evaluates it on its own unseen
cases and on real Yade runs of changed scenes (docs/requirements.md says how to make them), and writes
benchmarks/results/transfer.json.
"""

import json
import logging
import os
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir

from benchmarks.ablation import FIGURES, figures
from gns_pyg import run
from gns_pyg.config import CONF

OUT = Path(__file__).parent / "results" / "transfer.json"
DATA = Path(os.environ.get("GNS_DATA", "data"))
CHANGES: dict[str, dict[str, tuple[str, list[str]]]] = {  # scene -> change -> folder of its cases, overrides
    "hopper_small": {
        "gravity tilted by 10 degrees": ("hopper_tilted", ["scene.gravity_m_s2=[1.7035,0.0,-9.6610]"]),
    },
    "drum_small": {
        "twice the speed": ("drum_double", ["scene.boundary.drum.motion.rate_rad_s=6.0"]),
        "half the speed": ("drum_half", ["scene.boundary.drum.motion.rate_rad_s=1.5"]),
    },
    "hopper_friction": {
        "friction angle 0.375 rad, between trained ones": ("hopper_friction_0375", []),
        "friction angle 0.9 rad, beyond them": ("hopper_friction_09", []),
    },
}


def main() -> None:
    torch.set_num_threads(1)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    rows = []
    for scene, changes in CHANGES.items():
        folder = Path("runs/transfer") / scene
        run.train(
            config("train", f"scene={scene}", "model=contact", "callbacks.rollout_metrics=null", f"folder={folder}")
        )
        own = run.evaluate(config("evaluate", f"bundle={folder}/bundle", f"folder={folder}/own"))
        rows.append({"scene": scene, "change": "none", "metrics": own})
        for change, (cases, overrides) in changes.items():
            places = [f"bundle={folder}/bundle", f"folder={folder}/{cases}", f"data.dir={DATA}/{cases}"]
            metrics = run.evaluate(config("evaluate", *places, f"scene={scene}", *overrides))
            rows.append({"scene": scene, "change": change, "metrics": metrics})
    OUT.write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))


def config(name: str, *overrides: str) -> Any:
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose(name, list(overrides))


def table(rows: list[dict[str, Any]]) -> str:
    """The results as Markdown."""
    lines = [f"| {' | '.join(['scene', 'change', *FIGURES])} |", "|---" * (2 + len(FIGURES)) + "|"]
    for row in rows:
        lines.append(f"| {' | '.join([row['scene'], row['change'], *figures(row['metrics'])])} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
