"""oneDNN's products beside PyTorch's own layer, with and without gradients."""

import pytest
import torch
from torch import nn

from gns_pyg.models import mlp
from gns_pyg.models.mlp import ONE_DNN, linear, recurring

pytestmark = pytest.mark.skipif(not ONE_DNN, reason="this PyTorch has no oneDNN, so its own products are taken")
RANDOM = torch.Generator().manual_seed(0)
WIDE = 100


@pytest.fixture(autouse=True)
def as_with_avx512(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever this processor has: with narrower vectors oneDNN never multiplies with gradients."""
    monkeypatch.setattr(mlp, "WIDE", WIDE)


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize(("n", "n_in", "n_out"), [(300, WIDE, WIDE), (1, 4, 128), (0, WIDE, WIDE), (50, 256, 128)])
def test_a_wide_layer_and_its_gradients_are_pytorchs(n: int, n_in: int, n_out: int, bias: bool) -> None:
    layer, rows = nn.Linear(n_in, n_out, bias=bias), torch.randn(n, n_in, generator=RANDOM)
    weights = torch.randn(n, n_out, generator=RANDOM)

    def found(own: bool) -> list[torch.Tensor]:
        given = rows.clone().requires_grad_()
        out = linear(layer, given).relu_() if own else layer(given).relu()
        assert not own or n == 0 or "Product" in str(out.grad_fn.next_functions)
        return [out, *torch.autograd.grad((out * weights).sum(), [given, *layer.parameters()])]

    for ours, expected in zip(found(own=True), found(own=False), strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4)


def test_a_wide_layers_gradients_have_gradients() -> None:
    layer, rows = nn.Linear(WIDE, WIDE), torch.randn(20, WIDE, generator=RANDOM, requires_grad=True)

    def of_gradients(function) -> torch.Tensor:
        (once,) = torch.autograd.grad(function(rows).square().sum(), rows, create_graph=True)
        return torch.autograd.grad(once.square().sum(), layer.weight)[0]

    ours, expected = of_gradients(lambda rows: linear(layer, rows)), of_gradients(layer)
    torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("grad", [True, False])
def test_a_number_that_is_none_stays_none_through_relu(grad: bool) -> None:
    layer, rows = nn.Linear(WIDE, WIDE), torch.full((3, WIDE), torch.nan)
    with torch.set_grad_enabled(grad):
        assert linear(layer, rows).relu_().isnan().all()


@pytest.mark.parametrize(("grad", "width", "filled"), [(False, 8, 128), (True, WIDE, 128), (True, WIDE - 1, 100)])
def test_rows_are_filled_up_where_onednn_multiplies(grad: bool, width: int, filled: int) -> None:
    with torch.set_grad_enabled(grad):
        assert len(recurring(torch.ones(100, 2), 128, width)) == filled
