"""Which grains can touch something within the frame; the others follow the scene's free-flight law."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gns_pyg.graph.features import dot
from gns_pyg.state import Graph, State

MARGIN_RADII = 0.1  # gaps this small count as touching: paths bend within a frame, and walls between their points


def can_touch(state: State, free_pos: Float[Tensor, "n_grains 3"], graph: Graph, dt_s: float) -> Bool[Tensor, " n"]:
    """Grains whose gap to some neighbour or wall is at most what closes within the frame.

    Two grains that fly freely from `state.pos` to `free_pos` close their gap by at most the part of their relative way
    along the line of centres. Not exact: a neighbour that is hit by a third grain may come faster, and grains beyond
    the cutoff are not seen; docs/requirements.md gives the error against the DEM.

    Args:
        state: grains now.
        free_pos: where they would be a frame later if nothing touched, m.
        graph: neighbours and boundary points within the cutoffs.
        dt_s: frame, s.
    """
    n, way = len(state.pos), free_pos - state.pos
    sender, receiver = graph.grain_edges
    where = torch.cat([state.pos, way], dim=1)
    rel_pos, rel_way = (where.index_select(0, sender) - where.index_select(0, receiver)).split(3, dim=1)
    distance = dot(rel_pos, rel_pos).sqrt()
    reach = state.radius[sender] + state.radius[receiver]
    closing = -dot(rel_way, rel_pos) / distance.clamp(min=1e-9)
    near = distance - reach <= closing.clamp(min=0) + MARGIN_RADII * reach / 2
    touches = torch.zeros(n, device=near.device).index_add(0, receiver, (near & (sender != receiver)).float())
    if graph.walls is not None:
        point, grain = graph.wall_edges
        normal, radius = graph.walls.normal[point], state.radius[grain]
        height = dot(state.pos[grain] - graph.walls.pos[point], normal)
        closing = dot(graph.walls.vel[point] * dt_s - way[grain], normal)
        near = height - radius <= closing.clamp(min=0) + MARGIN_RADII * radius
        touches = touches.index_add(0, grain, near.float())
    return touches > 0


def among(graph: Graph, touches: Bool[Tensor, " n_grains"]) -> Graph:
    """The part of a graph that connects grains that can touch something."""
    sender, receiver = graph.grain_edges
    return Graph(
        graph.grain_edges[:, touches[sender] & touches[receiver]],
        graph.wall_edges[:, touches[graph.wall_edges[1]]],
        graph.walls,
    )
