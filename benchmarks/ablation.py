"""What the judgement rows are worth, at equal training time: `python benchmarks/ablation.py [scene] [seconds]`.

Every variant trains for about the same processor time (its number of updates follows from a short trial) and is judged
on the same unseen cases. Writes benchmarks/results/ablation.json, a row per run; runs that are there are not repeated.
"""

import json
import logging
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from hydra import compose, initialize_config_dir

from gns_pyg import run
from gns_pyg.config import CONF
from gns_pyg.errors import NumericalError

OUT = Path(__file__).parent / "results" / "ablation.json"
SECONDS, TRIAL = 240.0, 150
DEFAULT = {"default": [], "default, another seed": ["training.seed=1"]}
COMMON = {
    "no symmetry": ["requires.symmetry=false"],
    "absolute position": ["model.absolute_position=true"],
    "no free grains": ["requires.free_grains=false"],
    "state velocity": ["requires.state=velocity"],
    "state differences": ["requires.state=differences"],
}
VARIANTS: dict[str, dict[str, list[str]]] = {
    "hopper_small": {
        **DEFAULT,
        **COMMON,
        "no free-flight law": ["requires.free_flight=false", "requires.free_grains=false"],
    },
    "drum_small": {**DEFAULT, **COMMON},
    "drum_bidisperse": {**DEFAULT, "no radius features": ["requires.radius_features=false"]},
    "hopper_friction": {**DEFAULT, "no friction feature": ["requires.material_features=false"]},
}
FIGURES = {  # column of the table -> key of metrics.json, key of what stands beside it in brackets, factor, form
    "one step, mm (best trivial)": ("one_step_error_m", "one_step_error_trivial_m", 1e3, ".3f"),
    "end of roll-out, mm (frozen)": ("rollout_error_final_m", "rollout_error_final_frozen_m", 1e3, ".1f"),
    "centre of mass, mm (climatology)": (
        "center_of_mass_error_max_m",
        "center_of_mass_error_climatology_max_m",
        1e3,
        ".1f",
    ),
    "angle of repose, degrees (climatology)": (
        "angle_of_repose_error_deg",
        "angle_of_repose_error_climatology_deg",
        1,
        ".1f",
    ),
    "overlap, % (DEM)": ("mean_overlap_ratio", "mean_overlap_ratio_dem", 100, ".2f"),
    "escaped": ("escaped_grains", None, 1, ".0f"),
}


class Clock(pl.Callback):
    """Processor seconds of the training loop alone."""

    seconds = 0.0

    def on_train_start(self, *_: Any) -> None:
        Clock.seconds = -time.process_time()

    def on_train_end(self, *_: Any) -> None:
        Clock.seconds += time.process_time()


def main() -> None:
    torch.set_num_threads(1)
    logging.basicConfig(level=logging.WARNING)
    scenes = sys.argv[1:2] or list(VARIANTS)
    seconds = float(sys.argv[2]) if sys.argv[2:] else SECONDS
    for scene in scenes:
        for name, overrides in VARIANTS[scene].items():
            if any(row["scene"] == scene and row["variant"] == name for row in results()):
                continue
            train(scene, *overrides, f"training.updates={TRIAL}", "data.test_fraction=0")
            updates = int(seconds * TRIAL / Clock.seconds)
            try:
                metrics = train(scene, *overrides, f"training.updates={updates}")
            except NumericalError as error:
                metrics = {"failed": str(error)}
            row = {"scene": scene, "variant": name, "overrides": overrides, "updates": updates}
            row |= {"training_cpu_s": round(Clock.seconds, 1), "metrics": metrics}
            OUT.write_text(json.dumps([*results(), row], indent=1) + "\n")
            print(f"{scene}, {name}: {updates} updates", flush=True)
    print(table(results()))


def table(rows: list[dict[str, Any]]) -> str:
    """The results as Markdown."""
    lines = [f"| {' | '.join(['scene', 'variant', 'updates', *FIGURES])} |", "|---" * (3 + len(FIGURES)) + "|"]
    for row in sorted(rows, key=lambda row: list(VARIANTS).index(row["scene"])):
        cells = [row["scene"], row["variant"], str(row["updates"]), *figures(row["metrics"])]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def figures(metrics: dict[str, Any]) -> list[str]:
    """The cells of `FIGURES`."""
    cells = []
    for key, beside, factor, form in FIGURES.values():
        value, other = (metrics.get(f"test/{name}") for name in (key, beside))
        cells.append("diverged" if value is None else f"{factor * value:{form}}")
        cells[-1] += "" if other is None else f" ({factor * other:{form}})"
    return cells


def train(scene: str, *overrides: str) -> dict[str, Any]:
    clock = f"+callbacks.clock._target_={__spec__.name if __spec__ else '__main__'}.Clock"
    with tempfile.TemporaryDirectory() as folder, initialize_config_dir(CONF, version_base="1.3"):
        quiet = ["callbacks.progress=null", "callbacks.rollout_metrics=null", f"folder={folder}", clock]
        return run.train(compose("train", [f"scene={scene}", "model=contact", *quiet, *overrides]))


def results() -> list[dict[str, Any]]:
    return json.loads(OUT.read_text()) if OUT.exists() else []


if __name__ == "__main__":
    main()
