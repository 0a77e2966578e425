"""The boundary points of a scene: which of them a grain can reach, and where those are."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.graph.neighbors import Index, backend
from gns_pyg.scene.boundary_points import BoundaryPoints
from gns_pyg.scene.mesh import planes
from gns_pyg.scene.motion import to_body, to_world, turn
from gns_pyg.scene.scene import Part, Scene
from gns_pyg.state import State, Walls, least_of_each


class BoundaryPart(nn.Module):
    """One rigid part, stored and searched in its body frame. There it never moves, whatever its motion:
    the search structure is built once, and grains are taken to the body frame instead of points to the world.

    Args:
        points: boundary points at t = 0.
        part: gives the rigid motion and the friction angle.
        scene: gives the frame and the radii.
        config: gives the search backend (see `graph.neighbors`) and how many radii a grain reaches.
        static: build the search structure once; else at every search (only to measure what that costs).
        nearest: of the points on one plane a grain reaches the nearest only.
    """

    pos: Tensor
    normal: Tensor
    plane: Tensor

    def __init__(
        self, points: BoundaryPoints, part: Part, scene: Scene, config: ModelConfig, *, static: bool, nearest: bool
    ) -> None:
        super().__init__()
        self.dt_s, self.radii_m = scene.frame_dt_s, scene.grains.radii_m
        self.motion, self.friction_angle_rad = part.motion, part.friction_angle_rad
        self.config, self.static, self.nearest = config, static, nearest
        self.register_buffer("pos", torch.as_tensor(points.pos, dtype=torch.float64))
        self.register_buffer("normal", torch.as_tensor(points.normal, dtype=torch.float64))
        if nearest:
            size_m = float(np.ptp(points.pos, axis=0).max()) or 1.0
            _, plane = planes(points.normal, points.pos, size_m)
            self.register_buffer("plane", torch.as_tensor(plane), persistent=False)
        self._index: Index | None = None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "BoundaryPart":
        """Follows the networks to another device, but stays in float64 when they are cast to another dtype."""
        pos, normal = self.pos, self.normal
        super()._apply(fn, recurse)
        self.pos, self.normal, self._index = pos.to(self.pos.device), normal.to(self.pos.device), None
        return self

    def at(self, rows: Int[Tensor, " n"], time_s: Float[Tensor, " n"]) -> Walls:
        """Points `rows` in the world, each at its own time, and how fast they move in the frame from then on."""
        pos, vel = to_world(self.motion, self.pos[rows], time_s)
        normal = self.normal[rows]
        if self.motion.moves:
            vel = (to_world(self.motion, self.pos[rows], time_s + self.dt_s)[0] - pos) / self.dt_s
            normal = turn(self.motion, normal, time_s)
        return Walls(pos, normal, vel, torch.full_like(time_s, self.friction_angle_rad))

    @property
    def cutoff_m(self) -> float:
        """Reach of the largest grain."""
        return self.config.cutoff_wall_radii * max(self.radii_m)

    def body_pos(self, state: State) -> Float[Tensor, "n_grains 3"]:
        """Grains in the part's body frame, m."""
        return to_body(self.motion, state.pos.detach(), state.time_s[state.batch])

    def in_reach(
        self, body_pos: Float[Tensor, "n 3"], radius: Float[Tensor, " n"], edges: Int[Tensor, "2 e"]
    ) -> Bool[Tensor, " e"]:
        """Which [point, grain] are within the grain's own reach."""
        point, grain = edges
        reach = self.config.cutoff_wall_radii * radius[grain]
        return (self.pos[point] - body_pos[grain]).square().sum(1) <= reach.square()

    def within(self, state: State) -> Int[Tensor, "2 e"]:
        """Every [point, grain] at most the grain's reach apart."""
        if self._index is None or not self.static:
            build = backend(self.config.neighbors, self.pos.device).build
            self._index = build(self.pos, torch.zeros(len(self.pos), dtype=torch.long, device=self.pos.device))
        body_pos = self.body_pos(state)
        edges = self._index(body_pos, torch.zeros_like(state.batch), self.cutoff_m)
        if len(self.radii_m) > 1:
            edges = edges[:, self.in_reach(body_pos, state.radius, edges)]
        return edges[:, self.nearest_on_plane(body_pos, edges)] if self.nearest else edges

    def nearest_on_plane(self, body_pos: Float[Tensor, "n 3"], edges: Int[Tensor, "2 e"]) -> Bool[Tensor, " e"]:
        """Which [point, grain] are the nearest of the grain's points on that plane; one for each grain and plane."""
        point, grain = edges
        distance = (self.pos[point] - body_pos[grain]).square().sum(1)
        return least_of_each(grain * len(self.pos) + self.plane[point], distance)


class Boundary(nn.Module):
    """All parts of a scene's boundary.

    Args:
        scene: gives the parts.
        points: their points.
        config: see `BoundaryPart`.
        reachable: only points that a grain reaches are placed in the world; else all of them.
        options: of every part, see `BoundaryPart`.
    """

    def __init__(
        self,
        scene: Scene,
        points: Mapping[str, BoundaryPoints],
        config: ModelConfig,
        *,
        reachable: bool,
        **options: bool,
    ) -> None:
        super().__init__()
        self.parts = nn.ModuleList(
            BoundaryPart(points[name], part, scene, config, **options) for name, part in scene.boundary.items()
        )
        self.reachable = reachable

    def __iter__(self) -> Iterator[BoundaryPart]:
        return iter(cast(Iterable[BoundaryPart], self.parts))

    def contacts(self, state: State) -> tuple[Walls, Int[Tensor, "2 e"]]:
        """Boundary points in the world and [point, grain] for every pair within the grain's reach."""
        found, walls, n_rows = [state.batch.new_empty(2, 0)], [], 0
        for part in self:
            point, grain = part.within(state)
            row = state.batch[grain] * len(part.pos) + point  # graph after graph
            if self.reachable:
                rows, sender = row.unique(return_inverse=True)
            else:
                rows, sender = torch.arange(state.n_graphs * len(part.pos), device=row.device), row
            graph = rows // len(part.pos)
            walls.append(part.at(rows - graph * len(part.pos), state.time_s[graph]))
            found.append(torch.stack([sender + n_rows, grain]))
            n_rows += len(rows)
        none = Walls(*(state.pos.new_empty(shape) for shape in ((0, 3), (0, 3), (0, 3), (0,))))
        return Walls.join([none, *walls]), torch.cat(found, dim=1)
