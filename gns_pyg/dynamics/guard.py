"""No grain passes a wall, however fast it is or however wrong a network: who would, is stopped at the wall.

The way of a grain's centre over a step is a straight line in the body frame of every boundary part, where its mesh
stands still. A line from the grains' side of a triangle to the other is ended where it meets the triangle.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gns_pyg.scene.mesh import build_mesh, planes
from gns_pyg.scene.motion import to_body, to_world, turn
from gns_pyg.scene.scene import Part, Scene
from gns_pyg.state import State, least_of_each

ROUNDS = 3  # walls that a grain may meet in one step, one after the other; then it stays where it was
LEAST = 0.01  # of a radius: a stopped grain's centre is this high over the wall at least
EDGE = 1e-9  # of a triangle: its edges are a little wide, so that no line slips between two
BLOCK = 2**16  # grains whose sides of all planes are looked at at once


@dataclass
class Crossing:
    """A grain that was stopped: at which time of its roll-out, s, which grain, how fast it went, m/s, at which part."""

    time_s: float
    grain: int
    speed_m_s: float
    part: str


class Guard(nn.Module):
    """Stops grains at the boundary.

    Args:
        scene: gives the parts, their meshes and motion.

    Attributes:
        crossings: how many times a grain was stopped, since the last `reset`.
        first: the first of them.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.parts = nn.ModuleList(PartGuard(name, part) for name, part in scene.boundary.items())
        self.reset()

    def reset(self) -> None:
        """Begins to count anew."""
        self.crossings = 0
        self.first: Crossing | None = None

    def forward(self, before: State, after: State) -> State:
        """`after`, with everyone who went through a wall on the way from `before` at that wall; its velocity into the
        wall is the wall's own. Parts are looked at one after the other."""
        for part in self.parts:
            grain, pos, vel = part(before, after)
            if len(grain):
                self._note(str(part.name), grain, before, after)
                after = replace(after, pos=after.pos.index_put((grain,), pos), vel=after.vel.index_put((grain,), vel))
        return after

    def _note(self, part: str, grain: Tensor, before: State, after: State) -> None:
        self.crossings += len(grain)
        if self.first is None:
            one = int(grain[0])
            graph, way = int(before.batch[one]), torch.linalg.vector_norm((after.pos[one] - before.pos[one]).detach())
            took_s = after.time_s[graph] - before.time_s[graph]
            self.first = Crossing(float(before.time_s[graph]), one, float(way / took_s), part)


class PartGuard(nn.Module):
    """One rigid part: its triangles in the body frame, sorted by plane; coplanar ones are one plane.

    Args:
        name: the part's key under scene.boundary.
        part: its shape and motion.
    """

    normal: Tensor
    offset: Tensor
    first: Tensor
    corners: Tensor

    def __init__(self, name: str, part: Part) -> None:
        super().__init__()
        self.name, self.motion = name, part.motion
        mesh = build_mesh(name, part)
        triangles = np.asarray(mesh.triangles)
        across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        size, twice_area = float(np.ptp(mesh.vertices, axis=0).max()), np.linalg.norm(across, axis=1)
        thick = twice_area > (EDGE * size) ** 2  # one without an area stops nobody
        triangles, normal = triangles[thick], across[thick] / twice_area[thick, None]
        self.tolerance_m = EDGE * size
        inwards = -normal if mesh.is_watertight else normal
        offset = (inwards * triangles[:, 0]).sum(axis=1)
        index, plane = planes(inwards, triangles[:, 0], size)
        order = np.argsort(plane, kind="stable")
        held = {
            "normal": inwards[index],
            "offset": offset[index],
            "corners": triangles[order],
            "first": np.searchsorted(plane[order], np.arange(len(index) + 1)),
        }
        for key, values in held.items():
            self.register_buffer(key, torch.as_tensor(np.array(values)), persistent=False)

    def _apply(self, fn, recurse: bool = True) -> "PartGuard":
        """Follows the networks to another device, but stays in float64."""
        where = fn(self.normal).device
        for key, values in self._buffers.items():
            self._buffers[key] = None if values is None else values.to(where)
        return self

    def forward(
        self, before: State, after: State
    ) -> tuple[Int[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Who is stopped at this part; where, m, and with what velocity, m/s, in the world."""
        time_s = after.time_s[after.batch]
        start = to_body(self.motion, before.pos, before.time_s[before.batch])
        end = to_body(self.motion, after.pos, time_s)
        found = self._met(start.detach(), end.detach())
        if before.active is not None and after.active is not None:
            found = found[(before.active & after.active)[found]]
        if not len(found):
            return found, start[:0], start[:0]
        start, end, time_s, radius = start[found], end[found], time_s[found], before.radius[found]
        normal = torch.zeros_like(start)
        for _ in range(ROUNDS):
            grain, plane = self._first_met(start.detach(), end.detach())
            along = self.normal[plane]
            height = self._height(start[grain], plane).clamp(min=0)
            drop = (height - self._height(end[grain], plane)).clamp(min=self.tolerance_m)
            meets = start[grain] + (height / drop).clamp(max=1)[:, None] * (end[grain] - start[grain])
            lift = torch.minimum(torch.maximum(height, LEAST * radius[grain]), radius[grain])
            end = end.index_put((grain,), meets + lift[:, None] * along)
            normal = normal.index_put((grain,), along)
        stuck = torch.zeros(len(start), dtype=torch.bool, device=start.device)
        stuck[self._met(start.detach(), end.detach())] = True
        end = torch.where(stuck[:, None], start, end)
        pos, wall_vel = to_world(self.motion, end, time_s)
        normal = turn(self.motion, normal, time_s)
        into = ((after.vel[found] - wall_vel) * normal).sum(1, keepdim=True).clamp(max=0)
        return found, pos, torch.where(stuck[:, None], wall_vel, after.vel[found] - into * normal)

    def _height(self, pos: Float[Tensor, "n 3"], plane: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Height of points over their planes, on the grains' side, m."""
        return (pos * self.normal[plane]).sum(1) - self.offset[plane]

    def _met(self, start: Float[Tensor, "n 3"], end: Float[Tensor, "n 3"]) -> Int[Tensor, " n_met"]:
        """Lines that meet some triangle, by number."""
        grains = []
        for first in range(0, len(start), BLOCK):
            block = slice(first, first + BLOCK)
            grain, _, _ = self._meetings(start[block], end[block])
            grains.append(grain.unique() + first)
        return torch.cat([start.new_empty(0, dtype=torch.long), *grains])

    def _first_met(
        self, start: Float[Tensor, "n 3"], end: Float[Tensor, "n 3"]
    ) -> tuple[Int[Tensor, " n_met"], Int[Tensor, " n_met"]]:
        """Lines that meet some triangle, and the plane of the first that each meets."""
        grain, plane, part_of_way = self._meetings(start, end)
        first = least_of_each(grain, part_of_way)
        return grain[first], plane[first]

    def _meetings(
        self, start: Float[Tensor, "n 3"], end: Float[Tensor, "n 3"]
    ) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"], Float[Tensor, " m"]]:
        """Every meeting of a line with a triangle: line, plane, and after which part of the line."""
        above, way = torch.mm(start, self.normal.T).sub_(self.offset), torch.linalg.vector_norm(end - start, dim=1)
        near = (above >= -self.tolerance_m) & (above <= (way + 2 * self.tolerance_m)[:, None])
        line, plane = near.nonzero().unbind(1)
        above, below = above[line, plane], self._height(end[line], plane)
        passes = (below < self.tolerance_m) & (below < above)
        line, plane, height, depth = line[passes], plane[passes], above[passes].clamp(min=0), below[passes]
        part_of_way = (height / (height - depth).clamp(min=self.tolerance_m)).clamp(max=1)
        meets = start[line] + part_of_way[:, None] * (end[line] - start[line])
        n_triangles = self.first[plane + 1] - self.first[plane]
        row = torch.repeat_interleave(n_triangles)
        place = torch.arange(len(row), device=row.device) - (n_triangles.cumsum(0) - n_triangles)[row]
        hit = row[_within(meets[row], self.corners[self.first[plane[row]] + place])].unique()
        return line[hit], plane[hit], part_of_way[hit]


def _within(pos: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]) -> Tensor:
    """Which points lie in their triangles, bool (n,); the points lie in the triangles' planes."""
    edges = corners.roll(-1, 1) - corners
    normal = torch.linalg.cross(edges[:, 0], edges[:, 1])
    sides = (torch.linalg.cross(edges, pos[:, None] - corners) * normal[:, None]).sum(2)
    return (sides >= -EDGE * (normal**2).sum(1)[:, None]).all(1)
