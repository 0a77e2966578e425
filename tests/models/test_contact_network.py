"""Message passing against the formula written out, and who is left out of it."""

import pytest
import torch

from gns_pyg.models.contact_network import EDGES, ContactNetwork
from gns_pyg.models.interaction import Ends, Interaction
from gns_pyg.models.mlp import ONE_DNN, ROWS, dense, fixed_weights

WIDTH = 8


def test_split_first_layer_is_the_layer_on_the_concatenation():
    """Equations (7) and (8), written plainly: one product on [receiver, sender, edge], messages summed by a loop."""
    torch.manual_seed(0)
    block = Interaction(WIDTH, 3, skip=False).double()
    receivers, senders = torch.randn(5, WIDTH).double(), torch.randn(4, WIDTH).double()
    edge_index = torch.tensor([[0, 3, 1, 2, 2], [1, 1, 0, 4, 1]])
    edges = torch.randn(5, WIDTH).double()
    weight = torch.cat([block.from_receiver.weight, block.from_sender.weight, block.from_edge.weight], dim=1)
    joined = torch.cat([receivers[edge_index[1]], senders[edge_index[0]], edges], dim=1)
    messages = block.message_mlp(torch.relu(joined @ weight.T + block.from_receiver.bias))
    received = torch.stack([messages[edge_index[1] == i].sum(0) for i in range(5)])
    expected = block.update_mlp(torch.cat([receivers, received], dim=1))
    updated, kept, _ = block(senders, receivers, [edges], Ends(*edge_index, 5, same=False))
    assert torch.allclose(updated, expected)
    assert torch.allclose(kept[0], messages)


def network(**changes):
    torch.manual_seed(0)
    sizes = dict(n_sender=None, n_receiver=3, n_edge=2, n_out=3, hidden=WIDTH, layers=2, mlp_layers=2, skip=True)
    return ContactNetwork(**(sizes | changes))


@pytest.mark.parametrize("n_grains", [3, 7])  # with and without isolated grains after the last edge
def test_grains_without_an_edge_get_exactly_zero_and_change_nothing(n_grains):
    edge_index = torch.tensor([[0, 2], [2, 0]])
    grains, edges = torch.randn(n_grains, 3), torch.randn(2, 2)
    out = network()(None, grains, edges, edge_index)
    assert out.shape == (n_grains, 3)
    isolated = [i for i in range(n_grains) if i not in (0, 2)]
    assert torch.equal(out[isolated], torch.zeros(len(isolated), 3))
    assert torch.equal(out[:3], network()(None, grains[:3], edges, edge_index))


def test_no_edges_give_zeros():
    none = torch.empty(2, 0, dtype=torch.long)
    assert torch.equal(network()(None, torch.randn(4, 3), torch.empty(0, 2), none), torch.zeros(4, 3))


def test_boundary_points_out_of_reach_change_nothing():
    points, grains, edges = torch.randn(50, 4), torch.randn(6, 3), torch.randn(3, 2)
    model = network(n_sender=4)
    few = model(points[[10, 20]], grains, edges, torch.tensor([[0, 1, 1], [5, 5, 2]]))
    all_points = model(points, grains, edges, torch.tensor([[10, 20, 20], [5, 5, 2]]))
    assert torch.equal(few, all_points)


def test_edges_carry_from_sender_to_receiver():
    """Changing a wall point changes only the grains it sends to."""
    points, grains, edges = torch.randn(2, 4), torch.randn(3, 3), torch.randn(2, 2)
    edge_index, model = torch.tensor([[0, 1], [2, 1]]), network(n_sender=4)
    before = model(points, grains, edges, edge_index)
    points[0] += 1
    changed = (model(points, grains, edges, edge_index) != before).any(dim=1)
    assert changed.tolist() == [False, False, True]


@pytest.mark.parametrize("skip", [True, False])
@pytest.mark.parametrize("n_sender", [None, 4])
def test_edges_in_blocks_are_the_plain_network_with_the_same_gradients(skip, n_sender, monkeypatch):
    random = torch.Generator().manual_seed(1)
    model = network(skip=skip, n_sender=n_sender)
    grains, edges = torch.randn(12, 3, generator=random), torch.randn(90, 2, generator=random)
    pairs = torch.randint(0, 11, (2, 45), generator=random)
    edge_index = torch.cat([pairs, pairs.flip(0)], dim=1)
    senders = None if n_sender is None else torch.randn(12, 4, generator=random)

    def results() -> list[torch.Tensor]:
        inputs = [grains.clone().requires_grad_(), edges.clone().requires_grad_()]
        effect = model(senders, *inputs, edge_index)
        used = [*inputs, *model.parameters()]
        return [effect.detach(), *torch.autograd.grad(effect.square().sum(), used)]

    plain = results()
    monkeypatch.setattr("gns_pyg.models.mlp.BLOCK", 16 * WIDTH // torch.get_num_threads())
    for expected, found in zip(plain, results(), strict=True):
        assert torch.allclose(found, expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))


@pytest.mark.parametrize("n_sender", [None, 4])
def test_without_gradients_layers_see_the_same_numbers_of_rows_at_every_step(n_sender, monkeypatch):
    model, seen, random = network(n_sender=n_sender), set(), torch.Generator().manual_seed(1)

    def spied(rows, *layer):
        seen.add(len(rows))
        return dense(rows, *layer)

    for n in (20, 31, 57, 256):
        senders = None if n_sender is None else torch.randn(n, 4, generator=random)
        grains, edges = torch.randn(n, 3, generator=random), torch.randn(6 * n, 2, generator=random)
        pairs = torch.randint(0, n, (2, 3 * n), generator=random)
        edge_index = torch.cat([pairs, pairs.flip(0)], dim=1)
        expected = model(senders, grains, edges, edge_index).detach()
        with monkeypatch.context() as patch, torch.inference_mode():
            for module in ("mlp", "interaction"):
                patch.setattr(f"gns_pyg.models.{module}.dense", spied)
            found = model(senders, grains, edges, edge_index)
        assert torch.allclose(found, expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))
    assert seen <= {ROWS, 2 * ROWS, 3 * ROWS, EDGES, 2 * EDGES, 7 * EDGES}


@pytest.mark.parametrize("n_blocks", [1, 5])
@pytest.mark.parametrize("n_sender", [None, 4])
def test_parted_layer_norms_give_what_whole_ones_give(n_sender, n_blocks, monkeypatch):
    """The formula without gradients beside that with gradients, which layer norms of their own weights tell apart."""
    model, random = network(n_sender=n_sender, layers=3), torch.Generator().manual_seed(1)
    with torch.no_grad():
        for module in model.modules():
            if isinstance(module, torch.nn.LayerNorm):
                module.weight.add_(torch.randn(WIDTH, generator=random))
                module.bias.add_(torch.randn(WIDTH, generator=random))
    senders, grains = torch.randn(50, 4, generator=random), torch.randn(60, 3, generator=random)
    edges, pairs = torch.randn(400, 2, generator=random), torch.randint(0, 50, (2, 200), generator=random)
    inputs = None if n_sender is None else senders, grains, edges, torch.cat([pairs, pairs.flip(0)], dim=1)
    monkeypatch.setattr("gns_pyg.models.mlp.BLOCK", -(-2 * EDGES // n_blocks) * WIDTH // torch.get_num_threads())
    expected = model(*inputs).detach()
    with torch.inference_mode():
        found = model(*inputs)
    assert torch.allclose(found, expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))
    assert not ONE_DNN or not torch.equal(found, expected)  # they are two ways


def test_weights_are_fixed_while_somebody_says_so_and_no_longer():
    """What is kept meanwhile gives the same, with gradients and without; new weights count afterwards."""
    model, edge_index = network(), torch.tensor([[0, 1, 2], [1, 0, 1]])
    inputs = None, torch.randn(4, 3), torch.randn(3, 2), edge_index

    def both_ways() -> list[torch.Tensor]:
        with torch.inference_mode():
            fast = model(*inputs)
        return [fast, model(*inputs).detach()]

    plain = both_ways()
    with fixed_weights(model):
        for _ in range(2):
            assert all(torch.equal(*pair) for pair in zip(plain, both_ways(), strict=True))
    with torch.no_grad():
        for weights in model.parameters():
            weights.mul_(1.5)
    changed = both_ways()
    assert torch.allclose(*changed, rtol=1e-5, atol=1e-6)
    assert not torch.allclose(changed[0], plain[0], rtol=0.01)


@pytest.mark.parametrize("n_sender", [None, 4])
def test_computing_all_grains_gives_what_computing_the_reached_ones_gives(n_sender):
    points, grains, edges = torch.randn(5, 4), torch.randn(9, 3), torch.randn(4, 2)
    edge_index = torch.tensor([[0, 2, 4, 2], [2, 0, 2, 4]])
    few, everyone = (network(n_sender=n_sender, sparse=sparse) for sparse in (True, False))
    senders = None if n_sender is None else points
    out = everyone(senders, grains, edges, edge_index)
    assert torch.allclose(out, few(senders, grains, edges, edge_index), rtol=1e-5, atol=1e-7)
    assert torch.equal(out[[1, 3, 5, 6, 7, 8]], torch.zeros(6, 3))


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_what_is_not_finite_stays_so_without_gradients(value):
    """A fast kernel's ReLU may turn nan into 0, and hide it."""
    grains, edges = torch.randn(4, 3), torch.randn(3, 2)
    edges[1, 0] = value
    edge_index = torch.tensor([[0, 1, 2], [1, 0, 3]])
    plain = network()(None, grains, edges, edge_index).detach()
    with torch.inference_mode():
        fast = network()(None, grains, edges, edge_index)
    assert plain.isfinite().all(dim=1).tolist() == fast.isfinite().all(dim=1).tolist()
    assert not fast.isfinite().all()
