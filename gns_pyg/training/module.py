"""What Lightning drives: one update of a simulator."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytorch_lightning as pl
import torch
from pytorch_lightning.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from gns_pyg.dynamics.memory import known
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.dynamics.tiles import ball
from gns_pyg.errors import CheckpointError, ConfigError, NumericalError
from gns_pyg.graph.contacts import FINE
from gns_pyg.graph.features import between
from gns_pyg.graph.neighbors import backend
from gns_pyg.scene.symmetry import symmetry
from gns_pyg.state import State, Window, constant
from gns_pyg.training.augment import transform
from gns_pyg.training.checkpoint import REMEDY
from gns_pyg.training.config import TrainingConfig
from gns_pyg.training.loss import (
    CELLS,
    CLASSES,
    CREEP_CELLS,
    NEAR,
    balance_loss,
    cells,
    creep_loss,
    gap_loss,
    mean_loss,
    share_of_mean,
)
from gns_pyg.training.noise import perturb

MOST = 1e15  # of any number in a checkpoint beside its tensors


class TrainingModule(pl.LightningModule):
    """One-step training, on perturbed frames and on the simulator's own steps.

    The loss is the mean square of the scaled correction's error: for position-only states the paper's (12) up to a
    constant factor; or, with `loss_knee`, its mean length, which a few violent contacts do not rule. `balance` adds
    what grains wrongly gain or lose together; `creep` and `gaps` add how far slow ones wrongly go together in several
    steps, and from each other. Noise and unrolling are drawn from the seed, the update's number and the window's place
    in its batch, so a resumed run repeats none and skips none, and several processes that share a batch compute what
    one would.

    Args:
        simulator: what is trained.
        config: how.
        identity: what a checkpoint must agree on to be resumed from: dotted keys -> plain values.
    """

    def __init__(self, simulator: Simulator, config: TrainingConfig, identity: Mapping[str, Any] | None = None) -> None:
        super().__init__()
        self.simulator, self.config, self.identity = simulator, config, dict(identity or {})
        self.symmetry, self.started = symmetry(simulator.scene), False
        self.average: AveragedModel | None = None
        if config.average_decay:
            self.average = AveragedModel(simulator, multi_avg_fn=get_ema_multi_avg_fn(config.average_decay))
            self.average.requires_grad_(False)

    @property
    def judged(self) -> Simulator:
        """The simulator that is evaluated and saved: the averaged one where there is one."""
        return self.simulator if self.average is None else cast(Simulator, self.average.module)

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Averages right after the step, so that a checkpoint of this update holds this update's average."""
        super().optimizer_step(*args, **kwargs)
        if self.average is not None:
            self.average.update_parameters(self.simulator)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["identity"] = self.identity

    def on_train_start(self) -> None:
        self.started = True

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses a checkpoint of another model, data set or way of training, naming the differences, and one whose
        tensors are not those of this model.

        Raises:
            ConfigError: for the former.
            CheckpointError: for the latter.
        """
        then, now = checkpoint.get("identity", {}), self.identity
        if not isinstance(then, Mapping):
            raise CheckpointError("ckpt_path", f"identity {then!r:.60}", "a mapping", REMEDY)
        keys = [key for key in sorted({*then, *now}) if then.get(key) != now.get(key)]
        if keys:
            raise ConfigError(
                "ckpt_path",
                "; ".join(f"{key} = {then.get(key)}" for key in keys),
                "; ".join(f"{key} = {now.get(key)}" for key in keys),
                "resume with the config and data of the checkpoint, or start anew in another folder without ckpt_path",
            )
        self._check_progress(checkpoint)
        self._check_tensors(checkpoint)

    def _check_progress(self, checkpoint: Mapping[str, Any]) -> None:
        """Schedule, optimiser's settings and counts of what is done must be such as this run would have written."""
        fresh = cast(Any, self.configure_optimizers())
        group, schedule = fresh["optimizer"].state_dict()["param_groups"], fresh["lr_scheduler"]["scheduler"]
        for where, found, expected in (
            ("optimizer_states.0.param_groups", checkpoint["optimizer_states"][0]["param_groups"], group),
            ("lr_schedulers", checkpoint["lr_schedulers"], [schedule.state_dict()]),
            ("loops.fit_loop", checkpoint["loops"]["fit_loop"], self.trainer.fit_loop.state_dict()),
            ("global_step", checkpoint["global_step"], 0),
            ("epoch", checkpoint["epoch"], 0),
        ):
            if wrong := unlike(found, expected, where):
                raise CheckpointError("ckpt_path", *wrong, REMEDY)
        done = checkpoint["loops"]["fit_loop"]["epoch_loop.automatic_optimization.optim_progress"]["optimizer"]["step"]
        counts = {done["total"]["completed"], checkpoint["global_step"], checkpoint["lr_schedulers"][0]["last_epoch"]}
        if len(counts) != 1:
            raise CheckpointError("ckpt_path", f"{sorted(counts)} updates done", "one number of updates", REMEDY)
        ((then,), (now,)) = checkpoint["optimizer_states"][0]["param_groups"], group
        if then | {"lr": None} != now | {"lr": None}:  # the rate alone changes
            raise CheckpointError("ckpt_path", f"optimiser {then!r:.200}", f"{now!r:.200}", REMEDY)

    def _check_tensors(self, checkpoint: Mapping[str, Any]) -> None:
        expected: dict[str, Tensor] = dict(self.state_dict())
        found: dict[str, Any] = dict(checkpoint["state_dict"])
        (optimizer,) = checkpoint["optimizer_states"]
        for number, parameter in enumerate(self.simulator.parameters()):
            for name, like in {"exp_avg": parameter, "exp_avg_sq": parameter, "step": torch.zeros(())}.items():
                if number in optimizer["state"]:
                    expected[f"{name} {number}"] = like
                    found[f"{name} {number}"] = optimizer["state"][number][name]
        for key in sorted({*expected, *found}, key=str):
            ours, theirs = expected.get(key), found.get(key)
            told = f"{tuple(theirs.shape)} {theirs.dtype}" if isinstance(theirs, Tensor) else f"{theirs!r:.60}"
            wanted = "nothing" if ours is None else f"{tuple(ours.shape)} {ours.dtype}, finite"
            fits = isinstance(theirs, Tensor) and (theirs.shape, theirs.dtype) == (
                getattr(ours, "shape", None),
                getattr(ours, "dtype", None),
            )
            if not fits or not torch.isfinite(cast(Tensor, theirs)).all():
                raise CheckpointError("ckpt_path", f"{key}: {told}", wanted, REMEDY)

    def training_step(self, window: Window, batch_idx: int) -> Tensor:
        n_graphs = len(window.time_s)
        randoms = [self._random(self.global_rank * n_graphs + graph) for graph in range(n_graphs)]
        if self.simulator.requires.symmetry:
            window = transform(window, self.symmetry, randoms)
        frame = self.simulator.integrator.before()
        state = self.simulator.integrator.read(window, frame)
        state, counted = perturb(state, self.config, self.simulator, randoms)
        with torch.no_grad():
            for _ in range(self._own_steps(self._random())):
                state, frame = self.simulator(state), frame + 1
        following = self.simulator.integrator.read(window, frame + 1)
        if window.active is not None and state.active is not None:  # a grain that just entered has no difference yet
            counted = counted & state.active & window.active[frame - 1 : frame + 2].all(dim=0)
        if self.config.region_grains is not None:
            core, region = ball(state.pos, state.batch, self.config.region_grains, self.simulator.halo_m, randoms)
            counted = (counted & torch.zeros_like(counted).index_fill(0, core, True))[region]
            state, following = state.pick(region), following.pick(region)
        error = (self.simulator.correction(state) - self.simulator.target(state, following))[counted]
        loss = mean_loss(error, self.config.loss_knee)
        if self.config.balance:
            loss = loss + self.config.balance * self._imbalance(error, state, following, counted, randoms)
        loss = loss * share_of_mean(len(error), error.device)
        if self.config.creep or self.config.gaps:  # of the first window of all
            share = share_of_mean(int(self.global_rank == 0), error.device)
            loss = loss + (share * self._ahead(window, randoms[:1]) if share else 0.0)
        if not torch.isfinite(loss):
            raise NumericalError(
                f"training update {self.global_step}",
                f"loss {loss.item()}",
                "a finite loss",
                "lower training.lr_start or training.unroll; checkpoints/ holds the last state saved before, if any",
            )
        self.log("train/loss", loss, batch_size=state.n_graphs, sync_dist=True)
        return loss

    def _imbalance(
        self, error: Tensor, state: State, following: State, counted: Tensor, randoms: Sequence[torch.Generator]
    ) -> Tensor:
        """`balance_loss` of the `counted` grains in cells of every size, velocities over the data's scale."""
        simulator, (pos, batch, vel) = self.simulator, (x[counted] for x in (state.pos, state.batch, following.vel))
        velocity_m_s, radius_m = simulator.statistics.velocity_m_s, max(simulator.scene.grains.radii_m)
        end = slice(3, 6) if simulator.integrator.n_groups > 1 else slice(3)  # with differences mean and end are one
        error = error[:, end] * simulator.scale[end] / velocity_m_s
        vel = (vel / velocity_m_s).to(error.dtype)
        terms = [
            weight * balance_loss(error, vel, cells(pos, batch, edge * radius_m, randoms)) for edge, weight in CELLS
        ]
        return torch.stack(terms).sum()

    def _ahead(self, window: Window, randoms: Sequence[torch.Generator]) -> Tensor:
        """`creep_loss` and `gap_loss`, weighted, of the first window's slow grains after half of and all of
        `creep_steps` own steps."""
        simulator, config, first = self.simulator, self.config, window.batch == 0
        integrator, radius_m = simulator.integrator, max(simulator.scene.grains.radii_m)

        def recorded(step: int) -> State:
            state = integrator.read(window, integrator.before() + step).pick(first)
            parameters = None if state.parameters is None else state.parameters[:1]
            return replace(state, time_s=state.time_s[:1], parameters=parameters)

        state = start = recorded(0)
        limits = constant(CLASSES, state.vel) * integrator.gained(state)[:, None]
        kind = (torch.linalg.vector_norm(known(state), dim=1, keepdim=True) >= limits).sum(1)
        sizes = [(cells(state.pos, state.batch, edge * radius_m, randoms), weight) for edge, weight in CREEP_CELLS]
        search = backend(simulator.config.neighbors, state.pos.device).build(state.pos, state.batch)
        one, other = search(state.pos, state.batch, (2 + NEAR) * radius_m)
        touch = state.radius[one] + state.radius[other]
        near = (one < other) & (distances(state, one, other) < touch + NEAR * radius_m)
        one, other = one[near], other[near]
        there, total = kind < len(CLASSES), state.vel.new_zeros(())
        for step in range(1, config.creep_steps + 1):
            state, following = simulator(state), recorded(step)
            if state.active is not None and following.active is not None:
                there = there & state.active & following.active
            if step in (config.creep_steps // 2, config.creep_steps):
                scale = simulator.statistics.velocity_m_s * step * integrator.dt_s
                vel, error = (following.pos - start.pos) / scale, (state.pos - following.pos) / scale
                for cell, weight in sizes:
                    found = creep_loss(error[there], vel[there], kind[there], cell[there])
                    total = total + config.creep * weight * found
                both = there[one] & there[other]
                before, ours, theirs = (
                    distances(x, one[both], other[both]) / (FINE * radius_m) for x in (start, state, following)
                )
                faster = torch.maximum(kind[one], kind[other])[both]
                total = total + config.gaps * gap_loss(ours - theirs, theirs - before, faster)
        return total

    def _random(self, *window: int) -> torch.Generator:
        """A generator for this update, or for one window of its batch, whichever process computes it."""
        entropy = np.random.SeedSequence((self.config.seed, self.global_step, *window))
        return torch.Generator().manual_seed(int(entropy.generate_state(1, np.uint64)[0]))

    def _own_steps(self, random: torch.Generator) -> int:
        """0 for half of the updates, else 1 to `unroll`."""
        steps = int(torch.randint(1, self.config.unroll + 1, (), generator=random)) if self.config.unroll else 0
        unrolls = torch.rand((), generator=random) < 0.5
        started = self.global_step >= self.config.unroll_from * self.config.updates
        return steps if unrolls and started else 0

    def configure_optimizers(self) -> OptimizerLRScheduler:
        optimizer = torch.optim.Adam(self.simulator.parameters(), lr=self.config.lr_start)
        stretch = self.config.updates / (self.config.halvings + 1)
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda update: 0.5 ** min(int(update / stretch), self.config.halvings)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def distances(state: State, one: Tensor, other: Tensor) -> Tensor:
    """Distances between the centres of grains, m."""
    return torch.linalg.vector_norm(between(state.pos, one, other), dim=1)


def unlike(found: Any, expected: Any, where: str) -> tuple[str, str] | None:
    """The first place where nested plain values are not of the kind of others: other keys, lengths or types, or
    numbers below 0 or not finite; (what is there, what should be) or None."""
    if type(found) is not type(expected):
        return f"{where}: {found!r:.60}", f"{type(expected).__name__}, e.g. {expected!r:.60}"
    if isinstance(expected, dict):
        if found.keys() != expected.keys():
            return f"{where}: {found!r:.60}", f"the keys {', '.join(map(str, expected))}"
        return next((w for key in expected if (w := unlike(found[key], expected[key], f"{where}.{key}"))), None)
    if isinstance(expected, list | tuple):
        if len(found) != len(expected):
            return f"{where}: {len(found)} values", f"{len(expected)} values"
        pairs = enumerate(zip(found, expected, strict=True))
        return next((w for n, pair in pairs if (w := unlike(*pair, f"{where}.{n}"))), None)
    if isinstance(expected, int | float) and not 0 <= found <= MOST:
        return f"{where}: {found!r:.60}", f"0 to {MOST:g}"
    return None
