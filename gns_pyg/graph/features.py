"""Edge features, dimensionless: lengths over the grain radius (the mean of two), velocities over the data's scale.

They are computed in the state's float64 and cast to the networks' dtype last: a gap is a small difference of lengths,
and in float32 its rounding would be most of what float32 networks get wrong in a step.
Edge features follow Mayr et al. 2023 (the paper's [17]): relative position, distance, direction and inverse powers of
the distance; `contact` adds what a contact law would ask for: gap, approach, slip with spin, and the gap to come.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.state import Graph, State, Walls

N_GEOMETRY = 9
N_CONTACT = 10


def grain_edges(
    state: State, graph: Graph, *, velocity_m_s: float, dt_s: float, contact: bool, dtype: torch.dtype
) -> Float[Tensor, "n_grain_edges f"]:
    """Features of grain-grain edges; `rel_pos` points from receiver to sender."""
    sender, receiver = graph.grain_edges
    rel_pos = _between(state.pos, sender, receiver)
    touch = state.radius[sender] + state.radius[receiver]
    radius = touch / 2
    distance, direction = _polar(rel_pos, radius)
    features = _geometry(rel_pos, distance, direction, radius)
    if contact:
        rel_vel = _between(state.vel, sender, receiver)
        slip = rel_vel
        if state.ang_vel is not None:  # surface velocities at the contact: v + w x arm, arms of opposite sign
            arm = state.radius[:, None] * state.ang_vel
            turning = arm.index_select(0, sender) + arm.index_select(0, receiver)
            slip = rel_vel - torch.linalg.cross(turning, direction)
        ahead = torch.linalg.vector_norm(rel_pos + rel_vel * dt_s, dim=1)
        features += _contact(distance - touch, ahead - touch, rel_vel, slip, direction, radius, velocity_m_s)
    return torch.cat(features, dim=1).to(dtype)


def wall_edges(
    state: State, graph: Graph, walls: Walls, *, velocity_m_s: float, dt_s: float, contact: bool, dtype: torch.dtype
) -> Float[Tensor, "n_wall_edges f"]:
    """Features of edges from boundary points to grains; the gap is that to the point's tangent plane."""
    point, grain = graph.wall_edges
    rel_pos = walls.pos.index_select(0, point) - state.pos.index_select(0, grain)
    radius, normal = state.radius[grain], walls.normal.index_select(0, point)
    distance, direction = _polar(rel_pos, radius)
    height = -dot(rel_pos, normal)
    features = [*_geometry(rel_pos, distance, direction, radius), (height / radius)[:, None]]
    if contact:
        rel_vel = walls.vel.index_select(0, point) - state.vel.index_select(0, grain)
        slip = rel_vel
        if state.ang_vel is not None:
            arm = state.radius[:, None] * state.ang_vel
            slip = rel_vel + torch.linalg.cross(arm.index_select(0, grain), normal)
        ahead = height - dot(rel_vel, normal) * dt_s
        features += _contact(height - radius, ahead - radius, rel_vel, slip, -normal, radius, velocity_m_s)
    return torch.cat(features, dim=1).to(dtype)


def dot(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Scalar products, row by row; several times as fast as a sum over so short an axis."""
    x, y, z = (a * b).unbind(1)
    return x + y + z


def _between(values: Tensor, sender: Tensor, receiver: Tensor) -> Tensor:
    return values.index_select(0, sender) - values.index_select(0, receiver)


def n_grain_edge_features(contact: bool) -> int:
    return N_GEOMETRY + contact * N_CONTACT


def n_wall_edge_features(contact: bool) -> int:
    return N_GEOMETRY + 1 + contact * N_CONTACT


def _polar(rel_pos: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Distance and direction; the direction of coincident points is zero, and its gradient stays bounded."""
    distance = torch.linalg.vector_norm(rel_pos, dim=1)
    return distance, rel_pos / torch.maximum(distance, 1e-3 * radius)[:, None]


def _geometry(rel_pos: Tensor, distance: Tensor, direction: Tensor, radius: Tensor) -> list[Tensor]:
    near = radius / torch.maximum(distance, 0.1 * radius)
    scalars = torch.stack([distance / radius, near, near**2], dim=1)
    return [rel_pos / radius[:, None], direction, scalars]


def _contact(
    gap: Tensor,
    gap_ahead: Tensor,
    rel_vel: Tensor,
    slip: Tensor,
    direction: Tensor,
    radius: Tensor,
    velocity_m_s: float,
) -> list[Tensor]:
    approach = dot(rel_vel, direction)[:, None]
    tangential = slip - dot(slip, direction)[:, None] * direction
    gaps = torch.stack([gap / radius, (gap / radius).clamp(max=0), gap_ahead / radius], dim=1)
    return [gaps, approach / velocity_m_s, rel_vel / velocity_m_s, tangential / velocity_m_s]
