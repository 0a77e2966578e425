"""What training does to the states that it starts from, so that a roll-out that errs finds its way back."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gns_pyg.dynamics.projection import nearest_walls
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.graph.features import dot
from gns_pyg.state import State
from gns_pyg.training.config import TrainingConfig

AT_WALL = 1.05  # radii: whose centre is no higher over a wall than this, is at it


def perturb(state: State, config: TrainingConfig, simulator: Simulator, randoms: Sequence[torch.Generator]) -> State:
    """A copy of `state` with Gaussian noise on positions, velocities and spins, and with some grains in a wall; each
    graph's drawn from its generator. `state` itself stays as it is."""
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
        return noisy
    drawn = [torch.rand((size, 2), dtype=state.pos.dtype, generator=random) for size, random in each]
    return in_walls(noisy, config.noise_in_walls, simulator, torch.cat(drawn).to(state.pos.device))


def in_walls(state: State, share: float, simulator: Simulator, drawn: Tensor) -> State:
    """`state` with a share of the grains that touch a wall moved into the nearest one, by up to a radius.

    Args:
        state: with the walls' parts at its own times.
        share: of those grains.
        simulator: has a boundary.
        drawn: two uniform numbers a grain: who is moved, and by how many radii, (n_grains, 2).
    """
    assert simulator.boundary is not None
    grain, point, normal, _ = nearest_walls(state, *simulator.boundary.contacts(state))
    who, depth = drawn[grain].unbind(1)
    radius = state.radius[grain]
    moved = (who < share) & (dot(state.pos[grain] - point, normal) < AT_WALL * radius)
    return replace(state, pos=state.pos.index_add(0, grain, -(moved * depth * radius)[:, None] * normal))
