"""Contacts as exchanged impulses: what touching bodies give each other is equal and opposite, and turns with them.

Every round, each contact looks at how its two sides move against each other so far, gives both an impulse along its own
directions, and the next round sees what all impulses together have changed: an iterative contact solver (Jean 1999)
whose law is learned. Three things hold by construction, not by training: the pair's momentum does not change (Newton's
third law), a tangential impulse turns both grains as an impulse at the point of contact does, and what is turned or
mirrored comes out turned or mirrored (vectors enter only as products with each other, as in Schuett et al. 2021).
What a DEM's damping does to that acts along x, y and z: turned from axis to axis only (`Damping`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import embedding_bag
from torch_geometric.nn import MessagePassing

from gns_pyg.models.mlp import ROWS, blocks, dense, linear, mlp, only, recurring
from gns_pyg.state import SOFT, Contacts, fine, reached

VELOCITY, MEAN, GAINED = 0, 1, 2  # channels: end velocity, mean velocity's correction, what gravity adds in a frame
SPHERE = 2.5  # m r^2 / I: what a tangential impulse turns it
FASTEST = 30.0  # of the velocity scale: what answers a slip in proportion stays below; nothing grows without end


@dataclass(frozen=True)
class Grains:
    """What grains carry from round to round.

    Attributes:
        latent: (n_grains, hidden).
        motion: velocity, then radius x angular velocity, dimensionless; of each one vector a channel.
    """

    latent: Float[Tensor, "n hidden"]
    motion: Float[Tensor, "n 2 3 channels"]


Rows = tuple[Tensor, Tensor, Tensor | None]  # which rows are summed, where each sum's begin, each row's weight
Weight = tuple[Tensor, Tensor]  # of each end of each contact: contact after contact, and grain after grain


@dataclass(frozen=True)
class Incidence:
    """Which grains are at which contacts. As a matrix it takes what grains carry to the contacts, and transposed what
    contacts give to the grains; so that either is the other's gradient.

    Attributes:
        ends: the grains of each contact: receiver, between grains then sender.
        begins: where each contact's begin.
        told: the contacts of each grain.
        first: where each grain's begin.
    """

    ends: Int[Tensor, " e_sides"]
    begins: Int[Tensor, " e"]
    told: Int[Tensor, " m"]
    first: Int[Tensor, " n"]

    def to_contacts(self, rows: Float[Tensor, "n f"], weight: Weight | None = None) -> Float[Tensor, "e f"]:
        """The sum of the rows of every contact's grains."""
        here, there = weight or (None, None)
        return Summed.apply(rows, (self.ends, self.begins, here), (self.told, self.first, there))

    def to_grains(self, rows: Float[Tensor, "e f"], weight: Weight | None = None) -> Float[Tensor, "n f"]:
        """The sum of the rows of every grain's contacts, always in the same order."""
        there, here = weight or (None, None)
        return Summed.apply(rows, (self.told, self.first, here), (self.ends, self.begins, there))


class Summed(torch.autograd.Function):
    """Sums of rows, whose gradient is of the same kind."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, named: Rows, back: Rows) -> Tensor:
        ctx.turned = back, named
        index, first, weight = named
        return embedding_bag(index, rows, first, mode="sum", per_sample_weights=weight)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return Summed.apply(gradient.contiguous(), *ctx.turned), None, None


@dataclass(frozen=True)
class Piece:
    """Contacts that are handled at once, in a number that comes again (see `models.mlp`). What has directions has the
    contacts as its last dimension: the same component of all of them lies together in memory.

    Attributes:
        scalars, slow, wall_vel, drift: as of `Contacts`.
        basis: the contacts' directions; first the normal.
        at: the grains that they are between.
        differ: of a receiver -1, of a sender 1.
        pushed, turned: how much of an impulse, and of what it turns, each grain gets (see `Contacts.share`).
    """

    scalars: Float[Tensor, "e f"]
    basis: Float[Tensor, "3 b e"]
    slow: float
    wall_vel: Float[Tensor, "3 1 e"] | None
    drift: Float[Tensor, "d e"] | None
    at: Incidence
    differ: Weight
    pushed: Weight
    turned: Weight


class ImpulseNetwork(nn.Module):
    """All rounds of one kind of contact; networks of several kinds take turns on the same grains (see `exchange`).

    Args:
        n_scalar: scalars of a contact.
        n_basis: its directions.
        mutual: both sides are grains; else one is a wall, which nothing moves.
        hidden, layers, mlp_layers: width, rounds, linear layers of each MLP.
        channels: vectors that a grain carries, at least three.
        memory: rounds look at the contacts' drift too.
    """

    def __init__(
        self,
        *,
        n_scalar: int,
        n_basis: int,
        mutual: bool,
        hidden: int,
        layers: int,
        mlp_layers: int,
        channels: int,
        memory: bool = False,
    ) -> None:
        super().__init__()
        self.hidden, self.mutual = hidden, mutual
        self.encode = mlp(n_scalar, hidden, hidden, mlp_layers, layer_norm=True)
        self.rounds = nn.ModuleList(
            ImpulseRound(hidden, mlp_layers, channels, n_basis, last=turn == layers - 1, memory=memory)
            for turn in range(layers)
        )

    def hears(self, n: int, contacts: Contacts) -> Bool[Tensor, " n"]:
        """Which of `n` grains have a contact of this kind."""
        return reached(n, *contacts.ends[0 if self.mutual else 1 :])

    def forward(
        self,
        turn: int,
        grains: Grains,
        contacts: Sequence[Piece],
        edges: Sequence[Tensor] | None,
        hears: Bool[Tensor, " n"],
    ) -> tuple[Grains, list[Tensor]]:
        """One round: what grains carry after it, and the contacts' latents.

        Args:
            turn: number of the round.
            grains: before it.
            contacts: of this kind.
            edges: their latents after the round before, None in the first.
            hears: grains that have a contact of this kind.
        """
        if edges is None:
            edges = [self.encode(piece.scalars) for piece in contacts]
        return self.rounds[turn](grains, contacts, edges, hears)


class ImpulseRound(MessagePassing):
    """One round: every contact exchanges messages and impulses, then the grains' latents follow.

    Args:
        hidden, mlp_layers, channels, n_basis, memory: see `ImpulseNetwork`.
        last: no later round would read the grains' latents.
    """

    def __init__(self, hidden: int, mlp_layers: int, channels: int, n_basis: int, *, last: bool, memory: bool) -> None:
        super().__init__(aggr="sum", flow="source_to_target")
        self.hidden, self.channels = hidden, channels
        n_given = channels * (n_basis + 1)
        self.from_seen = nn.Linear(2 * n_given, hidden)
        self.from_ends = nn.Linear(hidden, hidden, bias=False)  # a pair looks the same from either side
        self.from_edge = nn.Linear(hidden, hidden, bias=False)
        for part in (self.from_seen, self.from_ends, self.from_edge):
            nn.init.uniform_(part.weight, -((3 * hidden) ** -0.5), (3 * hidden) ** -0.5)  # as one layer of 3 x hidden
        self.from_drift: nn.Linear | None = None
        if memory:
            self.from_drift = nn.Linear(2 * (n_basis + 1), hidden, bias=False)
            nn.init.zeros_(self.from_drift.weight)  # begin without
        self.message_mlp = mlp(hidden, hidden, hidden, mlp_layers - 1, layer_norm=True)
        self.impulse_mlp = mlp(hidden, hidden, n_given, 2)
        with torch.no_grad():  # begin near free flight
            for parameter in self.impulse_mlp[-1].parameters():
                parameter.mul_(0.1)
        self.update_mlp = None if last else mlp(2 * hidden, hidden, hidden, mlp_layers, layer_norm=True)

    def forward(
        self, grains: Grains, contacts: Sequence[Piece], edges: Sequence[Tensor], hears: Bool[Tensor, " n"]
    ) -> tuple[Grains, list[Tensor]]:
        motion, heard, after = grains.motion, [], []
        vel, spin = (part.flatten(1) for part in grains.motion.unbind(1))
        latent = linear(self.from_ends, grains.latent)
        for piece, before in zip(contacts, edges, strict=True):
            edge, message, impulse, turn = self.edge_update(piece, before, latent, vel, spin)
            given = (self.aggregate(impulse, piece.at, piece.pushed), self.aggregate(turn, piece.at, piece.turned))
            motion = motion + torch.stack(given, dim=1).view(motion.shape)
            if self.update_mlp is not None:
                heard.append(self.aggregate(message.to(motion.dtype), piece.at))
            after.append(edge)
        there = grains.latent
        if self.update_mlp is not None:  # of those that hear: a network that reaches nobody changes nothing
            told = torch.cat([there, sum(heard[1:], heard[0])], dim=1)
            there = there + only(hears, self.update_mlp, told, self.hidden)
        return Grains(there, motion), after

    def aggregate(self, inputs: Tensor, at: Incidence, weight: Any = None) -> Tensor:  # type: ignore[override]
        """What every grain gets from its contacts, in full precision."""
        return at.to_grains(inputs, weight)

    def edge_update(
        self, contacts: Piece, edge: Tensor, latent: Tensor, vel: Tensor, spin: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What every contact knows after this round, says to its grains, and gives the receiver in every channel:
        impulse and turn, (n_contacts, 3 channels)."""
        basis, at = contacts.basis, contacts.at
        rel_vel, turning = (
            at.to_contacts(rows, weight).t().contiguous().view(3, self.channels, -1)
            for rows, weight in ((vel, contacts.differ), (spin, None))
        )
        if contacts.wall_vel is not None:
            rel_vel = torch.cat([rel_vel[:, :1] + contacts.wall_vel, rel_vel[:, 1:]], dim=1)
        slip = rel_vel - cross(turning, basis[:, :1])  # of the surfaces in touch
        along = dot(basis[:, :, None], slip[:, None]).flatten(0, 1)
        speed = (dot(slip, slip) + SOFT).sqrt()
        seen, weight = torch.cat([along, speed]), self.from_seen.weight
        seen = torch.cat([seen, fine(seen, contacts.slow)])
        if self.from_drift is not None and contacts.drift is not None:
            seen, weight = torch.cat([seen, contacts.drift]), torch.cat([weight, self.from_drift.weight], dim=1)
        known = at.to_contacts(latent) + dense(edge, self.from_edge.weight, self.from_seen.bias)
        message = self.message_mlp(torch.addmm(known, seen.t(), weight.t()).relu_())
        edge = edge + message
        first, last = (layer for layer in self.impulse_mlp if isinstance(layer, nn.Linear))
        factors = torch.addmm(last.bias[:, None], last.weight, linear(first, edge).relu_().t())
        factors = factors.view(basis.shape[1] + 1, self.channels, len(edge))
        against = factors[-1] / (1 + (speed / FASTEST).square()).sqrt()
        impulse = against * slip
        for direction, factor in zip(basis.unbind(1), factors, strict=False):
            impulse = torch.addcmul(impulse, direction[:, None], factor)
        turn = cross(impulse, -SPHERE * basis[:, :1])
        return edge, message, *(change.flatten(0, 1).t().contiguous() for change in (impulse, turn))


class Damping(nn.Module):
    """What a DEM's damping leaves of that. Cundall's takes from every force that speeds a grain up and adds to those
    that slow it down, along x, y and z one by one, which no two grains give each other. How much in a frame is learned,
    as shares of what is known: forces come and go within a frame.

    Args:
        hidden, channels: see `ImpulseNetwork`.
    """

    BORNE, SLOWED = slice(0, 2), slice(2, 5)  # shares of: gravity's damping given back; mean, end velocity, spin lost
    FELT = slice(5, 8)  # times what Cundall's law adds if what contacts give is one steady force: mean, end, spin

    def __init__(self, hidden: int, channels: int) -> None:
        super().__init__()
        self.shares = mlp(hidden + 6 * channels, hidden, 8, 2)
        with torch.no_grad():  # begin with a steady force's, and little else
            final = list(self.shares[-1].parameters())[-1]
            final[: self.FELT.start].fill_(-3.0)
            final[self.FELT].fill_(math.atanh(0.5))

    def forward(self, before: Grains, after: Grains, slow: float) -> Float[Tensor, "n 8"]:
        """Shares between 0 and 1, and times between -2 and 2."""
        moved = torch.stack([before.motion, after.motion, after.motion - before.motion], dim=2)
        x, y, z = moved.square().unbind(3)
        lengths = (x + y + z + SOFT * slow).sqrt().flatten(1)
        shares = self.shares(torch.cat([after.latent, fine(lengths, slow)], dim=1))
        return torch.cat([shares[:, : self.FELT.start].sigmoid(), 2 * shares[:, self.FELT].tanh()], dim=1)


def pieces(contacts: Contacts, hidden: int, n: int, *, mutual: bool) -> list[Piece]:
    """Contacts between `n` grains as pieces that are best handled one after the other."""

    def filled(rows: Tensor, k: int) -> Tensor:
        return recurring(blocks(rows, hidden)[k], ROWS, hidden)

    found, named = [], contacts.ends.flip(0)[: 1 + mutual].t()
    for k, these in enumerate(blocks(named, hidden)):
        ends, sides = filled(named, k), torch.arange(1 + mutual, device=named.device)
        grain, order = these.flatten().sort(stable=True)
        first = torch.searchsorted(grain, torch.arange(n, device=named.device))
        begins = len(sides) * torch.arange(len(ends), device=named.device)
        differ = (2 * sides - 1).to(contacts.scalars.dtype).expand(ends.shape)
        pushed, turned = -differ, torch.ones_like(differ)
        if contacts.share is not None:
            turned = filled(contacts.share, k).flip(1)
            pushed = pushed * turned
        weights = [(each.flatten(), each.flatten()[order]) for each in (differ, pushed, turned)]
        found.append(
            Piece(
                scalars=filled(contacts.scalars, k),
                basis=filled(contacts.basis, k).permute(1, 2, 0).contiguous(),
                slow=contacts.slow,
                wall_vel=None if contacts.wall_vel is None else filled(contacts.wall_vel, k).t()[:, None],
                drift=None if contacts.drift is None else filled(contacts.drift, k).t(),
                at=Incidence(ends.flatten(), begins, order // len(sides), first),
                differ=weights[0],
                pushed=weights[1],
                turned=weights[2],
            )
        )
    return found


def cross(a: Float[Tensor, "3 channels e"], b: Float[Tensor, "3 1 e"]) -> Float[Tensor, "3 channels e"]:
    """a x b; torch.linalg.cross takes several times as long on a CPU."""
    (x, y, z), (u, v, w) = a, b
    return torch.stack([y * w - z * v, z * u - x * w, x * v - y * u])


def dot(a: Float[Tensor, "3 *d e"], b: Float[Tensor, "3 *k e"]) -> Float[Tensor, "*m e"]:
    """Scalar products of components that lie apart."""
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def exchange(grains: Grains, kinds: Sequence[tuple[ImpulseNetwork, Contacts]]) -> Grains:
    """What grains carry after all rounds, in which the kinds of contact take turns."""
    n = len(grains.latent)
    lots = [pieces(contacts, network.hidden, n, mutual=network.mutual) for network, contacts in kinds]
    hears = [network.hears(n, contacts) for network, contacts in kinds]
    edges: list[list[Tensor] | None] = [None] * len(kinds)
    for turn in range(len(kinds[0][0].rounds)):
        for kind, (network, _) in enumerate(kinds):
            grains, edges[kind] = network(turn, grains, lots[kind], edges[kind], hears[kind])
    return grains
