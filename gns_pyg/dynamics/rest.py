"""A grain that stands stays: what static friction does in the DEM, and what a network that is never quite exact undoes.

A grain that nothing holds gains, in one step, the speed of free flight from rest. One that was slower than a small part
of that, and that the step leaves slower than it, is held by its contacts: it is left where it is. Only scenes whose
walls all stand have such a rest (see `scene.requirements`); without gravity no grain is slow by this measure.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.state import State

REST = 0.15  # of the speed that a step of free flight gives a standing grain


def rested(before: State, after: State, gained_m_s: Float[Tensor, " n_grains"]) -> State:
    """`after`, with every grain at rest that stood before and hardly moved.

    Args:
        before, after: the step.
        gained_m_s: speed of each grain after a step of free flight from rest.
    """
    slow = REST * gained_m_s
    stands = _speed(before) < slow
    stands &= _speed(after) < slow
    rows = stands[:, None]
    still = torch.zeros_like(after.vel)
    return replace(
        after,
        pos=torch.where(rows, before.pos, after.pos),
        vel=torch.where(rows, still, after.vel),
        ang_vel=None if after.ang_vel is None else torch.where(rows, still, after.ang_vel),
    )


def _speed(state: State) -> Float[Tensor, " n_grains"]:
    return torch.linalg.vector_norm(state.vel, dim=1)
