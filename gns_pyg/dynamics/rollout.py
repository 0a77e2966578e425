"""Feeding a simulator its own output."""

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch

from gns_pyg.errors import NumericalError
from gns_pyg.state import State

log = logging.getLogger(__name__)


def rollout(
    simulator: Callable[[State], State],
    state: State,
    n_steps: int,
    *,
    settles: bool = False,
    reach_m: float = math.inf,
) -> Iterator[State]:
    """Yields the `n_steps` states that follow `state`.

    Args:
        simulator: one step.
        state: where it starts.
        n_steps: how many.
        settles: a state that a step leaves as it was stays so for ever (see `Simulator.settles`): no step is computed
            any more.
        reach_m: warns once of a grain that goes further than this in a step.

    Raises:
        NumericalError: at the first value that is not finite, the start's included; names step, field and grain.
    """
    check_finite(state, 0)
    before, rests, warned = state, False, False
    for step in range(1, n_steps + 1):
        if rests:
            before, state = state, replace(state, time_s=2 * state.time_s - before.time_s)
        else:
            with torch.inference_mode():
                before, state = state, simulator(state)
            check_finite(state, step)
            rests = settles and _same(before, state)
            warned = warned or _warn_fast(before, state, step, reach_m)
        yield state


def check_finite(state: State, step: int) -> None:
    """Raises NumericalError if a value is not finite; names step, field and grain."""
    for field in ("pos", "vel", "ang_vel", "drift", "radius"):
        values = getattr(state, field)
        if values is not None and not torch.isfinite(values).all():
            grain = int((~torch.isfinite(values)).nonzero()[0, 0])
            raise NumericalError(
                f"roll-out step {step}",
                f"{field} of grain {grain} is not finite",
                "finite values",
                "the model left what it was trained on: train longer or on its own roll-outs"
                if step
                else "correct the state that the roll-out starts from",
            )


def _same(before: State, after: State) -> bool:
    fields = ("pos", "vel", "ang_vel", "drift", "active")
    pairs = [(getattr(before, field), getattr(after, field)) for field in fields]
    return all(one is two or torch.equal(one, two) for one, two in pairs)


def _warn_fast(before: State, after: State, step: int, reach_m: float) -> bool:
    """Whether some grain went too far to have seen what it could meet; says so."""
    if reach_m == math.inf or not len(after.pos):
        return False
    way = torch.linalg.vector_norm(after.pos - before.pos, dim=1)
    if after.active is not None and before.active is not None:
        way = torch.where(after.active & before.active, way, 0.0)
    way_m, grain = (float(value) for value in way.max(dim=0))
    if way_m <= reach_m:
        return False
    log.warning(
        "roll-out step %d: grain %d at %.3g m/s goes %.3g m, further than the %.3g m that it sees: it may pass through "
        "others unnoticed (not through walls); this is said once",
        step,
        grain,
        way_m / float((after.time_s - before.time_s)[0]),
        way_m,
        reach_m,
    )
    return True
