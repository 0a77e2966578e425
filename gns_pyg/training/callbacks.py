"""What happens beside the updates: progress, and roll-outs of the validation cases."""

import logging
import sys
import time
from typing import cast

import numpy as np
import pytorch_lightning as pl
from tqdm import tqdm

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import NumericalError
from gns_pyg.evaluation import observables
from gns_pyg.evaluation.errors import position_error
from gns_pyg.evaluation.predict import one_step_errors, roll_out, start_frame

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


class RolloutMetrics(pl.Callback):
    """Rolls out the validation cases and logs what an engineer would look at.

    Args:
        every_n_updates: how often.
        start_s: where roll-outs begin, s.
    """

    def __init__(self, every_n_updates: int, start_s: float) -> None:
        self.every_n_updates, self.start_s = every_n_updates, start_s

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, outputs, batch, batch_idx) -> None:
        if trainer.global_step % self.every_n_updates == 0:
            cases = trainer.datamodule.cases.val  # type: ignore[attr-defined]
            found = [rollout_metrics(cast(Simulator, module.simulator), case, self.start_s) for case in cases]
            for key in found[0] if found else ():
                module.log(f"val/{key}", float(np.mean([metrics[key] for metrics in found])), batch_size=len(cases))


def rollout_metrics(simulator: Simulator, case: Trajectory, start_s: float) -> dict[str, float]:
    """One validation roll-out; a diverging one (early in training) counts as infinitely wrong, not as a crash."""
    start = start_frame(case, start_s)
    scene, dem, times = simulator.scene, case.read("position", start), case.times_s[start:]
    metrics = {"one_step_error_m": float(one_step_errors(simulator, case).mean())}
    try:
        pos, _ = roll_out(simulator, case, start)
    except NumericalError:
        return {**metrics, "rollout_error_final_m": float("inf")}
    com, com_dem = (observables.center_of_mass(p, case.mass) for p in (pos, dem))
    metrics |= {
        "rollout_error_final_m": float(position_error(pos, dem)[-1]),
        "center_of_mass_error_max_m": float(np.linalg.norm(com - com_dem, axis=1).max()),
        "mean_overlap_ratio": float(observables.mean_overlap_ratio(pos, case.radius).mean()),
        "escaped_grains": float(observables.escaped_grains(pos, times, scene).max()),
    }
    if scene.angle_of_repose is not None:
        angle, angle_dem = (observables.mean_angle_of_repose(p, times, scene)[0] for p in (pos, dem))
        metrics["angle_of_repose_error_deg"] = abs(angle - angle_dem)
    return metrics
