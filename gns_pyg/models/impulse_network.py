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
        share: how much more each of them is moved than the other (see `Contacts`); all receivers, then all senders.
        contact: what each grain is told by, grain after grain, without what fills up the contacts' number.
        side: the same where what receivers are told is followed by what senders are.
        first: where each grain's begin.
    """

    ends: Int[Tensor, "e sides"]
    stacked: Int[Tensor, "e sides"]
    scalars: Float[Tensor, "e f"]
    basis: Float[Tensor, "3 b e"]
    slow: float
    wall_vel: Float[Tensor, "3 1 e"] | None
    drift: Float[Tensor, "d e"] | None
    share: Float[Tensor, " e_sides"] | None
    contact: Int[Tensor, " m"]
    side: Int[Tensor, " m"]
    first: Int[Tensor, " n"]


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
        motion = torch.cat([grains.vel.flatten(1), grains.spin.flatten(1)], dim=1)
        sign = motion.new_ones(motion.shape[1])
        sign[: 3 * self.channels] = -1  # slip is the sender's velocity less the receiver's, of spins it takes the sum
        moving, latent = torch.cat([motion * sign, motion]), linear(self.from_ends, grains.latent)
        gained, heard, after = torch.zeros_like(motion), torch.zeros_like(grains.latent), []
        for piece, before in zip(contacts, edges, strict=True):
            edge, message, change = self.edge_update(piece, before, latent, moving)
            gained = gained + self.aggregate(change, piece.side, piece.first)
            if self.update_mlp is not None:
                heard = heard + self.aggregate(message.to(heard.dtype), piece.contact, piece.first)
            after.append(edge)
        vel, spin = (part.view(grains.vel.shape) for part in gained.chunk(2, dim=1))
        there = grains.latent
        if self.update_mlp is not None:  # of those that hear: a network that reaches nobody changes nothing
            there = there + only(hears, self.update_mlp, torch.cat([there, heard], dim=1), self.hidden)
        return Grains(there, grains.vel + vel, grains.spin + spin), after

    def aggregate(self, rows: Tensor, named: Tensor, first: Tensor) -> Tensor:  # type: ignore[override]
        """The sum of the rows that are named for each grain, whose begin at `first`; in full precision, and always in
        the same order."""
        return embedding_bag(named, rows, first, mode="sum")

    def edge_update(
        self, contacts: Piece, edge: Tensor, latent: Tensor, moving: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What every contact knows after this round, says to its grains, and gives them: impulse and turn in every
        channel, to all receivers, then to all senders, (sides x n_contacts, 6 channels)."""
        basis, (first, _, last) = contacts.basis, self.impulse_mlp
        rel_vel, spin = gathered(moving, contacts.stacked).t().contiguous().view(2, 3, self.channels, -1)
        if contacts.wall_vel is not None:
            rel_vel = torch.cat([rel_vel[:, :1] + contacts.wall_vel, rel_vel[:, 1:]], dim=1)
        slip = rel_vel - cross(spin, basis[:, :1])  # of the surfaces in touch
        along = (basis[:, :, None] * slip[:, None]).sum(0).flatten(0, 1)
        speed = (slip.square().sum(0) + SOFT).sqrt()
        seen, weight = torch.cat([along, speed]), self.from_seen.weight
        seen = torch.cat([seen, fine(seen, contacts.slow)])
        if self.from_drift is not None and contacts.drift is not None:
            seen, weight = torch.cat([seen, contacts.drift]), torch.cat([weight, self.from_drift.weight], dim=1)
        known = gathered(latent, contacts.ends) + dense(edge, self.from_edge.weight, self.from_seen.bias)
        message = self.message_mlp(torch.addmm(known, seen.t(), weight.t()).relu_())
        edge = edge + message
        factors = torch.addmm(last.bias[:, None], last.weight, linear(first, edge).relu_().t())
        factors = factors.view(basis.shape[1] + 1, self.channels, len(edge))
        against = factors[-1] / (1 + (speed / FASTEST).square()).sqrt()
        impulse = (basis[:, :, None] * factors[:-1]).sum(1) + against * slip
        turn = -SPHERE * cross(impulse, basis[:, :1])
        change = torch.cat([impulse, turn])
        if self.mutual:
            change = torch.cat([change, torch.cat([-impulse, turn])], dim=2)
        if contacts.share is not None:
            change = change * contacts.share
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
    named = contacts.ends.flip(0)[: 1 + mutual].t()
    optional = (contacts.wall_vel, contacts.drift, contacts.share)
    parts = [blocks(rows, hidden) for rows in (named, contacts.scalars, contacts.basis)]
    parts += [[None] * len(parts[0]) if rows is None else blocks(rows, hidden) for rows in optional]
    found = []
    for ends, *values in zip(*parts, strict=True):
        grain, order = ends.t().flatten().sort(stable=True)
        side, contact = order // max(1, len(ends)), order % max(1, len(ends))
        ends, scalars, basis, wall_vel, drift, share = (
            None if rows is None else recurring(rows, ROWS, hidden) for rows in (ends, *values)
        )
        found.append(
            Piece(
                ends=ends,
                stacked=ends + n * torch.arange(ends.shape[1], device=ends.device),
                scalars=scalars,
                basis=basis.permute(1, 2, 0).contiguous(),
                slow=contacts.slow,
                wall_vel=None if wall_vel is None else wall_vel.t()[:, None],
                drift=None if drift is None else drift.t(),
                share=None if share is None else share.flip(1).t().flatten(),
                contact=contact,
                side=contact + side * len(ends),
                first=torch.searchsorted(grain, torch.arange(n, device=grain.device)),
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
