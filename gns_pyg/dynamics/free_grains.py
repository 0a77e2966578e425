"""Who can touch whom within the frame: pairs that cannot need not be computed, and grains that can touch nothing follow
the scene's free-flight law."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gns_pyg.graph.features import dot
from gns_pyg.state import Graph, State

# gaps this small count as touching: paths bend within a frame, and walls between their points
MARGIN_RADII = 0.1  # of who takes part at all
PAIR_MARGIN_RADII = 0.05  # of a pair between those who do, beside what gravity bends (see `pair_margin_m`)


def pair_margin_m(radius: Float[Tensor, " n"], gravity_m_s2: Sequence[float], dt_s: float) -> Float[Tensor, " n"]:
    """How much wider than what closes in free flight the gap of a pair may be that is computed all the same, m: a share
    of the radius, and the way that gravity makes two grains part from it within a frame if others hold them up."""
    return PAIR_MARGIN_RADII * radius + math.hypot(*gravity_m_s2) * dt_s**2


def can_meet(
    state: State, free_pos: Float[Tensor, "n_grains 3"], graph: Graph, dt_s: float, margin_m: Tensor
) -> tuple[Bool[Tensor, " e"], Bool[Tensor, " w"]]:
    """Edges between grains, and to boundary points, whose gap is at most what closes within the frame.

    Two grains that fly freely from `state.pos` to `free_pos` close their gap by at most the part of their relative way
    along the line of centres. Not exact: a neighbour that is hit by a third grain may come faster, and grains beyond
    the cutoff are not seen; docs/requirements.md gives the error against the DEM.

    Args:
        state: grains now.
        free_pos: where they would be a frame later if nothing touched, m.
        graph: neighbours and boundary points within the cutoffs.
        dt_s: frame, s.
        margin_m: how much wider a gap may be, m, (n_grains,); between grains the mean of two.
    """
    way = free_pos - state.pos
    sender, receiver = graph.grain_edges
    where = torch.cat([state.pos, way], dim=1)
    rel_pos, rel_way = (where.index_select(0, sender) - where.index_select(0, receiver)).split(3, dim=1)
    distance = dot(rel_pos, rel_pos).sqrt()
    reach = state.radius[sender] + state.radius[receiver]
    closing = -dot(rel_way, rel_pos) / distance.clamp(min=1e-9)
    room = (margin_m[sender] + margin_m[receiver]) / 2
    near = (distance - reach <= closing.clamp(min=0) + room) & (sender != receiver)
    if graph.walls is None:
        return near, near[:0]
    point, grain = graph.wall_edges
    normal, radius = graph.walls.normal[point], state.radius[grain]
    height = dot(state.pos[grain] - graph.walls.pos[point], normal)
    closing = dot(graph.walls.vel[point] * dt_s - way[grain], normal)
    return near, height - radius <= closing.clamp(min=0) + margin_m[grain]


def meeting(graph: Graph, near: Bool[Tensor, " e"], near_wall: Bool[Tensor, " w"]) -> Graph:
    """The part of a graph whose ends can meet."""
    return Graph(graph.grain_edges[:, near], graph.wall_edges[:, near_wall], graph.walls)


def can_touch(graph: Graph, near: Bool[Tensor, " e"], near_wall: Bool[Tensor, " w"], n: int) -> Bool[Tensor, " n"]:
    """Which of `n` grains can meet somebody, or a wall."""
    touches = torch.zeros(n, device=near.device)
    for named, close in ((graph.grain_edges[0], near), (graph.grain_edges[1], near), (graph.wall_edges[1], near_wall)):
        touches = touches.index_add(0, named, close.float())
    return touches > 0


def among(graph: Graph, touches: Bool[Tensor, " n_grains"]) -> Graph:
    """The part of a graph that connects grains that can touch something."""
    sender, receiver = graph.grain_edges
    return Graph(
        graph.grain_edges[:, touches[sender] & touches[receiver]],
        graph.wall_edges[:, touches[graph.wall_edges[1]]],
        graph.walls,
    )
