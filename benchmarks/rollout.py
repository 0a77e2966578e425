r"""Full-size roll-outs against Yade on the same two cores: `python -m benchmarks.rollout`.

Yade runs a case of the paper's hopper and drum with two threads, at the paper's 1e-5 s and at its largest step that
still gives the same observables (`scene.dem.dt_s=auto`); the last files are kept in $GNS_DATA/rollout_benchmark. Then
every bundle of MODELS rolls the second one out, on two threads, and is judged against it. Times are medians of three,
but for Yade's at 1e-5 s, which is one run of many minutes. About an hour. Writes
benchmarks/results/rollout.json. One row is the full-size bundle that ships, one goes on from it on longer frames
(docs/tradeoff.md, "At full size"); the others are trained on the reduced scenes first (128touching with
requires.touching_pairs=true; a row whose bundle is missing is left out, and bfloat16 where the processor lacks it, but
for the first, whose factors stand for the scene), for example

    python train.py scene=hopper_small model=contact model.hidden=128 training.updates=2000 \
        training.noise_in_walls=0.05 hydra.run.dir=runs/speed/hopper_128
    python train.py scene=hopper_small model=contact model.hidden=32 model.layers=1 scene.frame_dt_s=0.02 \
        hydra.run.dir=runs/speed/hopper_fast20
"""

import json
import logging
import os
from pathlib import Path
from statistics import median
from typing import Any

import torch
from hydra import compose, initialize_config_dir

from benchmarks.ablation import FIGURES, figures
from data_gen.generate import generate
from gns_pyg import machine, run
from gns_pyg.config import CONF
from gns_pyg.data.datamodule import open_to_compare
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.evaluation.predict import roll_out, start_frame

OUT = Path(__file__).parent / "results" / "rollout.json"
DATA = Path(os.environ.get("GNS_DATA", "data")) / "rollout_benchmark"
STEPS = {"1e-5": "1e-5", "equivalent": "auto"}
PAPER, SHIPS = "paper's width", "ships"
MODELS = {  # name: folder of its run, options
    PAPER: ("128", ()),
    "paper's width, touching pairs": ("128touching", ()),
    "paper's width, bfloat16": ("128", ("execution.precision=bfloat16",)),
    "paper's width, frames of 20 ms": ("12820", ("scene.frame_dt_s=0.02",)),
    "fast": ("fast", ()),
    "fast, frames of 20 ms": ("fast20", ("scene.frame_dt_s=0.02",)),
    "full size, frames of 5 ms": ("full5", ("scene.frame_dt_s=0.005", "compare_every_s=0.01")),
    SHIPS: ("full", ("scene.frame_dt_s=0.0025", "compare_every_s=0.01")),
}
CASE, THREADS, ROUNDS = 40, 2, 3
YADE_ROUNDS = {"1e-5": 1, "equivalent": ROUNDS}


def main() -> None:
    torch.set_num_threads(THREADS)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    found: dict[str, Any] = {"machine": machine.processor(), "threads": THREADS}
    for scene in ("hopper", "drum"):
        yade = {name: yade_seconds(scene, name, step) for name, step in STEPS.items()}
        rows = [judged(scene, name, yade) for name in MODELS if name in (PAPER, SHIPS) or possible(scene, name)]
        factors = {f"factor_yade_{step}": rows[0][f"factor_yade_{step}"] for step in STEPS}
        found[scene] = factors | {"yade_seconds_per_simulated_second": yade, "models": rows}
        OUT.write_text(json.dumps(found, indent=1) + "\n")
    print(table(found))


def yade_seconds(scene: str, name: str, step: str) -> float:
    """Wall seconds per simulated second."""
    folder, seconds = DATA / f"{scene}_{name}", []
    out = [f"scene={scene}", f"case={CASE}", f"scene.dem.dt_s={step}", f"cores={THREADS}", f"out={folder}"]
    for _ in range(YADE_ROUNDS[name]):
        (folder / f"case_{CASE:03d}.h5").unlink(missing_ok=True)
        case = Trajectory(generate(config("generate", *out)))
        seconds.append(case.run["wall_clock_s"] / (case.times_s[-1] - case.times_s[0]))
    return median(seconds)


def bundle(scene: str, name: str) -> Path:
    return Path("runs/speed") / f"{scene}_{MODELS[name][0]}" / "bundle"


def possible(scene: str, name: str) -> bool:
    """Whether the row's bundle is there and the processor computes as it asks."""
    return bundle(scene, name).exists() and (machine.has_bfloat16() or "bfloat16" not in name)


def judged(scene: str, name: str, yade: dict[str, float]) -> dict[str, Any]:
    """One bundle on the equivalent run."""
    place = bundle(scene, name)
    chosen = place.parent.name if name == SHIPS else place
    places = [f"bundle={chosen}", f"folder={place.parent}/full_size", f"data.dir={DATA}/{scene}_equivalent"]
    cfg = config("evaluate", *places, f"scene={scene}", *MODELS[name][1])
    metrics, simulator = run.evaluate(cfg), run.load_bundle(cfg)
    case = open_to_compare(DATA / f"{scene}_equivalent" / f"case_{CASE:03d}.h5", simulator.scene, cfg.compare_every_s)
    again = [roll_out(simulator, case, start_frame(case, cfg.start_s))[1] for _ in range(ROUNDS - 1)]
    seconds = median([metrics["speed/seconds_per_simulated_second"], *again])
    row = {"model": name, "seconds_per_simulated_second": seconds}
    row |= {f"factor_yade_{step}": round(of_yade / seconds, 2) for step, of_yade in yade.items()}
    return row | {"metrics": metrics}


def config(name: str, *overrides: str) -> Any:
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose(name, list(overrides))


def table(found: dict[str, Any]) -> str:
    """The results as Markdown."""
    columns = ["scene", "model", "s per simulated s", "times Yade at 1e-5 s", "times Yade, largest step", *FIGURES]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for scene in ("hopper", "drum"):
        for step, seconds in found[scene]["yade_seconds_per_simulated_second"].items():
            lines.append(f"| {scene} | Yade, step {step} | {seconds:.1f} |" + " |" * (len(columns) - 3))
        for row in found[scene]["models"]:
            speeds = [f"{row['seconds_per_simulated_second']:.2f}", *(f"{row[f'factor_yade_{s}']:.1f}" for s in STEPS)]
            lines.append(f"| {' | '.join([scene, row['model'], *speeds, *figures(row['metrics'])])} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
