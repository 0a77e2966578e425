"""Moves grains apart that a step has pushed into each other or into a wall: what a network does not learn to avoid.

Positions are corrected, contact by contact, as position-based dynamics does (Mueller et al. 2007, section 3), all
contacts at once and averaged over those of a grain (Macklin et al. 2014, section 4). Overlap that DEM has too stays.
A wall is the plane of the nearest boundary point; at an edge that juts into the scene (a hopper's mouth), that is not
its surface.
"""

from dataclasses import replace

import torch
from jaxtyping import Int
from torch import Tensor

from gns_pyg.graph.features import dot
from gns_pyg.state import State, Walls, least_of_each

OVERLAP = 0.002  # of the distance at touch: left alone; DEM's own mean is 0.001 to 0.003 in our scenes
RELAXATION = 1.5  # of the averaged corrections (Macklin et al. 2014: 1 to 2)


def separated(
    state: State,
    pairs: Int[Tensor, "2 n_pairs"],
    walls: Walls | None,
    contacts: Int[Tensor, "2 n_contacts"],
    sweeps: int,
) -> State:
    """`state` with its grains moved apart; their velocity into a wall that they touch is that of the wall.

    Args:
        state: after the step.
        pairs: [sender, receiver] of all grains that could overlap, both ways.
        walls: boundary points near them, at the state's own time; None without walls.
        contacts: [point, grain] of those in reach.
        sweeps: rounds of correction.
    """
    sender, receiver = pairs
    touch = state.radius[sender] + state.radius[receiver]
    cubes = state.radius**3
    share = (cubes[sender] / (cubes[sender] + cubes[receiver]))[:, None]  # the lighter one gives way
    planes = None if walls is None else nearest_walls(state, walls, contacts)
    pos, vel = state.pos, state.vel
    for _ in range(sweeps):
        apart = pos.index_select(0, receiver) - pos.index_select(0, sender)
        distance = torch.linalg.vector_norm(apart, dim=1)
        depth = ((1 - OVERLAP) * touch - distance).clamp(min=0)
        push = share * (depth / torch.maximum(distance, 1e-3 * touch))[:, None] * apart
        moved = torch.zeros_like(pos).index_add_(0, receiver, push)
        count = torch.zeros_like(state.radius).index_add_(0, receiver, (depth > 0).to(pos.dtype))
        pos = pos + RELAXATION * moved / count.clamp(min=RELAXATION)[:, None]
        if planes is not None:  # last, so that no sweep leaves a grain in a wall
            grain, point, normal, _ = planes
            below = (state.radius[grain] - dot(pos[grain] - point, normal)).clamp(min=0)
            pos = pos.index_add(0, grain, below[:, None] * normal)
    if planes is not None:
        grain, point, normal, wall_vel = planes
        touching = dot(pos[grain] - point, normal) <= state.radius[grain] * (1 + OVERLAP)
        into = dot(vel[grain] - wall_vel, normal).clamp(max=0) * touching
        vel = vel.index_add(0, grain, -into[:, None] * normal)
    return replace(state, pos=pos, vel=vel)


def nearest_walls(
    state: State, walls: Walls, contacts: Int[Tensor, "2 n_contacts"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Every grain that has a boundary point in reach, (n,); of the nearest one: place, normal and velocity, (n, 3)."""
    point, grain = contacts
    apart = state.pos.index_select(0, grain) - walls.pos.index_select(0, point)
    nearest = least_of_each(grain, dot(apart, apart))
    near, chosen = grain[nearest], point[nearest]
    return near, walls.pos[chosen], walls.normal[chosen], walls.vel[chosen]
