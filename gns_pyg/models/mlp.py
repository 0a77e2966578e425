"""The one kind of small network everything else is made of."""

import itertools
from collections.abc import Callable

import torch
from torch import Tensor, nn

ROWS = 128  # of which rows come in multiples (see `recurring`)
BLOCK = 2**18  # numbers of a latent that a CPU handles at once: few enough to stay in its cache through all layers

ONE_DNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")
FUSED = {torch.float32} if ONE_DNN else set()  # what oneDNN multiplies here
if ONE_DNN and torch.ops.mkldnn._is_mkldnn_bf16_supported():
    FUSED.add(torch.bfloat16)


class Mlp(nn.Sequential):
    """Linear layers with ReLU between them; without gradients on a CPU, oneDNN's own kernels."""

    def forward(self, rows: Tensor) -> Tensor:
        modules = list(self)
        for module, following in itertools.zip_longest(modules, modules[1:]):
            if isinstance(module, nn.Linear):
                rows = linear(module, rows, relu=isinstance(following, nn.ReLU))
            elif not isinstance(module, nn.ReLU):
                rows = module(rows)
        return rows


def mlp(n_in: int, hidden: int, n_out: int, layers: int, *, layer_norm: bool = False) -> Mlp:
    """A perceptron of `layers` linear layers with ReLU between them, (n, n_in) -> (n, n_out).

    `layer_norm` normalises the output.
    """
    widths = [n_in, *[hidden] * (layers - 1), n_out]
    modules: list[nn.Module] = []
    for wide, narrow in itertools.pairwise(widths):
        modules += [nn.Linear(wide, narrow), nn.ReLU()]
    modules.pop()
    return Mlp(*modules, *([nn.LayerNorm(n_out)] if layer_norm else []))


def linear(layer: nn.Linear, rows: Tensor, *, relu: bool = False) -> Tensor:
    """`layer(rows)`, then ReLU on demand."""
    cast = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else layer.weight.dtype
    if rows.device.type == "cpu" and {rows.dtype, cast} <= FUSED and not torch.is_grad_enabled():
        bias = None if layer.bias is None else layer.bias.to(cast)
        # what torch.compile would call, without compiling; not its own "relu", which makes a silent 0 of nan
        rows = torch.ops.mkldnn._linear_pointwise(rows.to(cast), layer.weight.to(cast), bias, "none", [], "")
    else:
        rows = layer(rows)
    return rows.relu_() if relu else rows


def only(chosen: Tensor, function: Callable[[Tensor], Tensor], rows: Tensor) -> Tensor:
    """`function(rows)` where `chosen`, (n,), else 0. A CPU computes no others; on a GPU numbers of rows stay as they
    are."""
    if rows.device.type != "cpu":
        return torch.where(chosen[:, None], function(rows), 0.0)
    named = chosen.nonzero().flatten()
    done = function(recurring(rows.index_select(0, named), ROWS))[: len(named)]
    return done.new_zeros(len(rows), done.shape[1]).index_copy(0, named, done)


def blocks(rows: Tensor, width: int, dim: int = 0) -> tuple[Tensor, ...]:
    """`rows` in pieces that are best handled one after the other at this width; a GPU takes all at once."""
    return rows.split(max(1, BLOCK // width), dim) if rows.device.type == "cpu" else (rows,)


def recurring(rows: Tensor, multiple: int, value: int = 0) -> Tensor:
    """`rows` and at least one more of `value`, so that their number comes again in other steps; where it matters:
    oneDNN builds a kernel for every new number, which takes longer than its use."""
    if len(rows) == 0 or rows.device.type != "cpu" or torch.is_grad_enabled():
        return rows
    return torch.cat([rows, rows.new_full((multiple - len(rows) % multiple, *rows.shape[1:]), value)])
