"""The one kind of small network everything else is made of."""

import itertools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from gns_pyg import machine

INTEL = machine.by_intel()
ROWS = 128  # of which rows come in multiples (see `recurring`)
# Numbers of a latent that each thread of a CPU handles at once: few enough to stay in its cache.
BLOCK = 2**20 if INTEL else 3 * 2**17

ONE_DNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")
FUSED = {torch.float32} if ONE_DNN else set()  # what oneDNN multiplies here
if ONE_DNN and torch.ops.mkldnn._is_mkldnn_bf16_supported():
    FUSED.add(torch.bfloat16)
# With gradients, layers from this width on gain more by oneDNN than calling it and laying out what is transposed cost;
# none where vectors are narrow, nor on Intel's processors: MKL is as fast there.
WIDE = 100 if torch.backends.cpu.get_cpu_capability() == "AVX512" and not INTEL else math.inf


Parted = tuple[Callable[[Tensor], Tensor], tuple[Tensor, Tensor] | None]


class Mlp(nn.Sequential):
    """Linear layers with ReLU between them, then perhaps a layer norm; on a CPU oneDNN's products (see `dense`)."""

    kept: dict[tuple[torch.dtype, bool, bool], Parted] | None = None  # see `fixed_weights`

    def forward(self, rows: Tensor) -> Tensor:
        function, affine = self.parted(rows.dtype)
        return function(rows) if affine is None else torch.addcmul(affine[1], function(rows), affine[0])

    def parted(self, dtype: torch.dtype) -> Parted:
        """A function, a weight and a bias, so that function(rows) * weight + bias is what `forward` returns; None for
        the two where the function does it all.

        Where oneDNN multiplies without gradients, the last layer's weights are centred instead of every row that comes
        out, whose mean is zero then: a layer norm only has to scale it, in a third of the time.
        """
        if self.kept is None:
            return self._parted(dtype)
        circumstances = dtype, torch.is_grad_enabled(), torch.is_autocast_enabled("cpu")
        if circumstances not in self.kept:
            self.kept[circumstances] = self._parted(dtype)
        return self.kept[circumstances]

    def _parted(self, dtype: torch.dtype) -> Parted:
        layers, norm, affine = [module for module in self if isinstance(module, nn.Linear)], self[-1], None
        weight: Tensor = layers[-1].weight
        bias: Tensor = layers[-1].bias
        multiplied = None if torch.is_grad_enabled() else fuses(weight, dtype)
        if isinstance(norm, nn.LayerNorm) and multiplied == dtype == weight.dtype:
            weight, bias, affine = weight - weight.mean(0), bias - bias.mean(), (norm.weight, norm.bias)

        multiply = dense if affine is None else product

        def function(rows: Tensor) -> Tensor:
            for layer in layers[:-1]:
                rows = multiply(rows, layer.weight, layer.bias).relu_()
            rows = multiply(rows, weight, bias)
            if not isinstance(norm, nn.LayerNorm):
                return rows
            if affine is None:
                return norm(rows)
            length = torch.linalg.vector_norm(rows, dim=1, keepdim=True)
            return rows.mul_(length.square_().div_(rows.shape[1]).add_(norm.eps).rsqrt_())

        return function, affine


@contextmanager
def fixed_weights(model: nn.Module) -> Iterator[None]:
    """Nobody changes the weights of `model` meanwhile: what is worked out from them alone is worked out once."""
    perceptrons = [module for module in model.modules() if isinstance(module, Mlp)]
    try:
        for module in perceptrons:
            module.kept = {}
        yield
    finally:
        for module in perceptrons:
            module.kept = None


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


def linear(layer: nn.Linear, rows: Tensor) -> Tensor:
    """`layer(rows)`, by `dense`."""
    return dense(rows, layer.weight, layer.bias)


def dense(rows: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """rows (n, i) @ weight (o, i)^T + bias (o). On a CPU by oneDNN, unless gradients are wanted and it does not pay."""
    cast = fuses(weight, rows.dtype)
    if cast is None or rows.shape[0] == 0:
        return nn.functional.linear(rows, weight, bias)
    return product(rows.to(cast), weight.to(cast), None if bias is None else bias.to(cast))


def fuses(weight: Tensor, dtype: torch.dtype) -> torch.dtype | None:
    """In which precision oneDNN multiplies rows of a `dtype` by `weight`; None where PyTorch does."""
    cast = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else weight.dtype
    return cast if weight.device.type == "cpu" and {dtype, cast} <= FUSED and pays(len(weight)) else None


def pays(width: int) -> bool:
    """Whether layers of this width are oneDNN's."""
    return width >= WIDE or not torch.is_grad_enabled()


def product(rows: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """rows (n, i) @ weight (o, i)^T + bias (o) by oneDNN: of AMD's wide vector units (AVX512) PyTorch's own way, MKL,
    leaves half idle."""
    if torch.is_grad_enabled():
        return Product.apply(rows, weight, bias)
    # what torch.compile would call, without compiling; not its own "relu", which makes a silent 0 of nan
    return torch.ops.mkldnn._linear_pointwise(rows, weight, bias, "none", [], "")


class Product(torch.autograd.Function):
    """`product` and its gradients, which are products too."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        ctx.save_for_backward(rows, weight)
        return product(rows, weight, bias)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (rows, weight), (of_rows, of_weight, of_bias) = ctx.saved_tensors, ctx.needs_input_grad
        return (
            product(gradient, weight.t()) if of_rows else None,
            product(gradient.t(), rows.t()) if of_weight else None,
            gradient.sum(0) if of_bias else None,
        )


def only(chosen: Tensor, function: Callable[[Tensor], Tensor], rows: Tensor, width: int) -> Tensor:
    """`function(rows)`, of layers of a width, where `chosen`, (n,), else 0. A CPU computes no others; on a GPU numbers
    of rows stay as they are."""
    if rows.device.type != "cpu":
        return torch.where(chosen[:, None], function(rows), 0.0)
    named = chosen.nonzero().flatten()
    done = function(rows.index_select(0, recurring(named, ROWS, width)))[: len(named)]
    return done.new_zeros(len(rows), done.shape[1]).index_copy(0, named, done)


def blocks(rows: Tensor, width: int, dim: int = 0) -> tuple[Tensor, ...]:
    """`rows` in pieces that are best handled one after the other at this width; a GPU takes all at once."""
    return rows.split(max(1, torch.get_num_threads() * BLOCK // width), dim) if rows.device.type == "cpu" else (rows,)


def recurring(rows: Tensor, multiple: int, width: int, value: int = 0) -> Tensor:
    """`rows`, on their way through layers of a width, and at least one more of `value`, so that their number comes
    again in other steps; where it matters: oneDNN builds a kernel for every new number, which takes longer than its
    use."""
    if len(rows) == 0 or rows.device.type != "cpu" or not pays(width):
        return rows
    return torch.cat([rows, rows.new_full((multiple - len(rows) % multiple, *rows.shape[1:]), value)])
