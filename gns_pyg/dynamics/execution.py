"""How a simulator computes its steps: speed and memory, not what is computed."""

from dataclasses import dataclass

import torch

from gns_pyg import machine
from gns_pyg.config import require

PRECISIONS = ("float32", "float64", "tf32", "bfloat16")


@dataclass
class Execution:
    """Choices of a roll-out; training has Lightning's own.

    Attributes:
        precision: of the networks' products; state and integration stay in float64. tf32 needs CUDA, bfloat16 CUDA or a
            processor that has it.
        tile_grains: grains computed at once; more are taken tile by tile, with the same result. None is no limit.
        capture: replay the step as a CUDA graph with fixed capacities (see `dynamics.captured`).
    """

    precision: str = "float32"
    tile_grains: int | None = None
    capture: bool = False

    def __post_init__(self) -> None:
        known, most = self.precision in PRECISIONS, self.tile_grains
        require(known, "execution.precision", self.precision, " or ".join(PRECISIONS), "pick one of them")
        require(most is None or most > 0, "execution.tile_grains", most, "at least 1", "null computes all at once")
        both = self.capture and most is not None
        require(
            not both, "execution.capture", "true with tile_grains", "one of the two", "set execution.tile_grains=null"
        )

    def check(self, where: torch.device) -> None:
        """Checks that `where` can do it.

        Raises:
            ConfigError: if it cannot.
        """
        cuda = where.type == "cuda"
        able = {"tf32": cuda, "bfloat16": cuda or machine.has_bfloat16()}.get(self.precision, True)
        found = f"{self.precision} on a {where.type} without it"
        require(able, "execution.precision", found, "a device that computes in it", "set execution.precision=float32")
        require(cuda or not self.capture, "execution.capture", f"true on a {where.type}", "CUDA", "set it to false")

    @property
    def autocast(self) -> torch.dtype | None:
        """What the networks' products are cast to; None is no cast."""
        return torch.bfloat16 if self.precision == "bfloat16" else None
