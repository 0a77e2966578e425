"""How a simulator is trained; conf/training/*.yaml are its files."""

from dataclasses import dataclass

from omegaconf import MISSING

from gns_pyg.config import require


@dataclass
class TrainingConfig:
    """One run of the optimiser.

    Attributes:
        updates: optimiser steps.
        batch_size: windows per update.
        seed: of initialisation, shuffling, noise and unrolling.
        lr_start: Adam's learning rate at the start; it is halved `halvings` times, at equal intervals.
        halvings: see `lr_start`; 5 takes 1e-4 to 3.125e-6, the paper's values.
        noise_radii: standard deviation of the noise on input positions, in grain radii.
        noise_velocity: standard deviation of the noise on input velocities (and spins), in their scales.
        noise_in_walls: share of the grains that touch a wall which start up to a radius deep in it, where no DEM
            run has any; 0 leaves them.
        unroll: half of the updates start from up to this many of the model's own steps; 0 is one-step training.
        unroll_from: share of the updates after which unrolling begins.
        gradient_clip: largest gradient norm; 0 is no limit.
        region_grains: an update looks at this many neighbouring grains of each window only, so that its memory
            does not grow with the scene; null looks at all.
        loss_knee: where the loss turns from the square of a scaled error (of mean velocity, end velocity, spin) to its
            length; 0 is the mean square throughout (the paper).
        balance: weight of the momentum and the energy that cells of some 30 and 300 grains wrongly gain or lose
            together. (Each grain's own error is smallest for an average motion, which loses speed at every step.) 0
            leaves it out.
        creep: weight of the way that cells of slow grains, about as fast as each other, wrongly go, over their own, in
            `creep_steps` of the model's own steps and in half of them, from one whole frame of every update; gradients
            run through all these steps, each of which takes the time and memory of an update. 0 leaves it out.
        creep_steps: see `creep`.
        gaps: weight of how far the gaps between these slow grains, where they touch or nearly do, are then from the
            DEM's. 0 leaves it out: a bed may creep as far as it should with its contacts open.
        start_from: a bundle whose weights and scales training starts from; null draws and measures them. Parameters
            that vary here, where none did there, and a memory (`model.memory`) become inputs (impulse networks).
        start_fixed: weights of `start_from` stay as they are, but for those that look at a grain's memory.
        start_share: what is judged and saved is this share of the weights of `start_from` and the rest of the trained
            ones (Wortsman et al. 2022, "Robust fine-tuning of zero-shot models"); 0 is the trained ones.
        average_decay: the weights' exponential moving average with this decay is what is judged and saved; 0 is none.
    """

    updates: int = MISSING
    batch_size: int = MISSING
    seed: int = MISSING
    lr_start: float = MISSING
    halvings: int = MISSING
    noise_radii: float = MISSING
    noise_velocity: float = MISSING
    noise_in_walls: float = MISSING
    unroll: int = MISSING
    unroll_from: float = MISSING
    gradient_clip: float = MISSING
    loss_knee: float = MISSING
    balance: float = MISSING
    creep: float = MISSING
    creep_steps: int = MISSING
    gaps: float = MISSING
    start_from: str | None = None
    start_fixed: bool = False
    start_share: float = 0.0
    region_grains: int | None = None
    average_decay: float = MISSING

    def __post_init__(self) -> None:
        for key in ("updates", "batch_size", "lr_start"):
            value = getattr(self, key)
            require(value > 0, f"training.{key}", value, "above 0", f"set training.{key} above 0")
        at_least_0 = (
            "halvings",
            "noise_radii",
            "noise_velocity",
            "noise_in_walls",
            "unroll",
            "unroll_from",
            "gradient_clip",
            "loss_knee",
            "balance",
            "creep",
            "gaps",
        )
        for key in ("seed", *at_least_0):
            value = getattr(self, key)
            require(value >= 0, f"training.{key}", value, "at least 0", f"training.{key}=0 turns it off")
        steps = self.creep_steps
        require(steps > 1, "training.creep_steps", steps, "at least 2", "16 is the default")
        most = self.noise_in_walls
        require(most <= 1, "training.noise_in_walls", most, "0 to 1", "it is a share of grains")
        share, known = self.start_share, self.start_from is not None
        require(0 <= share < 1, "training.start_share", share, "0 up to below 1", "e.g. 0.5")
        require(not share or known, "training.start_share", share, "0 without training.start_from", "name a bundle")
        fixed = self.start_fixed
        require(not fixed or known, "training.start_fixed", fixed, "false without training.start_from", "name a bundle")
        region = self.region_grains
        require(region is None or region > 0, "training.region_grains", region, "at least 1", "null takes all grains")
        decay = self.average_decay
        require(0 <= decay < 1, "training.average_decay", decay, "0 up to below 1", "e.g. 0.998; 0 is no averaging")

    @property
    def window_length(self) -> int:
        """Frames a training window needs beside those before: the start, the model's own steps, the target."""
        return max(2 + self.unroll, 1 + self.creep_steps if self.creep or self.gaps else 0)
