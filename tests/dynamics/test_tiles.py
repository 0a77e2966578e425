"""Tiles and balls with a margin hold all that a step of their grains depends on."""

import pytest
import torch

from gns_pyg.dynamics.execution import Execution
from gns_pyg.dynamics.tiles import ball, tiles
from tests import scenes, simulators

NARROW = {"kind": "box", "size_m": [0.26, 0.26, 0.26], "center_m": [0.0, 0.0, 0.0]}
WALLS = {"walls": {"shape": NARROW, "points": 1500, "friction_angle_rad": 0.5}}


def random_pos(n: int) -> torch.Tensor:
    return torch.rand(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(n)) * torch.tensor([3, 1, 2])


@pytest.mark.parametrize(("n", "most"), [(0, 3), (1, 1), (100, 7), (100, 1), (64, 64)])
def test_every_grain_is_in_one_tile_and_the_margin_is_complete(n, most) -> None:
    pos, halo_m, found = random_pos(n), 0.3, []
    for core, region in tiles(pos, most, halo_m):
        assert len(core) <= most
        found.append(core)
        assert torch.equal(region, region.sort().values)
        assert set(core.tolist()) <= set(region.tolist())
        near = (torch.cdist(pos, pos[core]) <= halo_m).any(dim=1).nonzero().flatten()
        assert set(near.tolist()) <= set(region.tolist())
    assert torch.cat(found).sort().values.tolist() == list(range(n))


def test_many_coincident_grains_are_cut_too() -> None:
    cores = [core for core, _ in tiles(torch.zeros(50, 3, dtype=torch.float64), 8, 0.1)]
    assert sorted(torch.cat(cores).tolist()) == list(range(50))


def test_a_ball_is_the_nearest_grains_of_each_graph_and_its_margin() -> None:
    pos, batch = random_pos(90), torch.arange(90) // 45
    core, region = ball(pos, batch, 10, 0.2, [torch.Generator().manual_seed(k) for k in (1, 2)])
    assert torch.bincount(batch[core]).tolist() == [10, 10]
    for graph in (0, 1):
        inside, around = core[batch[core] == graph], region[batch[region] == graph]
        near = (torch.cdist(pos, pos[inside]) <= 0.2).any(dim=1) & (batch == graph)
        assert set(near.nonzero().flatten().tolist()) <= set(around.tolist())
    assert torch.equal(region, region.sort().values)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"free_grains": False},
        {"layers": 1},
        {"self_loops": True},
        simulators.PAPER,
        simulators.IMPULSE,
        simulators.TOUCHING,
    ],
)
@pytest.mark.parametrize("most", [7, 40])
def test_tiles_give_the_same_step(changes, most) -> None:
    scene = scenes.scene(300, 5, boundary=WALLS)
    model = simulators.simulator(scene, dtype=torch.float64, **changes)
    state = simulators.state_in_box([120, 90], half_m=0.12, spin=model.requires.state == "full")
    with torch.inference_mode():
        whole = model(state)
        model.execution = Execution(tile_grains=most)
        tiled = model(state)
    for field in ("pos", "vel", "ang_vel"):
        if getattr(whole, field) is not None:
            scale = (getattr(whole, field) - getattr(state, field)).abs().max()
            torch.testing.assert_close(getattr(tiled, field), getattr(whole, field), rtol=0, atol=1e-10 * float(scale))


def test_the_loss_of_a_region_is_that_of_its_grains() -> None:
    """Gradients of a ball equal those of the same grains' share of the whole."""
    scene = scenes.scene(300, 5, boundary=WALLS)
    model = simulators.simulator(scene, dtype=torch.float64)
    state = simulators.state_in_box([150], half_m=0.12)
    core, region = ball(state.pos, state.batch, 20, model.halo_m, [torch.Generator().manual_seed(0)])
    assert len(region) < 150
    weights = list(model.parameters())
    few = model.correction(state.pick(region))[torch.searchsorted(region, core.sort().values)].square().sum()
    whole = model.correction(state)[core].square().sum()
    for a, b in zip(torch.autograd.grad(few, weights), torch.autograd.grad(whole, weights), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-10)
