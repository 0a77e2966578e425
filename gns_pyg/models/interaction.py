"""One round of message passing: the paper's equations (7) and (8)."""

from collections.abc import Iterator, Sequence
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import embedding_bag
from torch_geometric.nn import MessagePassing

from gns_pyg.models.mlp import blocks, dense, linear, mlp


class Ends:
    """Who is at the ends of every edge, and what every round needs to know of it.

    Args:
        sender, receiver: rows of the senders and of the receivers, (n_edges).
        n_receivers: how many there are.
        same: senders are the receivers.
    """

    def __init__(self, sender: Int[Tensor, " _"], receiver: Int[Tensor, " _"], n_receivers: int, *, same: bool) -> None:
        self.index = torch.stack([sender, receiver])
        self.n_receivers, self.same = n_receivers, same

    @cached_property
    def rows(self) -> Int[Tensor, "_ 2"]:
        """Of both ends in a table of products: of each receiver's, if it sends too, as both; else of all receivers
        before all senders."""
        sender, receiver = self.index
        rows = (2 * receiver, 2 * sender + 1) if self.same else (receiver, sender + self.n_receivers)
        return torch.stack(rows, 1)

    @cached_property
    def degree(self) -> Int[Tensor, "n_receivers 1"]:
        """How many edges reach each receiver."""
        return torch.bincount(self.index[1], minlength=self.n_receivers)[:, None]


class Interaction(MessagePassing):
    """Messages from every sender to every receiver, summed, then the receivers' update.

    The first layer of the message MLP acts on [receiver, sender, edge]. It is written as the sum of three products,
    two of which are taken once per node instead of once per edge: the same function at a fraction of the work.

    Args:
        hidden: width of all latents.
        mlp_layers: linear layers of each MLP.
        skip: adds each MLP's input latent to its output and normalises its layers (not in the paper).
        last: no later round would read the edges' latents.

    Edges come in blocks (see `mlp.blocks`). One block takes PyG's own way; several go one after the other through all
    layers while they are in the processor's cache, with the same result. So does a CPU's one block without gradients,
    where layer norms are parted (see `Mlp.parted`): their weights are applied to the sums of messages, and their biases
    are left out of the edges' latents, which they overwrite, and of which only a product is taken.

    Shapes:
        senders (n_senders, hidden), receivers (n_receivers, hidden), edges n_blocks x (n, hidden), ends (of n_edges),
        lacking (hidden), what every edge's latent lacks, or None ->
        receivers (n_receivers, hidden), edges n_blocks x (n, hidden), lacking
    """

    def __init__(self, hidden: int, mlp_layers: int, *, skip: bool, last: bool = False) -> None:
        super().__init__(aggr="sum", flow="source_to_target")
        self.skip, self.last = skip, last
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
        ends: Ends,
        lacking: Float[Tensor, " hidden"] | None = None,
    ) -> tuple[Float[Tensor, "n_receivers hidden"], list[Float[Tensor, "_ hidden"]], Float[Tensor, " hidden"] | None]:
        function, affine = self.message_mlp.parted(receivers.dtype)
        if len(edges) == 1 and affine is None:
            size = (senders.shape[0], receivers.shape[0])
            nodes = (linear(self.from_sender, senders), linear(self.from_receiver, receivers))
            messages = self.edge_updater(ends.index, x=nodes, edge=linear(self.from_edge, edges[0]), size=size)
            received = self.propagate(ends.index, messages=messages, size=size)
            after = [edges[0] + messages if self.skip else messages]
        else:
            received, after, wide = torch.zeros_like(receivers), [], receivers.shape[1]
            of_ends, constant = self._of_ends(senders, receivers, ends), None
            if lacking is not None:
                constant = self.from_edge.weight @ lacking
            for edge, latent, receiver in zip(edges, of_ends, blocks(ends.index[1], wide), strict=True):
                messages = function(latent.add_(dense(edge, self.from_edge.weight, constant)).relu_())
                received.index_add_(0, receiver, messages)
                if self.skip and not self.last:
                    messages = edge + messages if affine is None else edge.addcmul_(messages, affine[0])
                after.append(messages)
            if affine is not None:
                weight, bias = affine
                received = received.mul_(weight).addcmul_(ends.degree, bias)
                lacking = bias if lacking is None else lacking + bias
        updated = self.update_mlp(torch.cat([receivers, received], dim=1))
        return receivers + updated if self.skip else updated, after, lacking

    def _of_ends(self, senders: Tensor, receivers: Tensor, ends: Ends) -> Iterator[Tensor]:
        """The products with every edge's sender and receiver, summed, block by block."""
        of_sender, of_receiver, wide = self.from_sender, self.from_receiver, receivers.shape[1]
        if torch.is_grad_enabled():
            nodes = linear(of_receiver, receivers), linear(of_sender, senders)
            for sender, receiver in blocks(ends.index, wide, 1):
                yield nodes[0].index_select(0, receiver) + nodes[1].index_select(0, sender)
            return
        if ends.same:  # both products at once, and both rows of an edge in one go
            weight = torch.cat([of_receiver.weight, of_sender.weight])
            bias = torch.cat([of_receiver.bias, torch.zeros_like(of_receiver.bias)])
            table = dense(receivers, weight, bias).view(-1, wide)
        else:
            table = torch.cat([linear(of_receiver, receivers), linear(of_sender, senders)])
        for both in blocks(ends.rows, wide):
            yield embedding_bag(both, table, mode="sum")

    def edge_update(self, x_j: Tensor, x_i: Tensor, edge: Tensor) -> Tensor:
        return self.message_mlp((x_i + x_j).add_(edge).relu_())

    def message(self, messages: Tensor) -> Tensor:
        return messages
