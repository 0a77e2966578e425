"""One round of message passing: the paper's equations (7) and (8)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing

from gns_pyg.models.mlp import linear, mlp


class Interaction(MessagePassing):
    """Messages from every sender to every receiver, summed, then the receivers' update.

    The first layer of the message MLP acts on [receiver, sender, edge]. It is written as the sum of three products,
    two of which are taken once per node instead of once per edge: the same function at a fraction of the work.

    Args:
        hidden: width of all latents.
        mlp_layers: linear layers of each MLP.
        skip: adds each MLP's input latent to its output and normalises its layers (not in the paper).

    Edges come in blocks (see `mlp.blocks`). One block takes PyG's own way; several go one after the other through all
    layers while they are in the processor's cache, with the same result.

    Shapes:
        senders (n_senders, hidden), receivers (n_receivers, hidden), edges n_blocks x (n, hidden) ->
        receivers (n_receivers, hidden), edges n_blocks x (n, hidden)
    """

    def __init__(self, hidden: int, mlp_layers: int, *, skip: bool) -> None:
        super().__init__(aggr="sum", flow="source_to_target")
        self.skip = skip
        self.from_receiver = nn.Linear(hidden, hidden)
        self.from_sender = nn.Linear(hidden, hidden, bias=False)
        self.from_edge = nn.Linear(hidden, hidden, bias=False)
        for part in (self.from_receiver, self.from_sender, self.from_edge):
            nn.init.uniform_(part.weight, -((3 * hidden) ** -0.5), (3 * hidden) ** -0.5)  # as one layer of 3 x hidden
        self.message_mlp = mlp(hidden, hidden, hidden, mlp_layers - 1, layer_norm=skip)
        self.update_mlp = mlp(2 * hidden, hidden, hidden, mlp_layers, layer_norm=skip)

    def forward(
        self,
        senders: Float[Tensor, "n_senders hidden"],
        receivers: Float[Tensor, "n_receivers hidden"],
        edges: Sequence[Float[Tensor, "_ hidden"]],
        edge_index: Sequence[Int[Tensor, "2 _"]],
    ) -> tuple[Float[Tensor, "n_receivers hidden"], list[Float[Tensor, "_ hidden"]]]:
        size = (senders.shape[0], receivers.shape[0])
        nodes = (linear(self.from_sender, senders), linear(self.from_receiver, receivers))
        if len(edges) == 1:
            messages = self.edge_updater(edge_index[0], x=nodes, edge=linear(self.from_edge, edges[0]), size=size)
            received = self.propagate(edge_index[0], messages=messages, size=size)
            after = [edges[0] + messages if self.skip else messages]
        else:
            received, after = torch.zeros_like(receivers), []
            for edge, (sender, receiver) in zip(edges, edge_index, strict=True):
                ends = nodes[0].index_select(0, sender), nodes[1].index_select(0, receiver)
                messages = self.edge_update(*ends, linear(self.from_edge, edge))
                received.index_add_(0, receiver, messages.to(received.dtype))  # sums stay in full precision
                after.append(edge + messages if self.skip else messages)
        updated = self.update_mlp(torch.cat([receivers, received], dim=1))
        return receivers + updated if self.skip else updated, after

    def edge_update(self, x_j: Tensor, x_i: Tensor, edge: Tensor) -> Tensor:
        return self.message_mlp((x_i + x_j).add_(edge).relu_())

    def message(self, messages: Tensor) -> Tensor:
        return messages
