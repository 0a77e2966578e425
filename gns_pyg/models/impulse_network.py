"""Contacts as exchanged impulses: what touching bodies give each other is equal and opposite, and turns with them.

Every round, each contact looks at how its two sides move against each other so far, gives both an impulse along its own
directions, and the next round sees what all impulses together have changed: an iterative contact solver (Jean 1999)
whose law is learned. Three things hold by construction, not by training: the pair's momentum does not change (Newton's
third law), a tangential impulse turns both grains as an impulse at the point of contact does, and what is turned or
mirrored comes out turned or mirrored (vectors enter only as products with each other, as in Schuett et al. 2021).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing

from gns_pyg.models.mlp import blocks, linear, mlp, recurring
from gns_pyg.state import Contacts, fine, reached

ROWS = 128  # of which contacts come in multiples, as in `contact_network`
VELOCITY, MEAN, GAINED = 0, 1, 2  # channels: end velocity, mean velocity's correction, what gravity adds in a frame
SPHERE = 2.5  # m r^2 / I: what a tangential impulse turns it
FASTEST = 30.0  # of the velocity scale: what answers a slip in proportion stays below; nothing grows without end
SOFT = 1e-6  # under the root of a squared length, so that its gradient stays finite


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


class ImpulseNetwork(nn.Module):
    """All rounds of one kind of contact; networks of several kinds take turns on the same grains (see `exchange`).

    Args:
        n_scalar: scalars of a contact.
        n_basis: its directions.
        mutual: both sides are grains; else one is a wall, which nothing moves.
        hidden, layers, mlp_layers: width, rounds, linear layers of each MLP.
        channels: vectors that a grain carries, at least three.
    """

    def __init__(
        self, *, n_scalar: int, n_basis: int, mutual: bool, hidden: int, layers: int, mlp_layers: int, channels: int
    ) -> None:
        super().__init__()
        self.hidden, self.mutual = hidden, mutual
        self.encode = mlp(n_scalar, hidden, hidden, mlp_layers, layer_norm=True)
        self.rounds = nn.ModuleList(
            ImpulseRound(hidden, mlp_layers, channels, n_basis, mutual=mutual, last=turn == layers - 1)
            for turn in range(layers)
        )

    def hears(self, n: int, contacts: Contacts) -> Bool[Tensor, " n"]:
        """Which of `n` grains have a contact of this kind."""
        return reached(n, *contacts.ends[0 if self.mutual else 1 :])

    def forward(
        self,
        turn: int,
        grains: Grains,
        contacts: Sequence[Contacts],
        edges: Sequence[Tensor] | None,
        hears: Bool[Tensor, " n"],
    ) -> tuple[Grains, list[Tensor]]:
        """One round: what grains carry after it, and the contacts' latents.

        Args:
            turn: number of the round.
            grains: before it.
            contacts: in pieces.
            edges: their latents after the round before, None in the first.
            hears: grains that have a contact of this kind.
        """
        if edges is None:
            edges = [self.encode(piece.scalars) for piece in contacts]
        return self.rounds[turn](grains, contacts, edges, hears)


class ImpulseRound(MessagePassing):
    """One round: every contact exchanges messages and impulses, then the grains' latents follow.

    Args:
        hidden, mlp_layers, channels, n_basis, mutual: see `ImpulseNetwork`.
        last: no later round would read the grains' latents.
    """

    def __init__(self, hidden: int, mlp_layers: int, channels: int, n_basis: int, *, mutual: bool, last: bool) -> None:
        super().__init__(aggr="sum", flow="source_to_target")
        self.hidden, self.channels, self.mutual = hidden, channels, mutual
        n_given = channels * (n_basis + 1)
        self.from_seen = nn.Linear(2 * n_given, hidden)
        self.from_ends = nn.Linear(hidden, hidden, bias=False)  # a pair looks the same from either side
        self.from_edge = nn.Linear(hidden, hidden, bias=False)
        for part in (self.from_seen, self.from_ends, self.from_edge):
            nn.init.uniform_(part.weight, -((3 * hidden) ** -0.5), (3 * hidden) ** -0.5)  # as one layer of 3 x hidden
        self.message_mlp = mlp(hidden, hidden, hidden, mlp_layers - 1, layer_norm=True)
        self.impulse_mlp = mlp(hidden, hidden, n_given, 2)
        with torch.no_grad():  # begin near free flight
            for parameter in self.impulse_mlp[-1].parameters():
                parameter.mul_(0.1)
        self.update_mlp = None if last else mlp(2 * hidden, hidden, hidden, mlp_layers, layer_norm=True)

    def forward(
        self, grains: Grains, contacts: Sequence[Contacts], edges: Sequence[Tensor], hears: Bool[Tensor, " n"]
    ) -> tuple[Grains, list[Tensor]]:
        n, carried = len(grains.latent), torch.cat([grains.vel, grains.spin], dim=2)
        latent, after = linear(self.from_ends, grains.latent), []
        heard = 0 if self.update_mlp is None else self.hidden
        gained = carried.new_zeros(n, heard + 6 * self.channels)
        for piece, before in zip(contacts, edges, strict=True):
            edge, *told = self.edge_update(piece, before, latent, carried)
            message, impulse, turn = (part[: piece.n].flatten(1) for part in told)
            to, share = piece.ends[:, : piece.n], None if piece.share is None else piece.share[: piece.n]
            rows = torch.cat([message[:, :heard], impulse, turn], dim=1)
            if share is not None:
                rows[:, heard:] *= share[:, 1:]
            if self.mutual:
                back = torch.cat([message[:, :heard], -impulse, turn], dim=1)
                if share is not None:
                    back[:, heard:] *= share[:, :1]
                to, rows = torch.cat([to, to.flip(0)], dim=1), torch.cat([rows, back])
            if len(contacts) == 1:
                gained = self.propagate(to, rows=rows.to(gained.dtype), size=(n, n))
            else:
                gained.index_add_(0, to[1], rows.to(gained.dtype))  # sums stay in full precision
            after.append(edge)
        vel, spin = (part.view(grains.vel.shape) for part in gained[:, heard:].chunk(2, dim=1))
        there = grains.latent
        if self.update_mlp is not None:  # of those that hear: a network that reaches nobody changes nothing
            updated = there + self.update_mlp(torch.cat([there, gained[:, :heard]], dim=1))
            there = torch.where(hears[:, None], updated, there)
        return Grains(there, grains.vel + vel, grains.spin + spin), after

    def edge_update(
        self, contacts: Contacts, edge: Tensor, latent: Tensor, carried: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What every contact knows after this round, says to its grains, and gives the receiver: an impulse and a turn,
        (n_contacts, 3, channels) each."""
        (sender, receiver), basis = contacts.ends, contacts.basis
        normal, n_basis = basis[:, :, :1], basis.shape[2]
        vel, spin = carried.index_select(0, receiver).chunk(2, dim=2)
        hidden = latent.index_select(0, receiver)
        if self.mutual:
            other_vel, other_spin = carried.index_select(0, sender).chunk(2, dim=2)
            spin, hidden = spin + other_spin, hidden + latent.index_select(0, sender)
        else:
            assert contacts.wall_vel is not None
            other_vel = contacts.wall_vel
        slip = other_vel - vel - torch.linalg.cross(spin, normal.expand_as(spin), dim=1)  # of the surfaces in touch
        along = (basis[:, :, :, None] * slip[:, :, None, :]).sum(1)
        speed = (slip.square().sum(1) + SOFT).sqrt()
        seen = torch.cat([along.flatten(1), speed], dim=1)
        seen = torch.cat([seen, fine(seen, contacts.slow)], dim=1)
        message = self.message_mlp((hidden + linear(self.from_edge, edge) + linear(self.from_seen, seen)).relu_())
        edge = edge + message
        factors = self.impulse_mlp(edge).view(len(edge), n_basis + 1, self.channels)
        against = factors[:, -1] / (1 + (speed / FASTEST).square()).sqrt()
        impulse = (basis[:, :, :, None] * factors[:, None, :-1]).sum(2) + against[:, None] * slip
        turn = SPHERE * torch.linalg.cross(normal.expand_as(impulse), impulse, dim=1)
        return edge, message, impulse, turn

    def message(self, rows: Tensor) -> Tensor:
        return rows


class Damping(nn.Module):
    """What a DEM's damping leaves of that. Cundall's takes from every force that speeds a grain up and adds to those
    that slow it down, which no two grains give each other. How much in a frame is learned, as shares of what is known.

    Args:
        hidden, channels: see `ImpulseNetwork`.
    """

    BORNE, SLOWED = slice(0, 2), slice(2, 5)  # shares of: gravity's damping given back; mean, end velocity, spin lost

    def __init__(self, hidden: int, channels: int) -> None:
        super().__init__()
        self.shares = mlp(hidden + 6 * channels, hidden, 5, 2)
        with torch.no_grad():  # begin with little
            final = list(self.shares[-1].parameters())[-1]
            final.fill_(-3.0)

    def forward(self, before: Grains, after: Grains, slow: float) -> Float[Tensor, "n 5"]:
        """Shares between 0 and 1."""
        lengths = []
        for old, new in ((before.vel, after.vel), (before.spin, after.spin)):
            lengths += [(x.square().sum(1) + SOFT * slow).sqrt() for x in (old, new, new - old)]
        return self.shares(torch.cat([after.latent, fine(torch.cat(lengths, dim=1), slow)], dim=1)).sigmoid()


def pieces(contacts: Contacts, hidden: int) -> list[Contacts]:
    """Contacts as pieces that are best handled one after the other, in numbers that come again (see `models.mlp`)."""
    always = [blocks(side, hidden) for side in (contacts.ends.T, contacts.scalars, contacts.basis)]
    perhaps = [None if side is None else blocks(side, hidden) for side in (contacts.wall_vel, contacts.share)]
    found = []
    for number, (ends, scalars, basis) in enumerate(zip(*always, strict=True)):
        wall_vel, share = (None if lot is None else recurring(lot[number], ROWS) for lot in perhaps)
        ends, n = recurring(ends, ROWS).T, len(ends)
        filled = recurring(scalars, ROWS), recurring(basis, ROWS)
        found.append(Contacts(ends, *filled, contacts.slow, wall_vel, share, n))
    return found


def exchange(grains: Grains, kinds: Sequence[tuple[ImpulseNetwork, Contacts]]) -> Grains:
    """What grains carry after all rounds, in which the kinds of contact take turns."""
    lots = [pieces(contacts, network.hidden) for network, contacts in kinds]
    hears = [network.hears(len(grains.latent), contacts) for network, contacts in kinds]
    edges: list[list[Tensor] | None] = [None] * len(kinds)
    for turn in range(len(kinds[0][0].rounds)):
        for kind, (network, _) in enumerate(kinds):
            grains, edges[kind] = network(turn, grains, lots[kind], edges[kind], hears[kind])
    return grains
