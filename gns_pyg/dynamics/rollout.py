"""Feeding a simulator its own output."""

from collections.abc import Callable, Iterator

import torch

from gns_pyg.errors import NumericalError
from gns_pyg.state import State


def rollout(simulator: Callable[[State], State], state: State, n_steps: int) -> Iterator[State]:
    """Yields the `n_steps` states that follow `state`.

    Raises:
        NumericalError: at the first value that is not finite; names step, field and grain.
    """
    for step in range(1, n_steps + 1):
        with torch.inference_mode():
            state = simulator(state)
        for field in ("pos", "vel", "ang_vel"):
            values = getattr(state, field)
            if values is not None and not torch.isfinite(values).all():
                grain = int((~torch.isfinite(values).all(dim=1)).nonzero()[0])
                raise NumericalError(
                    f"roll-out step {step}",
                    f"{field} of grain {grain} is not finite",
                    "finite values",
                    "the model left what it was trained on: train longer or on its own roll-outs",
                )
        yield state
