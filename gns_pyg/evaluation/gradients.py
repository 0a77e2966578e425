"""How far a change of the start reaches: gradients through many steps of a simulator."""

from collections.abc import Iterable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.config import require
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import NumericalError
from gns_pyg.state import State

FIELDS = ("pos", "vel", "ang_vel")


def gradient_norms(simulator: Simulator, state: State, counts: Iterable[int]) -> dict[int, float]:
    """Norm of d(sum of squared final positions) / d(initial positions) after so many steps, m.

    Steps are kept as states and taken again one by one on the way back: the memory is that of one step.

    Args:
        simulator: its networks' dtype is that of the gradients inside a step; between steps they are float64.
        state: where the steps start.
        counts: numbers of steps, each at least 0.

    Returns:
        Number of steps -> norm over all grains.

    Raises:
        ConfigError: for a negative number of steps.
        NumericalError: for a position or gradient that is not finite; names step and grain.
    """
    wanted = sorted(set(counts))
    require(all(count >= 0 for count in wanted), "counts", wanted, "numbers of steps, at least 0", "e.g. [1, 10, 100]")
    states, norms = [state], {}
    with torch.no_grad():
        for step in range(1, max(wanted, default=0) + 1):
            states.append(simulator(states[-1]))
            _check_finite(states[-1].pos, f"step {step} of {wanted[-1]}", "position")
    for count in wanted:
        pulled = {name: torch.zeros_like(value) for name, value in _fields(states[count]).items()}
        pulled["pos"] = 2 * states[count].pos
        for before in reversed(states[:count]):
            pulled = _pull_back(simulator, before, pulled)
        _check_finite(pulled["pos"], f"gradient through {count} steps", "derivative by the position")
        norms[count] = float(torch.linalg.vector_norm(pulled["pos"]))
    return norms


def _pull_back(simulator: Simulator, before: State, after: dict[str, Tensor]) -> dict[str, Tensor]:
    """Derivatives by the fields of `before`, of what has the derivatives `after` by those a step later."""
    leaves = {name: value.clone().requires_grad_() for name, value in _fields(before).items()}
    following = _fields(simulator(replace(before, **leaves)))
    found = torch.autograd.grad(
        [following[name] for name in leaves],
        list(leaves.values()),
        [after[name] for name in leaves],
        materialize_grads=True,
    )
    return dict(zip(leaves, found, strict=True))


def _fields(state: State) -> dict[str, Tensor]:
    return {name: value for name in FIELDS if (value := getattr(state, name)) is not None}


def _check_finite(values: Float[Tensor, "n_grains 3"], where: str, what: str) -> None:
    bad = (~torch.isfinite(values).all(dim=1)).nonzero()
    if len(bad):
        remedy = "train longer, or start from a state like those of the training cases"
        raise NumericalError(where, f"{what} of grain {int(bad[0])} is not finite", "finite values", remedy)
