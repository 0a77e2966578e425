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

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import embedding_bag
from torch_geometric.nn import MessagePassing

from gns_pyg.models.mlp import ROWS, blocks, linear, mlp, only, recurring
from gns_pyg.state import SOFT, Contacts, fine, reached

VELOCITY, MEAN, GAINED = 0, 1, 2  # channels: end velocity, mean velocity's correction, what gravity adds in a frame
SPHERE = 2.5  # m r^2 / I: what a tangential impulse turns it
FASTEST = 30.0  # of the velocity scale: what answers a slip in proportion stays below; nothing grows without end


@dataclass(frozen=True)
class Grains:
    """What grains carry from round to round.

    Attributes:
        latent: (n_grains, hidden).
        vel: velocities, dimensionless, one vector a channel, (n_grains, 3, channels).
        spin: radius x angular velocity, likewise.
    """

    latent: Float[Tensor, "n hidden"]
    vel: Float[Tensor, "n 3 channels"]
    spin: Float[Tensor, "n 3 channels"]


@dataclass(frozen=True)
class Piece:
    """Contacts that are handled at once, in a number that comes again (see `models.mlp`). What has directions has the
    contacts as its last dimension: the same component of all of them lies together in memory.

    Attributes:
        scalars, slow, wall_vel, drift: as of `Contacts`.
        ends: their grains: receiver, between grains then sender.
        stacked: the same where what receivers show is followed by what senders do.
        basis: the contacts' directions; first the normal.
        told: `ends` without what fills up their number, side by side.
        share: how much more each of them is moved than the other (see `Contacts`).
    """

    ends: Int[Tensor, "e sides"]
    stacked: Int[Tensor, "e sides"]
    scalars: Float[Tensor, "e f"]
    basis: Float[Tensor, "3 b e"]
    slow: float
    wall_vel: Float[Tensor, "e 3"] | None
    drift: Float[Tensor, "e d"] | None
    told: tuple[Int[Tensor, " m"], ...]
    share: tuple[Float[Tensor, "m 1"], ...] | None


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
            ImpulseRound(hidden, mlp_layers, channels, n_basis, mutual=mutual, last=turn == layers - 1, memory=memory)
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
        hidden, mlp_layers, channels, n_basis, mutual, memory: see `ImpulseNetwork`.
        last: no later round would read the grains' latents.
    """

    def __init__(
        self, hidden: int, mlp_layers: int, channels: int, n_basis: int, *, mutual: bool, last: bool, memory: bool
    ) -> None:
        super().__init__(aggr="sum", flow="source_to_target")
        self.hidden, self.channels, self.mutual = hidden, channels, mutual
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
        n, heard, third = len(grains.latent), 0 if self.update_mlp is None else self.hidden, 3 * self.channels
        motion = torch.cat([grains.vel.flatten(1), grains.spin.flatten(1)], dim=1)
        sign = motion.new_ones(heard + 2 * third)
        sign[heard : heard + third] = -1  # the sender's impulse; what it hears and how it turns are the receiver's
        latent, after = linear(self.from_ends, grains.latent), []
        moving = torch.cat([motion * sign[heard:], motion])
        gained = motion.new_zeros(n, len(sign))
        for piece, before in zip(contacts, edges, strict=True):
            edge, message, change = self.edge_update(piece, before, latent, moving)
            rows = torch.cat([message[:, :heard], change], dim=1).to(motion.dtype)[: len(piece.told[0])]
            for side, named in enumerate(piece.told):
                given = rows
                if piece.share is not None:
                    given = torch.cat([rows[:, :heard], rows[:, heard:] * piece.share[side]], dim=1)
                told = self.aggregate(given, named, dim_size=n)  # sums stay in full precision
                gained = gained + told * sign if side else gained + told
            after.append(edge)
        vel, spin = (part.view(grains.vel.shape) for part in gained[:, heard:].chunk(2, dim=1))
        there = grains.latent
        if self.update_mlp is not None:  # of those that hear: a network that reaches nobody changes nothing
            there = there + only(hears, self.update_mlp, torch.cat([there, gained[:, :heard]], dim=1), self.hidden)
        return Grains(there, grains.vel + vel, grains.spin + spin), after

    def edge_update(
        self, contacts: Piece, edge: Tensor, latent: Tensor, moving: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What every contact knows after this round, says to its grains, and gives the receiver: impulse and turn in
        every channel, (n_contacts, 6 channels)."""
        hidden, basis = gathered(latent, contacts.ends), contacts.basis
        rel_vel, spin = gathered(moving, contacts.stacked).t().contiguous().view(2, 3, self.channels, -1)
        if contacts.wall_vel is not None:
            rel_vel = torch.cat([rel_vel[:, :1] + contacts.wall_vel.t()[:, None], rel_vel[:, 1:]], dim=1)
        slip = rel_vel - cross(spin, basis[:, :1])  # of the surfaces in touch
        along = (basis[:, :, None] * slip[:, None]).sum(0).flatten(0, 1)
        speed = (slip.square().sum(0) + SOFT).sqrt()
        seen = torch.cat([along, speed])
        seen = torch.cat([seen, fine(seen, contacts.slow)]).t().contiguous()
        known = hidden + linear(self.from_edge, edge) + linear(self.from_seen, seen)
        if self.from_drift is not None and contacts.drift is not None:
            known = known + linear(self.from_drift, contacts.drift)
        message = self.message_mlp(known.relu_())
        edge = edge + message
        factors = self.impulse_mlp(edge).t().contiguous().view(basis.shape[1] + 1, self.channels, len(edge))
        against = factors[-1] / (1 + (speed / FASTEST).square()).sqrt()
        impulse = (basis[:, :, None] * factors[:-1]).sum(1) + against * slip
        change = torch.cat([impulse, -SPHERE * cross(impulse, basis[:, :1])])
        return edge, message, change.flatten(0, 1).t().contiguous()


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
        lengths = []
        for old, new in ((before.vel, after.vel), (before.spin, after.spin)):
            lengths += [(x.square().sum(1) + SOFT * slow).sqrt() for x in (old, new, new - old)]
        shares = self.shares(torch.cat([after.latent, fine(torch.cat(lengths, dim=1), slow)], dim=1))
        return torch.cat([shares[:, : self.FELT.start].sigmoid(), 2 * shares[:, self.FELT].tanh()], dim=1)


def pieces(contacts: Contacts, hidden: int, n: int, *, mutual: bool) -> list[Piece]:
    """Contacts between `n` grains as pieces that are best handled one after the other."""
    sides = contacts.ends.flip(0)[: 1 + mutual]
    always = [blocks(side, hidden) for side in (sides.T, contacts.scalars, contacts.basis)]
    none = [None] * len(always[0])
    perhaps = [
        none if side is None else blocks(side, hidden) for side in (contacts.wall_vel, contacts.drift, contacts.share)
    ]
    found = []
    for ends, scalars, basis, wall_vel, drift, share in zip(*always, *perhaps, strict=True):
        more = recurring(ends, ROWS, hidden)
        found.append(
            Piece(
                ends=more,
                stacked=torch.stack([side + k * n for k, side in enumerate(more.unbind(1))], dim=1),
                scalars=recurring(scalars, ROWS, hidden),
                basis=recurring(basis, ROWS, hidden).permute(1, 2, 0).contiguous(),
                slow=contacts.slow,
                wall_vel=None if wall_vel is None else recurring(wall_vel, ROWS, hidden),
                drift=None if drift is None else recurring(drift, ROWS, hidden),
                told=ends.unbind(1),
                share=None if share is None else share.flip(1).split(1, dim=1),
            )
        )
    return found


def gathered(table: Float[Tensor, "m f"], rows: Int[Tensor, "e sides"]) -> Float[Tensor, "e f"]:
    """The sum of every contact's rows of a table."""
    if not torch.is_grad_enabled():
        return embedding_bag(rows, table, mode="sum")
    first, *others = (table.index_select(0, side) for side in rows.unbind(1))
    return sum(others, first)


def cross(a: Float[Tensor, "3 channels e"], b: Float[Tensor, "3 1 e"]) -> Float[Tensor, "3 channels e"]:
    """a x b; torch.linalg.cross takes several times as long on a CPU."""
    (x, y, z), (u, v, w) = a, b
    return torch.stack([y * w - z * v, z * u - x * w, x * v - y * u])


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
