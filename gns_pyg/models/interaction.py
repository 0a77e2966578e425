"""One round of message passing: the paper's equations (7) and (8)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing

from gns_pyg.models.mlp import BLOCK, blocks_pay, mlp


class Interaction(MessagePassing):
    """Messages from every sender to every receiver, summed, then the receivers' update.

    The first layer of the message MLP acts on [receiver, sender, edge]. It is written as the sum of three products,
    two of which are taken once per node instead of once per edge: the same function at a fraction of the work.

    Args:
        hidden: width of all latents.
        mlp_layers: linear layers of each MLP.
        skip: adds each MLP's input latent to its output and normalises its layers (not in the paper).

    Shapes:
        senders (n_senders, hidden), receivers (n_receivers, hidden), edges (n_edges, hidden) ->
        receivers (n_receivers, hidden), edges (n_edges, hidden)
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
        edges: Float[Tensor, "n_edges hidden"],
        edge_index: Int[Tensor, "2 n_edges"],
    ) -> tuple[Float[Tensor, "n_receivers hidden"], Float[Tensor, "n_edges hidden"]]:
        size = (senders.shape[0], receivers.shape[0])
        nodes = (self.from_sender(senders), self.from_receiver(receivers))
        if blocks_pay(edges):
            received, edges = self._in_blocks(nodes, edges, edge_index)
        else:
            messages = self.edge_updater(edge_index, x=nodes, edge=self.from_edge(edges), size=size)
            received = self.propagate(edge_index, messages=messages, size=size)
            edges = edges + messages if self.skip else messages
        updated = self.update_mlp(torch.cat([receivers, received], dim=1))
        return receivers + updated if self.skip else updated, edges

    def _in_blocks(self, nodes: tuple[Tensor, Tensor], edges: Tensor, edge_index: Tensor) -> tuple[Tensor, Tensor]:
        """What receivers are sent and the new edges; a block of edges goes through all layers while it is in cache."""
        received, after = torch.zeros_like(nodes[1]), torch.empty_like(edges)
        for start in range(0, len(edges), BLOCK):
            block = slice(start, start + BLOCK)
            sender, receiver = edge_index[:, block]
            messages = self.edge_update(nodes[0][sender], nodes[1][receiver], self.from_edge(edges[block]))
            received.index_add_(0, receiver, messages)
            after[block] = edges[block] + messages if self.skip else messages
        return received, after

    def edge_update(self, x_j: Tensor, x_i: Tensor, edge: Tensor) -> Tensor:
        return self.message_mlp(torch.relu(x_i + x_j + edge))

    def message(self, messages: Tensor) -> Tensor:
        return messages
