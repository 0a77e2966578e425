"""The one kind of small network everything else is made of."""

import itertools

import torch
from torch import Tensor, nn

BLOCK = 1024  # rows handled at once where no gradient is asked for: small enough to stay in the processor's cache


def mlp(n_in: int, hidden: int, n_out: int, layers: int, *, layer_norm: bool = False) -> nn.Sequential:
    """A perceptron of `layers` linear layers with ReLU between them, (n, n_in) -> (n, n_out).

    `layer_norm` normalises the output.
    """
    widths = [n_in, *[hidden] * (layers - 1), n_out]
    modules: list[nn.Module] = []
    for wide, narrow in itertools.pairwise(widths):
        modules += [nn.Linear(wide, narrow), nn.ReLU()]
    modules.pop()
    return nn.Sequential(*modules, *([nn.LayerNorm(n_out)] if layer_norm else []))


def blocks_pay(rows: Tensor) -> bool:
    """Whether rows are better handled block after block: on a CPU, without gradients, if there are many."""
    return rows.device.type == "cpu" and not torch.is_grad_enabled() and len(rows) > BLOCK


def in_blocks(network: nn.Module, rows: Tensor) -> Tensor:
    """`network(rows)`, block after block where that pays."""
    return torch.cat([network(block) for block in rows.split(BLOCK)]) if blocks_pay(rows) else network(rows)
