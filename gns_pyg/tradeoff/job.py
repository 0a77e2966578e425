"""One job: a point trained within the budget, judged on the unseen cases, its row written whole.

A job may be killed at any moment and given again: what is finished is skipped, training goes on from its last
checkpoint.
"""

import json
import logging
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from omegaconf import DictConfig

from gns_pyg import bundle, run
from gns_pyg.data.datamodule import open_to_compare
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import ConfigError, GnsError, StorageError
from gns_pyg.evaluation.baselines import Climatology, climatology
from gns_pyg.evaluation.errors import positions
from gns_pyg.evaluation.judge import compare
from gns_pyg.evaluation.metrics import CaseResult, Evaluation, evaluate_cases, write_json
from gns_pyg.evaluation.twins import Twins
from gns_pyg.files import held, remove
from gns_pyg.scene.scene import Scene
from gns_pyg.tradeoff import dem
from gns_pyg.tradeoff.points import NETWORKS, Point, as_plain, cases_of, config, digest, scene_of, train_config

TRIAL = 40  # updates that tell how many the budget allows
TWINS = 2  # per case
QUIET = ["callbacks.progress=null", "callbacks.throughput=null", "callbacks.rollout_metrics=null"]
log = logging.getLogger(__name__)


class Clock(pl.Callback):
    """Writes clock.json in the run folder: processor seconds of an update, of the loop alone.

    Args:
        path: of the file.
    """

    def __init__(self, path: str) -> None:
        self.path = Path(path)

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self.first, self.began_s = trainer.global_step, time.process_time()

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if updates := trainer.global_step - self.first:
            write_json(self.path, {"cpu_s_per_update": (time.process_time() - self.began_s) / updates})


def do(cfg: DictConfig, point: Point) -> dict[str, Any] | None:
    """Does a point unless its row is there.

    Returns:
        Its row, the reason in `error` where it failed; None if another process works on it.

    Raises:
        StorageError: if files cannot be written: that is no property of the point.
    """
    folder = folder_of(cfg, point)
    row = folder / "row.json"
    try:
        with held(folder):
            if not row.is_file():
                write_json(row, as_plain(point) | {"budget_cpu_s": cfg.budget_cpu_s} | attempt(cfg, point, folder))
    except ConfigError as error:
        if error.where != "folder":
            raise
        return None
    return json.loads(row.read_text())


def folder_of(cfg: DictConfig, point: Point) -> Path:
    """Where a point's run and row are."""
    return Path(cfg.results) / f"{point.kind}_{digest(cfg, point)}"


def attempt(cfg: DictConfig, point: Point, folder: Path) -> dict[str, Any]:
    """What a row says beside the point's name; `error` instead of figures where it fails."""
    try:
        found = {} if point.kind != "trained" else train(cfg, point, folder)
        found |= judged(cfg, point) if point.kind in NETWORKS else beside(cfg, point)
        return found | {"error": None}
    except StorageError:
        raise
    except (GnsError, RuntimeError, MemoryError) as error:
        log.warning("%s failed: %s", point.name, error)
        return {"error": f"{type(error).__name__}: {error}"}


def train(cfg: DictConfig, point: Point, folder: Path) -> dict[str, Any]:
    """Trains for the budget's processor time: a short trial tells how many updates that is."""
    torch.set_num_threads(1)
    for left in folder.glob(".trial_*"):  # of a process that was killed
        remove(left)
    plan = folder / "plan.json"
    if not plan.is_file():
        with tempfile.TemporaryDirectory(dir=folder, prefix=".trial_") as trial:
            run.trained(training(cfg, point, Path(trial), TRIAL))
            seconds = json.loads((Path(trial) / "clock.json").read_text())["cpu_s_per_update"]
        write_json(plan, {"updates": max(1, int(cfg.budget_cpu_s / seconds))})
    updates = json.loads(plan.read_text())["updates"]
    run.trained(training(cfg, point, folder, updates))
    seconds = json.loads((folder / "clock.json").read_text())["cpu_s_per_update"]
    return {"updates": updates, "training_cpu_s": round(updates * seconds, 1)}


def training(cfg: DictConfig, point: Point, folder: Path, updates: int) -> DictConfig:
    clock = [f"+callbacks.clock._target_={__name__}.Clock", f"+callbacks.clock.path={folder}/clock.json"]
    return train_config(cfg, point, f"training.updates={updates}", f"folder={folder}", *QUIET, *clock)


def bundle_of(cfg: DictConfig, point: Point) -> Path:
    """The bundle that a point runs.

    Raises:
        ConfigError: if the point that trains it failed, or is not done yet.
    """
    if point.kind == "shipped":
        return bundle.find(point.training[0])
    trained = Point("trained", point.training)
    folder = folder_of(cfg, trained)
    there = folder / "row.json"
    row = do(cfg, trained) if point.kind != "trained" and not there.is_file() else None
    if row is None and not (folder / "bundle").is_dir():
        found = f"{trained.name}: {'failed' if there.is_file() else 'in work elsewhere'}"
        raise ConfigError("without_training", found, "a trained point", "see its row, or give the command again")
    return folder / "bundle"


def simulator_of(cfg: DictConfig, point: Point) -> Simulator:
    """A point's simulator, as evaluate.py would run it."""
    return run.load_bundle(config("evaluate", [f"bundle={bundle_of(cfg, point)}", "folder=.", *point.running]))


def judged(cfg: DictConfig, point: Point) -> dict[str, Any]:
    """The figures of a point's row."""
    torch.set_num_threads(1)
    simulator, card = simulator_of(cfg, point), bundle.card(bundle_of(cfg, point))
    scene = replace(scene_of(cfg), frame_dt_s=simulator.scene.frame_dt_s)
    paths = [case.path for case in run.unseen_cases(scene, cfg.data.dir, card, None)]
    cases = [open_to_compare(path, scene) for path in paths]
    results = [compare(simulator, case, cfg.start_s) for case in cases]
    found = figures(results, Climatology.from_plain(card["climatology"]), scene, cfg.compare_every_s)
    return found | {
        "frame_dt_s": simulator.scene.frame_dt_s,
        "parameters": sum(parameter.numel() for parameter in simulator.parameters()),
    }


def figures(results: Sequence[CaseResult], expected: Climatology, scene: Scene, every_s: float) -> dict[str, Any]:
    """Metrics over cases and case by case, roll-outs read every `every_s`: the granular temperature, taken from
    displacements, is another one over another time. Single steps are those of the cases' own frames."""
    evaluation: Evaluation = evaluate_cases([thinned(result, every_s) for result in results], expected, scene)
    return {"metrics": evaluation.metrics, "cases": evaluation.per_case}


def thinned(result: CaseResult, every_s: float) -> CaseResult:
    """`result` with only the frames of the roll-out that are so many seconds apart."""
    step_s = result.times_s[1] - result.times_s[0]
    every = slice(None, None, max(1, round(every_s / step_s)))
    twins = result.twins and Twins(result.twins.mean_m[every], result.twins.std_m[every])
    return replace(
        result, times_s=result.times_s[every], dem_pos=result.dem_pos[every], pos=result.pos[every], twins=twins
    )


def beside(cfg: DictConfig, point: Point) -> dict[str, Any]:
    """The figures of a row that is no network: Yade at another step, or a yardstick, on the same cases."""
    scene, cases = scene_of(cfg), cases_of(cfg)
    expected, start_s = climatology(cases.train, scene), cfg.start_s
    more: dict[str, Any] = {}
    match point.kind:
        case "yade":
            step = point.training[0] if point.training[0] == "auto" else float(point.training[0])
            done = [dem.of_step(case, scene, start_s, step) for case in cases.test]
            results, more = [result for result, _ in done], {"dt_s": done[0][1].dt_s}
        case "twins":
            results = [dem.twin(case, scene, start_s, seed) for case in cases.test for seed in range(TWINS)]
        case "seeds":
            every = [*cases.train, *cases.val, *cases.test]
            pairs = [(case, other) for case in cases.test for other in every if other.path != case.path]
            results = [dem.guess(case, scene, start_s, partial(positions, other)) for case, other in pairs]
        case _:
            results = [dem.guess(case, scene, start_s, partial(_frozen, case)) for case in cases.test]
    return figures(results, expected, scene, cfg.compare_every_s) | more


def _frozen(case: Trajectory, start: int) -> np.ndarray:
    pos = positions(case, start)
    return np.repeat(pos[:1], len(pos), axis=0)
