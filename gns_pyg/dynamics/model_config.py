"""The choices that make a model, beside what its scene requires; conf/model/*.yaml are its files."""

import math
from dataclasses import dataclass

from omegaconf import MISSING

from gns_pyg.config import require

NETWORKS = ("message", "impulse")


@dataclass
class ModelConfig:
    """Architecture of a simulator.

    Attributes:
        network: `message` sums messages into each grain's latent and reads what happens to it from there
            (`models.contact_network`, the paper's); `impulse` has every contact exchange impulses, equal and opposite
            (`models.impulse_network`).
        channels: vectors that a grain carries between the rounds of an impulse network.
        memory: frames over which the mean motion of a grain is a part of the state (see `dynamics.memory`; impulse
            networks, scenes whose walls all stand); 0: the state is of one instant.
        absolute_position: give networks the absolute position (the paper; breaks translation invariance).
        contact_features: gap, approach and slip on edges, beside the geometry of Mayr et al.
        self_loops: an edge from every grain to itself, so that one without neighbours is computed too (the paper).
        skip: skip connections and layer norms (not in the paper).
        hidden, layers, mlp_layers: width, rounds of message passing, linear layers of each MLP.
        cutoff_grain_radii: two grains see each other within this many times the mean of their radii.
        cutoff_wall_radii: a grain sees boundary points within this many of its radii.
        neighbors: search backend, or `auto`.
        projection_sweeps: rounds in which every step moves grains out of each other and of walls (see `projection`).
    """

    network: str = "message"
    channels: int = 6
    memory: int = 0
    absolute_position: bool = MISSING
    contact_features: bool = MISSING
    self_loops: bool = MISSING
    skip: bool = MISSING
    hidden: int = MISSING
    layers: int = MISSING
    mlp_layers: int = MISSING
    cutoff_grain_radii: float = MISSING
    cutoff_wall_radii: float = MISSING
    neighbors: str = "auto"
    projection_sweeps: int = 0

    def __post_init__(self) -> None:
        for key in ("cutoff_grain_radii", "cutoff_wall_radii"):
            value = getattr(self, key)
            require(0 < value < math.inf, f"model.{key}", value, "above 0 and finite", "2.5 is the paper's")
        require(self.network in NETWORKS, "model.network", self.network, " or ".join(NETWORKS), "pick one of them")
        if self.network == "impulse":
            needs = {"absolute_position": False, "contact_features": True, "self_loops": False, "skip": True}
            for key, needed in needs.items():
                value, expected = getattr(self, key), f"{needed} with model.network=impulse"
                require(value == needed, f"model.{key}", value, expected.lower(), "see conf/model/impulse.yaml")
        else:
            known = "0 with model.network=message"
            require(not self.memory, "model.memory", self.memory, known, "set model.network=impulse")
        lowest = {"channels": 3, "memory": 0, "hidden": 1, "layers": 1, "mlp_layers": 2, "projection_sweeps": 0}
        for key, least in lowest.items():
            value = getattr(self, key)
            require(value >= least, f"model.{key}", value, f"at least {least}", f"set model.{key} to {least} or more")
