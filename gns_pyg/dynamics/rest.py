"""A grain that stands stays: what static friction does in the DEM, and what a network that is never quite exact undoes.

A grain that nothing holds gains, in one step, the velocity of free flight from rest. One that the step moves by less
than a small part of where that would carry it, and that is slower than half of it before and after, is held by its
contacts: it is left where it is. (In free flight it cannot be slower than that half both before and after.) Only scenes
whose walls all stand have such a rest (see `scene.requirements`); without gravity no grain is slow by this measure.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.state import State

REST = 0.15  # of the way that the speed of a step of free flight from rest would carry a grain
REST_AFTER_CREEP = 0.03  # the same for models that know a grain's mean motion: others do not creep, they tremble on


def rested(
    before: State, after: State, gained_m_s: Float[Tensor, " n_grains"], dt_s: float, share: float = REST
) -> State:
    """`after`, with every grain at rest that hardly moved.

    What a network says of positions and velocities is not quite consistent: a grain may stay in its place for ever and
    keep a velocity of some mm/s. The place decides.

    Args:
        before, after: the step.
        gained_m_s: speed of each grain after a step of free flight from rest.
        dt_s: the step.
        share: of that way; who goes less, stands.
    """
    stands = torch.linalg.vector_norm(after.pos - before.pos, dim=1) < share * gained_m_s * dt_s
    for state in (before, after):
        stands &= torch.linalg.vector_norm(state.vel, dim=1) < gained_m_s / 2
    rows = stands[:, None]
    still = torch.zeros_like(after.vel)
    return replace(
        after,
        pos=torch.where(rows, before.pos, after.pos),
        vel=torch.where(rows, still, after.vel),
        ang_vel=None if after.ang_vel is None else torch.where(rows, still, after.ang_vel),
    )
