"""A grain's mean motion as a part of the state.

Grains of a heap that creeps tremble: contacts swing within a frame, and the velocity of an instant hardly shows where a
slow grain goes (docs/heap.md, "What carries a slide"). The exponential mean of its last frames' ways does.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.state import State

FRAMES = 3  # times the memory: what is older counts for less than a twentieth
FAST = 40.0  # times what is slow (`graph.contacts.FINE` of a radius in a frame): such a grain needs no memory


def recorded(pos: Float[Tensor, "n_frames n 3"], memory: float, dt_s: float) -> Float[Tensor, "n 3"]:
    """The mean velocity of grains at the last of several frames, m/s.

    Args:
        pos: where they were, m, at least two frames.
        memory: frames over which the mean goes, at least 1.
        dt_s: from one frame to the next.
    """
    age = torch.arange(len(pos) - 2, -1, -1, dtype=pos.dtype, device=pos.device)
    weight = (1 - 1 / memory) ** age
    return torch.einsum("f,fgi->gi", weight / weight.sum(), pos.diff(dim=0)) / dt_s


def remembered(before: State, after: State, memory: int, dt_s: float, still_m_s: Float[Tensor, " n"]) -> State:
    """`after`, its drift that of `before` and of the way between them; of a grain that enters its velocity.

    Args:
        before, after: a step.
        memory: steps over which the mean goes.
        dt_s: the step.
        still_m_s: what is slower has no drift once it stands, so that a heap at rest is one.
    """
    drift, moved = known(before), (after.pos - before.pos) / dt_s
    stands = (moved == 0).all(1) & (torch.linalg.vector_norm(drift, dim=1) < still_m_s)
    drift = torch.where(stands[:, None], 0.0, drift + (moved - drift) / memory)
    if before.active is not None and after.active is not None:
        drift = torch.where((before.active & after.active)[:, None], drift, after.vel)
    return replace(after, drift=drift)


def known(state: State) -> Float[Tensor, "n 3"]:
    """The drift of grains, m/s; their velocity where a state, made by hand, does not say."""
    return state.vel if state.drift is None else state.drift


def of_slow(state: State, slow_m_s: float) -> Float[Tensor, "n 3"]:
    """The drift of grains that creep, m/s; it fades to nothing for those as fast as FAST times `slow_m_s`."""
    drift = known(state)
    share = (1 - drift.square().sum(1, keepdim=True) / (FAST * slow_m_s) ** 2).clamp(min=0)
    return share.square() * drift
