"""The boundary points of a scene: where they are at a time, and which of them a grain can reach."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gns_pyg.graph.neighbors import Index, backend
from gns_pyg.scene.boundary_points import BoundaryPoints
from gns_pyg.scene.motion import rotation, to_body, to_world
from gns_pyg.scene.scene import Motion, Scene
from gns_pyg.state import State, Walls


class BoundaryPart(nn.Module):
    """One rigid part, stored and searched in its body frame. There it never moves, whatever its motion:
    the search structure is built once, and grains are taken to the body frame instead of points to the world.

    Args:
        points: boundary points at t = 0.
        motion: the part's rigid motion.
        neighbors: search backend (see `graph.neighbors`).
    """

    pos: Tensor
    normal: Tensor

    def __init__(self, points: BoundaryPoints, motion: Motion, neighbors: str) -> None:
        super().__init__()
        self.motion, self.neighbors = motion, neighbors
        self.register_buffer("pos", torch.as_tensor(points.pos, dtype=torch.float64))
        self.register_buffer("normal", torch.as_tensor(points.normal, dtype=torch.float64))
        self._index: Index | None = None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "BoundaryPart":
        """Follows the networks to another device, but stays in float64 when they are cast to another dtype."""
        pos, normal = self.pos, self.normal
        super()._apply(fn, recurse)
        self.pos, self.normal, self._index = pos.to(self.pos.device), normal.to(self.pos.device), None
        return self

    def at(self, time_s: Float[Tensor, " b"]) -> tuple[Float[Tensor, "b p 3"], ...]:
        """World positions, normals and velocities of the points at each time."""
        pos, vel = to_world(self.motion, self.pos, time_s)
        return pos, self.normal @ rotation(self.motion, time_s).transpose(1, 2), vel

    def within(self, state: State, reach_m: float) -> tuple[Int[Tensor, " e"], Int[Tensor, " e"]]:
        """Every (point, grain) at most `reach_m` apart."""
        if self._index is None:
            build = backend(self.neighbors, self.pos.device).build
            self._index = build(self.pos, torch.zeros(len(self.pos), dtype=torch.long, device=self.pos.device))
        body_pos = to_body(self.motion, state.pos.detach(), state.time_s[state.batch])
        point, grain = self._index(body_pos, torch.zeros_like(state.batch), reach_m)
        return point, grain


class Boundary(nn.Module):
    """All parts of a scene's boundary; their points are numbered part after part, then graph after graph."""

    def __init__(self, scene: Scene, points: Mapping[str, BoundaryPoints], neighbors: str) -> None:
        super().__init__()
        self.parts = nn.ModuleList(
            BoundaryPart(points[name], part.motion, neighbors) for name, part in scene.boundary.items()
        )
        self.moves = any(part.motion.moves for part in scene.boundary.values())

    def __iter__(self) -> Iterator[BoundaryPart]:
        return iter(cast(Iterable[BoundaryPart], self.parts))

    def at(self, time_s: Float[Tensor, " b"]) -> Walls:
        """The boundary of every graph at its time."""
        parts = zip(*(part.at(time_s) for part in self), strict=True)
        return Walls(*(torch.cat(values, dim=1).flatten(0, 1) for values in parts))

    def edges(self, state: State, reach_m: float) -> Int[Tensor, "2 e"]:
        """[point (row of `at`), grain] for every pair within reach."""
        found: list[Tensor] = []
        offset = 0
        per_graph = sum(len(part.pos) for part in self)
        for part in self:
            point, grain = part.within(state, reach_m)
            found.append(torch.stack([point + offset + per_graph * state.batch[grain], grain]))
            offset += len(part.pos)
        return torch.cat(found, dim=1)
