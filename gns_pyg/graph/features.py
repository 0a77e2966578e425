"""Edge features, dimensionless: lengths over the grain radius (the mean of two), velocities over the data's scale.

They are computed in the state's float64 and cast to the networks' dtype last: a gap is a small difference of lengths,
and in float32 its rounding would be most of what float32 networks get wrong in a step.
Edge features follow Mayr et al. 2023 (the paper's [17]): relative position, distance, direction and inverse powers of
the distance; `contact` adds what a contact law would ask for: gap, approach, slip with spin, and the gap to come.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gns_pyg.state import Graph, State, Walls

N_GEOMETRY = 9
N_CONTACT = 10


def grain_edges(
    state: State, graph: Graph, *, velocity_m_s: float, dt_s: float, contact: bool, dtype: torch.dtype
) -> Float[Tensor, "n_grain_edges f"]:
    """Features of grain-grain edges; `rel_pos` points from receiver to sender."""
    sender, receiver = graph.grain_edges
    rel_pos = between(state.pos, sender, receiver)
    touch = state.radius[sender] + state.radius[receiver]
    radius = touch / 2
    distance, direction = polar(rel_pos, radius)
    features = _geometry(rel_pos, distance, direction, radius)
    if contact:
        rel_vel = between(state.vel, sender, receiver)
        slip = surface_slip(state, rel_vel, direction, sender, receiver)
        ahead = torch.linalg.vector_norm(rel_pos + rel_vel * dt_s, dim=1)
        features += _contact(distance - touch, ahead - touch, rel_vel, slip, direction, radius, velocity_m_s)
    return torch.cat([columns.to(dtype) for columns in features], dim=1)


def wall_edges(
    state: State, graph: Graph, walls: Walls, *, velocity_m_s: float, dt_s: float, contact: bool, dtype: torch.dtype
) -> Float[Tensor, "n_wall_edges f"]:
    """Features of edges from boundary points to grains; the gap is that to the point's tangent plane."""
    point, grain = graph.wall_edges
    rel_pos = walls.pos.index_select(0, point) - state.pos.index_select(0, grain)
    radius, normal = state.radius[grain], walls.normal.index_select(0, point)
    distance, direction = polar(rel_pos, radius)
    height = -dot(rel_pos, normal)
    features = [*_geometry(rel_pos, distance, direction, radius), (height / radius)[:, None]]
    if contact:
        rel_vel = walls.vel.index_select(0, point) - state.vel.index_select(0, grain)
        slip = surface_slip(state, rel_vel, -normal, grain)
        ahead = height - dot(rel_vel, normal) * dt_s
        features += _contact(height - radius, ahead - radius, rel_vel, slip, -normal, radius, velocity_m_s)
    return torch.cat([columns.to(dtype) for columns in features], dim=1)


def dot(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Scalar products, row by row; several times as fast as a sum over so short an axis."""
    x, y, z = (a * b).unbind(1)
    return x + y + z


def between(values: Tensor, sender: Tensor, receiver: Tensor) -> Tensor:
    """What the sender has more than the receiver, row by row."""
    return values.index_select(0, sender) - values.index_select(0, receiver)


def n_grain_edge_features(contact: bool) -> int:
    return N_GEOMETRY + contact * N_CONTACT


def n_wall_edge_features(contact: bool) -> int:
    return N_GEOMETRY + 1 + contact * N_CONTACT


def polar(rel_pos: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Distance and direction; the direction of coincident points is zero, and its gradient stays bounded."""
    distance = torch.linalg.vector_norm(rel_pos, dim=1)
    return distance, rel_pos / torch.maximum(distance, 1e-3 * radius)[:, None]


def surface_slip(
    state: State,
    rel_vel: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 3"],
    *ends: Int[Tensor, " n"],
) -> Float[Tensor, "n 3"]:
    """How the two surfaces of a contact move against each other, m/s: `rel_vel` and the spin of the grains at its ends,
    v + w x arm, arms of opposite sign; where the state holds no spin, `rel_vel`.

    Args:
        state: grains.
        rel_vel: of sender and receiver, m/s.
        direction: from receiver to sender.
        ends: the grains.
    """
    if state.ang_vel is None:
        return rel_vel
    arm = state.radius[:, None] * state.ang_vel
    turning = sum((arm.index_select(0, end) for end in ends[1:]), arm.index_select(0, ends[0]))
    return rel_vel - torch.linalg.cross(turning, direction)


def closeness(distance: Float[Tensor, " n"], radius: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Radius over distance, at most 10."""
    return radius / torch.maximum(distance, 0.1 * radius)


def _geometry(rel_pos: Tensor, distance: Tensor, direction: Tensor, radius: Tensor) -> list[Tensor]:
    near = closeness(distance, radius)
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
