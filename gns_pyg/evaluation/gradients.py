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


def gradient_norms(simulator: Simulator, state: State, counts: Iterable[int]) -> dict[int, float]:
    """Norm of d(sum of squared final positions) / d(initial positions) after so many steps, m (of m^2 / m).

    The memory grows with the steps: all of them are kept for the way back.

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
    start = state.pos.detach().clone().requires_grad_()
    now, done, norms = replace(state, pos=start), 0, {}
    for count in wanted:
        while done < count:
            now, done = simulator(now), done + 1
            _check_finite(now.pos, f"step {done} of {wanted[-1]}", "position")
        (gradient,) = torch.autograd.grad(now.pos.square().sum(), start, retain_graph=count != wanted[-1])
        _check_finite(gradient, f"{count} steps", "gradient by the initial position")
        norms[count] = float(torch.linalg.vector_norm(gradient))
    return norms


def _check_finite(values: Float[Tensor, "n_grains 3"], where: str, what: str) -> None:
    bad = (~torch.isfinite(values).all(dim=1)).nonzero()
    if len(bad):
        remedy = "train longer, or start from a state like those of the training cases"
        raise NumericalError(where, f"{what} of grain {int(bad[0])} is not finite", "finite values", remedy)
