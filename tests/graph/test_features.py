"""Edge features of contacts whose numbers are known by hand."""

import pytest
import torch

from gns_pyg.graph.features import grain_edges, wall_edges
from gns_pyg.state import Graph, State, Walls, fine

R = 0.01
OPTIONS = dict(velocity_m_s=0.5, dt_s=0.01, contact=True, dtype=torch.float64)


def tensor(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def two(shift: float = 0.0, scale: float = 1.0, speed: float = 1.0) -> State:
    """Grain 1 lies 3 R along x from grain 0; it comes, rises and spins, the other spins where it stands."""
    return State(
        pos=scale * tensor([0.0, 0.0, 0.0], [3 * R, 0.0, 0.0]) + shift,
        vel=speed * tensor([0.0, 0.0, 0.0], [-0.2, 0.0, 0.1]),
        ang_vel=speed / scale * tensor([0.0, 30.0, 0.0], [0.0, 20.0, 0.0]),
        radius=scale * tensor(R, R),
        time_s=tensor(0.0),
        batch=torch.zeros(2, dtype=torch.long),
    )


def split(features):
    """rel_pos, direction, distances, gaps, approach, relative velocity, slip; a wall's height after the distances."""
    sizes = [3, 3, 3, 3, 1, 3, 3] if features.shape[1] == 19 else [3, 3, 3, 1, 3, 1, 3, 3]
    return [column.tolist() for column in features[0].split(sizes)]


def test_a_grain_sees_another_one_where_it_is_and_as_it_moves():
    """Grain 1 sends to grain 0: `rel_pos` points from receiver to sender."""
    edge = Graph(torch.tensor([[1], [0]]), torch.empty(2, 0, dtype=torch.long))
    rel_pos, direction, distances, gaps, approach, rel_vel, slip = split(grain_edges(two(), edge, **OPTIONS))
    assert rel_pos == pytest.approx([3, 0, 0])
    assert direction == pytest.approx([1, 0, 0])
    assert distances == pytest.approx([3, 1 / 3, 1 / 9])
    ahead = ((3 * R - 0.002) ** 2 + 0.001**2) ** 0.5
    assert gaps == pytest.approx([1, 0, ahead / R - 2])
    assert approach == pytest.approx([-0.4])
    assert rel_vel == pytest.approx([-0.4, 0, 0.2])
    # surfaces at the contact, along z: 0.1 + (0, 20, 0) x (-R, 0, 0) = 0.1 + 0.2, less (0, 30, 0) x (R, 0, 0) = -0.3
    assert slip == pytest.approx([0, 0, 1.2])


def test_a_grain_sees_a_wall_where_it_is_and_as_it_moves():
    up = tensor([0.0, 0.0, 1.0])
    walls = Walls(tensor([R, 0.0, -2 * R]), up, tensor([0.3, 0.0, 0.1]), tensor(0.5))
    state = two()
    state.ang_vel[0] = torch.tensor([0.0, 10.0, 0.0])
    edge = Graph(torch.empty(2, 0, dtype=torch.long), torch.tensor([[0], [0]]), walls)
    rel_pos, direction, distances, height, gaps, approach, rel_vel, slip = split(
        wall_edges(state, edge, walls, **OPTIONS)
    )
    distance = 5**0.5
    assert rel_pos == pytest.approx([1, 0, -2])
    assert direction == pytest.approx([1 / distance, 0, -2 / distance])
    assert distances == pytest.approx([distance, 1 / distance, 1 / 5])
    assert height == pytest.approx([2])
    assert gaps == pytest.approx([1, 0, 0.9])  # it rises by 1 mm
    assert approach == pytest.approx([-0.2])  # along -normal, from the grain to the wall
    assert rel_vel == pytest.approx([0.6, 0, 0.2])
    # the grain's lowest point moves at (0, 10, 0) x (0, 0, -R) = -0.1 along x
    assert slip == pytest.approx([0.8, 0, 0])


def test_in_float32_a_thousand_kilometres_away_nothing_changes():
    """Differences are taken in float64, then cast."""
    edge = Graph(torch.tensor([[1, 0], [0, 1]]), torch.empty(2, 0, dtype=torch.long))
    here, there = (grain_edges(two(shift), edge, **OPTIONS | {"dtype": torch.float32}) for shift in (0.0, 1e6))
    assert torch.allclose(here, there, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-3, 100.0])
def test_in_other_units_nothing_changes(scale):
    """Lengths times `scale`, times and velocities times its root: gravity stays what it is."""
    edge = Graph(torch.tensor([[1, 0], [0, 1]]), torch.empty(2, 0, dtype=torch.long))
    root = scale**0.5
    scaled = OPTIONS | {"velocity_m_s": 0.5 * root, "dt_s": 0.01 * root}
    assert torch.allclose(
        grain_edges(two(), edge, **OPTIONS), grain_edges(two(0.0, scale, root), edge, **scaled), rtol=1e-9, atol=1e-12
    )


@pytest.mark.parametrize("gap_m", [1e-6, -1e-6])
def test_a_gap_of_a_micrometre_is_exact_in_float32(gap_m):
    """As a difference of float32 lengths it would be off by about 1e-9 m."""
    state = two()
    state.pos[1] = tensor(2 * R + gap_m, 0.0, 0.0)
    grains = Graph(torch.tensor([[1], [0]]), torch.empty(2, 0, dtype=torch.long))
    in_float32 = OPTIONS | {"dtype": torch.float32}
    assert split(grain_edges(state, grains, **in_float32))[3][0] == pytest.approx(gap_m / R, rel=1e-6)
    up = tensor([0.0, 0.0, 1.0])
    walls = Walls(tensor([0.3 * R, 0.0, -R - gap_m]), up, 0 * up, tensor(0.5))
    edge = Graph(torch.empty(2, 0, dtype=torch.long), torch.tensor([[0], [0]]), walls)
    assert split(wall_edges(state, edge, walls, **in_float32))[4][0] == pytest.approx(gap_m / R, rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_fine_scale_is_an_inverse_hyperbolic_sine(dtype) -> None:
    sizes = torch.cat([torch.zeros(1), torch.logspace(-30, 15, 91)]).to(dtype)
    values = torch.cat([-sizes.flip(0), sizes])
    assert torch.allclose(fine(values, 0.5), torch.asinh(2 * values) / 4, rtol=4 * torch.finfo(dtype).eps, atol=0)
    assert fine(torch.tensor([3e38]), 1.0).isfinite().all()
    assert fine(torch.tensor([torch.nan]), 1.0).isnan().all()


def test_the_fine_scale_can_be_differentiated_twice_at_nothing_too() -> None:
    values = torch.tensor([-3.0, -1e-3, 0.0, 1e-3, 2.0], dtype=torch.float64, requires_grad=True)
    for check in (torch.autograd.gradcheck, torch.autograd.gradgradcheck):
        assert check(lambda x: fine(x, 0.5), values)
