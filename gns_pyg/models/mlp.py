"""The one kind of small network everything else is made of."""

import itertools

from torch import Tensor, nn

BLOCK = 2**17  # numbers of a latent that a CPU handles at once: few enough to stay in its cache through all layers


def mlp(n_in: int, hidden: int, n_out: int, layers: int, *, layer_norm: bool = False) -> nn.Sequential:
    """A perceptron of `layers` linear layers with ReLU between them, (n, n_in) -> (n, n_out).

    `layer_norm` normalises the output.
    """
    widths = [n_in, *[hidden] * (layers - 1), n_out]
    modules: list[nn.Module] = []
    for wide, narrow in itertools.pairwise(widths):
        modules += [nn.Linear(wide, narrow), nn.ReLU(inplace=True)]
    modules.pop()
    return nn.Sequential(*modules, *([nn.LayerNorm(n_out)] if layer_norm else []))


def blocks(rows: Tensor, width: int, dim: int = 0) -> tuple[Tensor, ...]:
    """`rows` in pieces that are best handled one after the other at this width; a GPU takes all at once."""
    return rows.split(max(1, BLOCK // width), dim) if rows.device.type == "cpu" else (rows,)
