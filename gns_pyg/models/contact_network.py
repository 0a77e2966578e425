"""Encode, process, decode over one kind of contact: the paper's equations (5) to (9)."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from gns_pyg.models.interaction import Ends, Interaction
from gns_pyg.models.mlp import ROWS, Mlp, blocks, mlp, recurring
from gns_pyg.state import reached

EDGES = 256  # edges come in multiples of it


class ContactNetwork(nn.Module):
    """What contacts do to receiving grains. A grain that no edge reaches gets exactly zero, at no cost.

    Args:
        n_sender: features of a sender; None where senders are the receivers themselves (grain-grain contact).
        n_receiver: features of a receiving grain.
        n_edge: features of an edge.
        n_out: outputs per grain.
        hidden, layers, mlp_layers: width, rounds of message passing, linear layers of each MLP.
        skip: skip connections and layer norms (see `Interaction`).
        sparse: compute only the grains and points that an edge connects; else all of them, with the same result (only
            to measure what that costs).
    """

    def __init__(
        self,
        *,
        n_sender: int | None,
        n_receiver: int,
        n_edge: int,
        n_out: int,
        hidden: int,
        layers: int,
        mlp_layers: int,
        skip: bool,
        sparse: bool = True,
    ) -> None:
        super().__init__()
        self.n_out, self.hidden, self.sparse = n_out, hidden, sparse

        def encoder(n_in: int) -> Mlp:
            return mlp(n_in, hidden, hidden, mlp_layers, layer_norm=skip)

        self.encode_sender = None if n_sender is None else encoder(n_sender)
        self.encode_receiver, self.encode_edge = encoder(n_receiver), encoder(n_edge)
        self.interactions = nn.ModuleList(
            Interaction(hidden, mlp_layers, skip=skip, last=turn == layers - 1) for turn in range(layers)
        )
        self.decode = mlp(hidden, hidden, n_out, mlp_layers)

    def forward(
        self,
        sender_features: Float[Tensor, "n_senders n_sender"] | None,
        receiver_features: Float[Tensor, "n_receivers n_receiver"],
        edge_features: Float[Tensor, "n_edges n_edge"],
        edge_index: Int[Tensor, "2 n_edges"],
    ) -> Float[Tensor, "n_receivers n_out"]:
        """Returns the contacts' effect on every receiver.

        Where senders are the receivers, `sender_features` is None and every sender must also receive
        (edges come in both directions), so that grains without an edge can be left out of the computation.
        """
        n_receivers, sparse = len(receiver_features), self.sparse and edge_index.device.type == "cpu"
        sender, receiver = edge_index
        hears = reached(n_receivers, receiver)
        if sparse:
            grains, receiver = _compact(hears, receiver)
            receiver_features = receiver_features[grains]
        n_reached = len(receiver_features)
        receivers = self.encode_receiver(recurring(receiver_features, ROWS, self.hidden))
        if self.encode_sender is None or sender_features is None:
            senders = None
            sender = _compact(hears, sender)[1] if sparse else sender
        else:
            if sparse:
                points, sender = _compact(reached(len(sender_features), sender), sender)
                sender_features = sender_features[points]
            senders = self.encode_sender(recurring(sender_features, ROWS, self.hidden))
        sender, receiver = (
            recurring(sender, EDGES, self.hidden),
            recurring(receiver, EDGES, self.hidden, value=len(receivers) - 1),
        )
        encode, affine = self.encode_edge.parted(edge_features.dtype)
        edges = [encode(block) for block in blocks(recurring(edge_features, EDGES, self.hidden), self.hidden)]
        ends, lacking = Ends(sender, receiver, len(receivers), same=senders is None), None
        if affine is not None:
            weight, lacking = affine
            edges = [edge.mul_(weight) for edge in edges]
        for interaction in self.interactions:
            senders_ = receivers if senders is None else senders
            receivers, edges, lacking = interaction(senders_, receivers, edges, ends, lacking)
        effect = self.decode(receivers)[:n_reached]
        if sparse:
            return effect.new_zeros(n_receivers, self.n_out).index_copy(0, grains, effect)
        return torch.where(hears[:, None], effect, 0.0)


def _compact(chosen: Bool[Tensor, " n"], index: Int[Tensor, " e"]) -> tuple[Int[Tensor, " m"], Int[Tensor, " e"]]:
    """Rows that are chosen, and `index`, which names only those, counted among them (others, which a captured step
    without enough room may name, as the first: it is done again)."""
    return chosen.nonzero().flatten(), (chosen.cumsum(0) - 1)[index].clamp(min=0)
