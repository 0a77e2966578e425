"""What training does to the states that it starts from, so that a roll-out that errs finds its way back."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gns_pyg.dynamics.projection import nearest_walls
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.graph.features import dot
from gns_pyg.state import State, reached
from gns_pyg.training.config import TrainingConfig

AT_WALL = (0.9, 1.05)  # radii: whose centre is so high over the nearest point's plane touches the wall; at an edge
# that juts into the scene grains stand lower over that plane, which is not the wall there


def perturb(
    state: State, config: TrainingConfig, simulator: Simulator, randoms: Sequence[torch.Generator]
) -> tuple[State, Bool[Tensor, " n_grains"]]:
    """A copy of `state` with Gaussian noise on positions, velocities and spins, and with some grains in a wall; each
    graph's drawn from its generator. And which grains have no other within the cutoff that was put there: what follows
    for those in the DEM is no answer to the state that they are in now."""
    sizes = torch.bincount(state.batch, minlength=state.n_graphs).tolist()
    each = list(zip(sizes, randoms, strict=True))

    def noise(like: Tensor) -> Tensor:
        drawn = [torch.randn((size, 3), dtype=like.dtype, generator=random) for size, random in each]
        return torch.cat(drawn).to(like.device)

    scale = simulator.statistics
    noisy = replace(
        state,
        pos=state.pos + config.noise_radii * state.radius[:, None] * noise(state.pos),
        vel=state.vel + config.noise_velocity * scale.velocity_m_s * noise(state.vel),
        ang_vel=None
        if state.ang_vel is None
        else state.ang_vel + config.noise_velocity * scale.spin_rad_s * noise(state.ang_vel),
    )
    if not config.noise_in_walls or simulator.boundary is None:
        return noisy, torch.ones_like(state.batch, dtype=torch.bool)
    drawn = [torch.rand((size, 2), dtype=state.pos.dtype, generator=random) for size, random in each]
    pos, moved = in_walls(noisy, config.noise_in_walls, simulator, torch.cat(drawn).to(state.pos.device))
    sender, receiver = simulator.pairs_in_reach(noisy)
    return replace(noisy, pos=pos), ~reached(len(moved), receiver[moved[sender] & (sender != receiver)])


def in_walls(
    state: State, share: float, simulator: Simulator, drawn: Float[Tensor, "n_grains 2"]
) -> tuple[Float[Tensor, "n_grains 3"], Bool[Tensor, " n_grains"]]:
    """Where grains are, m, when a share of those that touch a wall is moved into it by up to a radius; who is moved.

    Args:
        state: before.
        share: of those grains.
        simulator: has a boundary.
        drawn: two uniform numbers a grain: who is moved, and by how many radii.
    """
    assert simulator.boundary is not None
    grain, point, normal, _ = nearest_walls(state, *simulator.boundary.contacts(state))
    who, depth = drawn[grain].unbind(1)
    radius, (low, high) = state.radius[grain], AT_WALL
    height = dot(state.pos[grain] - point, normal)
    moved = (who < share) & (height > low * radius) & (height < high * radius)
    pos = state.pos.index_add(0, grain, -(moved * depth * radius)[:, None] * normal)
    return pos, reached(len(pos), grain[moved])
