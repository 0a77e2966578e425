"""Contacts for networks that exchange impulses (see `models.impulse_network`): what stays when everything is turned,
and directions that turn with it. Lengths over the grain radius (the mean of two), velocities over the data's scale.

As in `features`, all is computed in the state's float64 and cast last.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.graph.features import between, closeness, dot, polar, surface_slip
from gns_pyg.state import SOFT, Contacts, Graph, State, Walls, fine

N_SCALARS, N_WALL_SCALARS = 11, 13
N_BASIS, N_WALL_BASIS = 2, 3
FINE = 1e-3  # of a radius: an overlap that bears a few grains; slip that is slower than this in a frame is slow


def grain_contacts(
    state: State,
    free_vel: Float[Tensor, "n 3"],
    graph: Graph,
    *,
    unlike: bool,
    slow: float,
    velocity_m_s: float,
    dt_s: float,
    dtype: torch.dtype,
    drift: Float[Tensor, "n 3"] | None = None,
) -> Contacts:
    """Pairs of grains. Directions: the line of centres, the slip.

    Args:
        state: grains now.
        free_vel: their velocity a frame later if nothing touched, m/s.
        graph: pairs in one direction.
        unlike: masses differ.
        slow: see `Contacts`.
        velocity_m_s, dt_s: the data's velocity scale and the frame.
        dtype: the networks'.
        drift: mean velocity of grains over the last frames, m/s, where the model looks at it.
    """
    sender, receiver = graph.grain_edges
    rel_pos, rel_vel = (between(x, sender, receiver) for x in (state.pos, free_vel))
    touch = state.radius[sender] + state.radius[receiver]
    radius, (distance, normal) = touch / 2, polar(rel_pos, touch)
    slip = surface_slip(state, rel_vel, normal, sender, receiver)
    ahead = torch.linalg.vector_norm(rel_pos + rel_vel * dt_s, dim=1)
    scalars, sideways = _scalars(distance, distance - touch, ahead - touch, slip, normal, radius, velocity_m_s, dt_s)
    share = None
    if unlike:
        mass = torch.stack([state.radius[receiver], state.radius[sender]], dim=1) ** 3
        share = (2 * mass / mass.sum(1, keepdim=True)).to(dtype)
    basis, drifts = torch.stack([normal, sideways], dim=2), None
    if drift is not None:
        drifts = _drifts(between(drift, sender, receiver) / velocity_m_s, basis, slow).to(dtype)
    return Contacts(graph.grain_edges, scalars.to(dtype), basis.to(dtype), slow, drift=drifts, share=share)


def wall_contacts(
    state: State,
    free_vel: Float[Tensor, "n 3"],
    graph: Graph,
    walls: Walls,
    *,
    friction: bool,
    moving: bool,
    slow: float,
    velocity_m_s: float,
    dt_s: float,
    dtype: torch.dtype,
    drift: Float[Tensor, "n 3"] | None = None,
) -> Contacts:
    """Boundary points and grains; the gap is that to the point's tangent plane. Directions: against the wall's normal,
    the slip, towards the point.

    Args:
        friction: the point's friction angle is a scalar too.
        moving: walls move.
        The others: as of `grain_contacts`.
    """
    point, grain = graph.wall_edges
    normal, wall_vel = -walls.normal.index_select(0, point), walls.vel.index_select(0, point)
    rel_pos = walls.pos.index_select(0, point) - state.pos.index_select(0, grain)
    radius, rel_vel = state.radius[grain], wall_vel - free_vel.index_select(0, grain)
    (distance, towards), height = polar(rel_pos, radius), dot(rel_pos, normal)
    slip = surface_slip(state, rel_vel, normal, grain)
    ahead = height + dot(rel_vel, normal) * dt_s
    scalars, sideways = _scalars(distance, height - radius, ahead - radius, slip, normal, radius, velocity_m_s, dt_s)
    aside = torch.linalg.vector_norm(rel_pos - height[:, None] * normal, dim=1, keepdim=True) / radius[:, None]
    columns = [scalars, aside, aside.square()]
    if friction:
        columns.append(walls.friction_angle[point][:, None])
    basis, own_vel = torch.stack([normal, sideways, towards], dim=2), (wall_vel / velocity_m_s).to(dtype)
    scalars, drifts = torch.cat(columns, dim=1).to(dtype), None
    if drift is not None:
        drifts = _drifts(-drift.index_select(0, grain) / velocity_m_s, basis, slow).to(dtype)  # walls stand
    return Contacts(graph.wall_edges, scalars, basis.to(dtype), slow, own_vel if moving else None, drifts)


def _drifts(drift: Float[Tensor, "e 3"], basis: Float[Tensor, "e 3 b"], slow: float) -> Float[Tensor, "e f"]:
    """As of `Contacts`; all 0 where nothing drifts."""
    speed = (drift.square().sum(1, keepdim=True) + SOFT).sqrt() - SOFT**0.5
    seen = torch.cat([torch.einsum("ei,eib->eb", drift, basis), speed], dim=1)
    return torch.cat([seen, fine(seen, slow)], dim=1)


def _scalars(
    distance: Tensor,
    gap: Tensor,
    ahead: Tensor,
    slip: Tensor,
    normal: Tensor,
    radius: Tensor,
    velocity_m_s: float,
    dt_s: float,
) -> tuple[Tensor, Tensor]:
    """The scalars that all contacts have, and the direction of the slip, which fades where there is none."""
    approach = dot(slip, normal)
    tangential = slip - approach[:, None] * normal
    speed = torch.linalg.vector_norm(tangential, dim=1)
    near = closeness(distance, radius)
    gap, ahead = gap / radius, ahead / radius
    slow_m_s = FINE * radius / dt_s
    finely = fine(torch.stack([gap / FINE, ahead / FINE, approach / slow_m_s, speed / slow_m_s]), 1.0)
    columns = [distance / radius, near, near**2, gap, ahead, approach / velocity_m_s, speed / velocity_m_s, *finely]
    sideways = tangential / (speed.square() + slow_m_s.square()).sqrt()[:, None]
    return torch.stack(columns, dim=1), sideways
