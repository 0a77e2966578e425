"""What happens beside the updates: progress, and roll-outs of the validation cases."""

import logging
import sys
import time
from pathlib import Path
from typing import cast

import numpy as np
import pytorch_lightning as pl
import torch
from tqdm import tqdm

from gns_pyg.config import require
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import NumericalError
from gns_pyg.evaluation import observables
from gns_pyg.evaluation.contacts import mean_overlap_ratio
from gns_pyg.evaluation.errors import nanmax, nanmean, position_error, positions
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.evaluation.predict import one_step_errors, roll_out, start_frame
from gns_pyg.training.module import TrainingModule

log = logging.getLogger(__name__)


class Progress(pl.Callback):
    """Updates done, loss and time left: a bar on a terminal, else a line per tenth."""

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self.first, self.started = trainer.global_step, time.monotonic()
        self.bar = None
        if sys.stderr.isatty():
            self.bar = tqdm(total=trainer.max_steps, initial=self.first, desc="training", unit="update")

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, outputs, batch, batch_idx) -> None:
        done, total = trainer.global_step, trainer.max_steps
        if self.bar is not None:
            if done % 50 == 0:
                self.bar.set_postfix(loss=f"{float(outputs['loss']):.3f}", refresh=False)
            self.bar.update(done - self.bar.n)
        elif done * 10 // total > (done - 1) * 10 // total:
            left = (time.monotonic() - self.started) * (total - done) / (done - self.first)
            log.info("training: update %d of %d, loss %.3f, about %.0f s left", done, total, outputs["loss"], left)

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self.bar is not None:
            self.bar.close()


class Throughput(pl.Callback):
    """Logs `train/graphs_per_s` (windows that made a gradient) and `train/edges_per_s` (edges through the networks,
    in the simulator's own steps too) since the last log, validation roll-outs left out.

    Args:
        every_n_updates: how often.
    """

    def __init__(self, every_n_updates: int) -> None:
        key = "callbacks.throughput.every_n_updates"
        require(every_n_updates > 0, key, every_n_updates, "at least 1", "e.g. 100")
        self.every_n_updates, self.seconds, self.graphs, self.edges = every_n_updates, 0.0, 0, 0

    def on_train_batch_start(self, trainer: pl.Trainer, module: pl.LightningModule, batch, batch_idx) -> None:
        self.started, self.before = time.perf_counter(), cast(TrainingModule, module).simulator.edges_done

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, outputs, batch, batch_idx) -> None:
        if module.device.type == "cuda":
            torch.cuda.synchronize(module.device)
        self.seconds += time.perf_counter() - self.started
        self.graphs += batch.time_s.shape[0]
        self.edges += cast(TrainingModule, module).simulator.edges_done - self.before
        if trainer.global_step % self.every_n_updates == 0:
            rates = {"graphs": self.graphs / self.seconds, "edges": self.edges / self.seconds}
            for logger in trainer.loggers:
                logger.log_metrics({f"train/{k}_per_s": v for k, v in rates.items()}, step=trainer.global_step)
            self.seconds, self.graphs, self.edges = 0.0, 0, 0


class RolloutMetrics(pl.Callback):
    """Rolls out the validation cases and logs what an engineer would look at, `val/...`, mean over cases.

    The curves behind the figures go to validation/update_<n>.json in the run folder.

    Args:
        every_n_updates: how often; the last update counts too.
        start_s: where roll-outs begin, s.
    """

    def __init__(self, every_n_updates: int, start_s: float) -> None:
        key = "callbacks.rollout_metrics.every_n_updates"
        require(every_n_updates > 0, key, every_n_updates, "at least 1", "e.g. 1000")
        self.every_n_updates, self.start_s = every_n_updates, start_s

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, outputs, batch, batch_idx) -> None:
        update = trainer.global_step
        cases = trainer.datamodule.cases.val  # type: ignore[attr-defined]
        if not cases or not trainer.is_global_zero or (update % self.every_n_updates and update < trainer.max_steps):
            return
        found = [rollout_metrics(cast(TrainingModule, module).judged, case, self.start_s) for case in cases]
        metrics = {key: float(np.mean([figures[key] for figures, _ in found])) for key in found[0][0]}
        for logger in trainer.loggers:
            logger.log_metrics({f"val/{key}": value for key, value in metrics.items()}, step=update)
        curves = {case.path.stem: of_case for case, (_, of_case) in zip(cases, found, strict=True)}
        write_json(Path(trainer.default_root_dir) / "validation" / f"update_{update:06d}.json", curves)


def rollout_metrics(
    simulator: Simulator, case: Trajectory, start_s: float
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Figures and curves of one validation roll-out.

    One that diverges (early in training) counts as infinitely wrong, not as a crash: its figures are infinite and it
    has no curves.
    """
    start = start_frame(case, start_s)
    scene, dem, times = simulator.scene, positions(case, start), case.times_s[start:]
    metrics = {"one_step_error_m": nanmean(one_step_errors(simulator, case))}
    diverged = ["rollout_error_final_m", "center_of_mass_error_max_m", "mean_overlap_ratio", "escaped_grains"]
    diverged += ["angle_of_repose_error_deg"] if scene.angle_of_repose is not None else []
    try:
        pos, _ = roll_out(simulator, case, start)
    except NumericalError:
        return metrics | dict.fromkeys(diverged, float("inf")), {}
    com, com_dem = (observables.center_of_mass(p, case.mass) for p in (pos, dem))
    error = position_error(pos, dem)
    metrics |= {
        "rollout_error_final_m": float(error[-1]),
        "center_of_mass_error_max_m": nanmax(np.linalg.norm(com - com_dem, axis=1)),
        "mean_overlap_ratio": float(mean_overlap_ratio(pos, case.radius).mean()),
        "escaped_grains": float(observables.escaped_grains(pos, times, scene).max()),
    }
    if scene.angle_of_repose is not None:
        angle, angle_dem = (observables.mean_angle_of_repose(p, times, scene)[0] for p in (pos, dem))
        metrics["angle_of_repose_error_deg"] = abs(angle - angle_dem)
    return metrics, {"time_s": times, "error_m": error, "center_of_mass_m": com, "center_of_mass_dem_m": com_dem}
