"""The records that every room passes on. Shapes and units are said here, once.

Conventions: SI units. Edges: `edges[0]` sends, `edges[1]` receives; `rel_pos = pos[sender] - pos[receiver]`.
Several graphs are batched by concatenating their grains; `batch` says which graph a grain belongs to.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

AnyRecord = TypeVar("AnyRecord", bound="Record")
SOFT = 1e-6  # under the root of a squared length, so that its gradient stays finite


def constant(values: Sequence[float | int], like: Tensor) -> Tensor:
    """`values` with the dtype and on the device of `like`, (len(values),); nothing is copied from the host, so a CUDA
    graph can hold it."""
    return torch.stack([like.new_full((), value) for value in values])


def fine(values: Tensor, unit: Tensor | float) -> Tensor:
    """On a scale that is linear up to `unit` and logarithmic beyond."""
    return Asinh.apply(values / unit) / 4


class Asinh(torch.autograd.Function):
    """The inverse hyperbolic sine, in half of the time of torch's own on a CPU; beyond 1e19, where a square overflows
    in float32, log(2) too small."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        size, root = x.abs(), (x * x).add_(1).sqrt_().add_(1)
        return torch.div(size, root, out=root).mul_(size).add_(size).log1p_().copysign_(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return gradient / (x * x + 1).sqrt()


def reached(n: int, *rows: Int[Tensor, " _"]) -> Bool[Tensor, " n"]:
    """Which of `n` grains are named in `rows`."""
    found = torch.zeros(n, dtype=torch.bool, device=rows[0].device)
    for named in rows:
        found = found.index_fill(0, named, True)
    return found


def least_of_each(group: Int[Tensor, " n"], value: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Which entries have the least value of their group; of equal ones the first."""
    order = value.argsort(stable=True)
    sorted_group, then = group[order].sort(stable=True)
    first = torch.ones_like(sorted_group, dtype=torch.bool)
    first[1:] = sorted_group[1:] != sorted_group[:-1]
    return torch.empty_like(first).index_put((order[then],), first)


class Record:
    """A frozen dataclass of tensors that can move between devices."""

    def to(self: AnyRecord, device: torch.device | str, non_blocking: bool = False) -> AnyRecord:
        """Returns a copy with every tensor on `device`; dtypes stay."""
        moved = {
            f.name: value.to(device, non_blocking=non_blocking)
            for f in fields(self)  # type: ignore[arg-type]
            if isinstance(value := getattr(self, f.name), Tensor | Record)
        }
        return replace(self, **moved)  # type: ignore[type-var]


@dataclass(frozen=True)
class State(Record):
    """Grains of one or more graphs at one instant.

    Attributes:
        pos: grain centres, m, float64.
        vel: grain velocity, m/s, float64. Instantaneous, or the backward difference (pos(t) - pos(t - dt)) / dt
            where the model's state is `differences`.
        ang_vel: angular velocity, rad/s, float64, or None where the model's state does not hold it.
        radius: grain radius, m, float64.
        time_s: time of each graph, s; walls move with it.
        batch: graph of each grain, sorted.
        parameters: what may vary from case to case, in the order of `scene.PARAMETERS`, SI; None where nothing does.
        active: whether a grain is in the scene, or None where grains neither leave nor enter.
        drift: mean velocity over the last frames, m/s, float64 (see `dynamics.memory`), or None where the model's state
            does not hold it.
    """

    pos: Float[Tensor, "n_grains 3"]
    vel: Float[Tensor, "n_grains 3"]
    ang_vel: Float[Tensor, "n_grains 3"] | None
    radius: Float[Tensor, " n_grains"]
    time_s: Float[Tensor, " n_graphs"]
    batch: Int[Tensor, " n_grains"]
    parameters: Float[Tensor, "n_graphs n_parameters"] | None = None
    active: Bool[Tensor, " n_grains"] | None = None
    drift: Float[Tensor, "n_grains 3"] | None = None

    @property
    def n_graphs(self) -> int:
        return self.time_s.shape[0]

    def pick(self, grains: Bool[Tensor, " n_grains"] | Int[Tensor, " n_picked"]) -> "State":
        """The state of some of the grains, by mask or by ascending number; graphs stay."""
        return replace(
            self,
            pos=self.pos[grains],
            vel=self.vel[grains],
            ang_vel=None if self.ang_vel is None else self.ang_vel[grains],
            radius=self.radius[grains],
            batch=self.batch[grains],
            active=None if self.active is None else self.active[grains],
            drift=None if self.drift is None else self.drift[grains],
        )


@dataclass(frozen=True)
class Window(Record):
    """Consecutive raw frames of one or more cases; what the data set yields and a batch holds.

    Attributes:
        pos: grain centres, m, float64.
        vel: instantaneous velocity, m/s, float64.
        ang_vel: angular velocity, rad/s, float64.
        radius: grain radius, m, float64.
        time_s: time of frame 0 of each graph, s.
        batch: graph of each grain, sorted.
        parameters: of each graph, in the order of `scene.PARAMETERS`, SI.
        active: whether a grain is in the scene, or None where grains neither leave nor enter.
    """

    pos: Float[Tensor, "n_frames n_grains 3"]
    vel: Float[Tensor, "n_frames n_grains 3"]
    ang_vel: Float[Tensor, "n_frames n_grains 3"]
    radius: Float[Tensor, " n_grains"]
    time_s: Float[Tensor, " n_graphs"]
    batch: Int[Tensor, " n_grains"]
    parameters: Float[Tensor, "n_graphs n_parameters"]
    active: Bool[Tensor, "n_frames n_grains"] | None = None

    @staticmethod
    def collate(windows: "list[Window]") -> "Window":
        """Joins single-graph windows of equal length into one batch."""
        sizes = torch.tensor([w.radius.shape[0] for w in windows])
        active = [w.active for w in windows if w.active is not None]
        return Window(
            pos=torch.cat([w.pos for w in windows], 1),
            vel=torch.cat([w.vel for w in windows], 1),
            ang_vel=torch.cat([w.ang_vel for w in windows], 1),
            radius=torch.cat([w.radius for w in windows]),
            time_s=torch.cat([w.time_s for w in windows]),
            batch=torch.repeat_interleave(torch.arange(len(windows)), sizes),
            parameters=torch.cat([w.parameters for w in windows]),
            active=torch.cat(active, 1) if active else None,
        )


@dataclass(frozen=True)
class Walls(Record):
    """Boundary points of one or more graphs at their times, in the world.

    Attributes:
        pos: boundary points, m, float64.
        normal: unit normals that point to the grains' side.
        vel: mean velocity of the point over the coming frame, m/s; where a wall will be is known.
        friction_angle: of the wall at the point, rad.
    """

    pos: Float[Tensor, "n_points 3"]
    normal: Float[Tensor, "n_points 3"]
    vel: Float[Tensor, "n_points 3"]
    friction_angle: Float[Tensor, " n_points"]

    @staticmethod
    def join(walls: "list[Walls]") -> "Walls":
        """All points, part after part."""
        return Walls(*(torch.cat([getattr(part, f.name) for part in walls]) for f in fields(Walls)))


@dataclass(frozen=True)
class Graph(Record):
    """Who can touch whom.

    Attributes:
        grain_edges: [sender grain, receiver grain]; both directions of every pair, or one (see `Simulator.pairs_once`).
        wall_edges: [boundary point (row of `walls`), receiver grain]; walls only send.
        walls: the boundary points, or None where the scene has no boundary.
    """

    grain_edges: Int[Tensor, "2 n_grain_edges"]
    wall_edges: Int[Tensor, "2 n_wall_edges"]
    walls: Walls | None = None


@dataclass(frozen=True)
class Contacts:
    """Contacts of one kind; of a pair of grains one of the two directions.

    Attributes:
        ends: [sender, receiver]; of a boundary point only the receiver is a row of `Grains`.
        scalars: what stays when everything is turned, (n_contacts, n_scalars).
        basis: the contact's directions, columns; first the unit normal, from the receiver to the other side.
        slow: dimensionless velocity below which the networks need a finer scale.
        wall_vel: dimensionless velocity of the boundary point; None between grains and where walls stand.
        drift: how both sides move against each other over the last frames, where the model's state holds that: along
            every direction and at all, (n_contacts, 2 (b + 1)), dimensionless and on a finer scale.
        share: how much more than its partner sender and receiver are moved by the same impulse: 2 m' / (m + m') with m'
            the partner's mass; None where all masses are equal.
    """

    ends: Int[Tensor, "2 e"]
    scalars: Float[Tensor, "e f"]
    basis: Float[Tensor, "e 3 b"]
    slow: float
    wall_vel: Float[Tensor, "e 3"] | None = None
    drift: Float[Tensor, "e d"] | None = None
    share: Float[Tensor, "e 2"] | None = None
