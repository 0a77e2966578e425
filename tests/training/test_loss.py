"""What training makes smaller."""

import pytest
import torch

from gns_pyg.training.loss import BARE, FEWEST, SLOWEST, balance_loss, cells, creep_loss, gap_loss, mean_loss


def test_the_loss_is_a_square_below_the_knee_and_a_length_above():
    error = torch.randn(50, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert mean_loss(error, 0.0).item() == pytest.approx(error.square().mean().item())
    squares = error.view(50, 3, 3).square().sum(2)
    assert mean_loss(error, 1e3).item() == pytest.approx((squares / 2e3).mean().item(), rel=1e-4)
    assert mean_loss(error, 1e-9).item() == pytest.approx(squares.sqrt().mean().item(), rel=1e-6)
    still = torch.zeros(4, 6, requires_grad=True)
    for knee in (0.0, 0.02):
        loss = mean_loss(still, knee)
        assert loss.item() == 0
        assert not torch.autograd.grad(loss, still)[0].any()  # finite: no root of zero
        assert mean_loss(still[:0], knee).item() == 0


def test_balance_is_the_square_of_what_a_cell_gains_together():
    error = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 2.0, 0]], dtype=torch.float64)
    vel = torch.tensor([[3.0, 0, 0], [3.0, 0, 0], [0, -1.0, 0]], dtype=torch.float64)
    cell = torch.tensor([0, 0, 1])
    # cell 0: no momentum; energies 3.5 and -2.5, mean 0.5. cell 1: momentum 2, energy 1/2 - 1/2
    assert balance_loss(error, vel, cell).item() == pytest.approx((2 * 0.5**2 + 2.0**2) / 3)
    still = torch.zeros(3, 3, requires_grad=True)
    loss = balance_loss(still, vel.float(), cell)
    assert loss.item() == 0
    assert not torch.autograd.grad(loss, still)[0].any()
    assert balance_loss(error[:0], vel[:0], cell[:0]).item() == 0


def test_what_creeps_counts_as_much_as_what_flows():
    """Two classes, each a tenth too fast along x in one cell and along -x in the other; a third of too few grains."""
    kind = torch.tensor([0] * FEWEST + [1] * FEWEST + [2] * (FEWEST - 1))
    cell = torch.arange(len(kind)) % 2
    vel = torch.zeros(len(kind), 3, dtype=torch.float64)
    vel[:, 2] = torch.tensor([0.1, 10.0, 1.0], dtype=torch.float64)[kind]
    error = torch.zeros_like(vel)
    error[:, 0] = 0.1 * vel[:, 2] * (1 - 2 * cell)
    expected = 0.01 * 0.1**2 / (0.1**2 + SLOWEST**2) + 0.01 * 10**2 / (10**2 + SLOWEST**2)
    assert creep_loss(error, vel, kind, cell).item() == pytest.approx(expected)
    assert creep_loss(error, vel, kind, 0 * cell).item() == pytest.approx(0, abs=1e-12), "nothing is gained together"
    assert creep_loss(error[:0], vel[:0], kind[:0], cell[:0]).item() == 0


def test_gaps_count_over_how_far_they_would_be_had_they_stayed():
    """Two classes, both half as far off as the DEM's gaps have moved, one by a thousandth; a third of too few pairs."""
    kind = torch.tensor([0] * FEWEST + [1] * FEWEST + [2] * (FEWEST - 1))
    way = torch.tensor([1e3, 1e-3, 1.0], dtype=torch.float64)[kind] * (1 - 2 * (torch.arange(len(kind)) % 2))
    large, small = (1e3 / 2 - 1) / (1e3 - 1 + BARE), (1e-6 / 8) / (1e-6 / 2 + BARE)
    assert gap_loss(way / 2, way, kind).item() == pytest.approx(large + small, rel=1e-5)
    assert gap_loss(0 * way, way, kind).item() == 0
    assert gap_loss(way[:0], way[:0], kind[:0]).item() == 0


def test_ten_times_larger_cells_scatter_a_tenth_and_see_all_of_an_error_that_grains_share():
    scatter = 1e-3 * torch.randn(30_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    shared = torch.tensor([0.0, 0.0, 1e-4], dtype=torch.float64).expand_as(scatter)
    still, (small, large) = torch.zeros_like(scatter), (torch.arange(30_000) // grains for grains in (30, 300))
    assert balance_loss(shared, still, large) / balance_loss(shared, still, small) == pytest.approx(1)
    assert balance_loss(scatter, still, large) / balance_loss(scatter, still, small) == pytest.approx(0.1, rel=0.3)


@pytest.mark.parametrize("weight", [0.0, 1e4])
def test_an_average_motion_loses_energy_unless_cells_must_keep_it(weight):
    """Half of the grains move at 2, half at 0, each along its own direction, and who does cannot be known."""
    random = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(2000, 3, generator=random, dtype=torch.float64), dim=1)
    vel = 2 * direction * (torch.arange(2000) % 2)[:, None]
    speed = torch.ones((), dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([speed], max_iter=50, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        error = speed * direction - vel
        found = mean_loss(error, 0.0) + weight * balance_loss(error, vel, torch.zeros(2000, dtype=torch.long))
        found.backward()
        return found

    optimizer.step(loss)
    assert speed.item() == pytest.approx(2**0.5 if weight else 1.0, rel=1e-3)


def test_cells_are_cubes_that_no_two_graphs_share_and_that_are_drawn_anew():
    pos = torch.rand(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    batch = torch.arange(2).repeat_interleave(200)
    pos[200:] = pos[:200]

    def drawn(*seeds):
        return cells(pos, batch, 0.4, [torch.Generator().manual_seed(seed) for seed in seeds])

    found = drawn(1, 2)
    for number in found.unique():
        inside = found == number
        assert len(batch[inside].unique()) == 1
        assert ((pos[inside].amax(0) - pos[inside].amin(0)) < 0.4).all()
    assert 2 * 8 <= len(found.unique()) <= 2 * 64
    assert torch.equal(found, drawn(1, 2))
    same = drawn(3, 3)  # two graphs, each with a generator of the same seed: the same cells
    assert torch.equal(same[:200].unique(return_inverse=True)[1], same[200:].unique(return_inverse=True)[1])
    assert not torch.equal(found[:200].unique(return_inverse=True)[1], found[200:].unique(return_inverse=True)[1])
