"""Moving grains out of each other and of walls."""

from dataclasses import replace

import pytest
import torch

from gns_pyg.dynamics.projection import OVERLAP, separated
from gns_pyg.state import State, Walls
from tests import scenes
from tests.simulators import simulator, state_in_box

R = 0.01
BOTH_WAYS = torch.tensor([[0, 1], [1, 0]])
NONE = torch.empty(2, 0, dtype=torch.long)


def grains(*pos: tuple[float, float, float], vel: float = 0.0) -> State:
    where = torch.tensor(pos, dtype=torch.float64)
    n = len(where)
    moving = torch.tensor([[0.0, 0.0, vel]], dtype=torch.float64).repeat(n, 1)
    radius, zero = torch.full((n,), R, dtype=torch.float64), torch.zeros(n, dtype=torch.long)
    return State(where, moving, None, radius, torch.zeros(1, dtype=torch.float64), zero)


def floor(speed: float = 0.0) -> Walls:
    """One boundary point at the origin that looks up and moves up."""
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    return Walls(torch.zeros_like(up), up, speed * up, torch.full((1,), 0.5, dtype=torch.float64))


def test_two_grains_part_evenly_along_their_line_of_centres():
    before = grains((0, 0, 0), (0.015, 0, 0))
    after = separated(before, BOTH_WAYS, None, NONE, sweeps=20)
    first, second = after.pos
    assert float(second[0] - first[0]) == pytest.approx(2 * R * (1 - OVERLAP), rel=1e-6)
    assert torch.allclose(first + second, before.pos.sum(0))
    assert torch.equal(after.pos[:, 1:], before.pos[:, 1:])


def test_the_heavy_one_stays_and_the_light_one_goes():
    before = grains((0, 0, 0), (0.02, 0, 0))
    before = replace(before, radius=torch.tensor([2 * R, R], dtype=torch.float64))
    way = (separated(before, BOTH_WAYS, None, NONE, sweeps=20).pos - before.pos)[:, 0]
    assert float(way[1]) == pytest.approx(-8 * float(way[0]))


def test_grains_that_only_touch_stay_where_they_are():
    before = grains((0, 0, 0), (2 * R * (1 - 0.9 * OVERLAP), 0, 0))
    assert torch.equal(separated(before, BOTH_WAYS, None, NONE, sweeps=5).pos, before.pos)


def test_coincident_grains_stay_finite():
    assert torch.isfinite(separated(grains((0, 0, 0), (0, 0, 0)), BOTH_WAYS, None, NONE, sweeps=3).pos).all()


@pytest.mark.parametrize("height", [0.004, -0.006])
def test_a_grain_in_a_wall_or_behind_it_comes_back_and_goes_with_the_wall(height):
    before, contact = grains((0.003, 0, height), vel=-2.0), torch.tensor([[0], [0]])
    after = separated(before, NONE, floor(speed=0.5), contact, sweeps=1)
    assert after.pos[0].tolist() == pytest.approx([0.003, 0.0, R])
    assert after.vel[0].tolist() == pytest.approx([0.0, 0.0, 0.5])


def test_a_grain_that_leaves_a_wall_keeps_its_velocity():
    before, contact = grains((0, 0, 0.9 * R), vel=2.0), torch.tensor([[0], [0]])
    assert torch.equal(separated(before, NONE, floor(), contact, sweeps=1).vel, before.vel)
    away = grains((0, 0, 2 * R), vel=-2.0)
    assert torch.equal(separated(away, NONE, floor(), contact, sweeps=1).vel, away.vel)


def test_the_nearest_boundary_point_decides():
    up = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    points = torch.tensor([[0.0, 0.0, 0.0], [0.018, 0.0, 0.006]], dtype=torch.float64)
    walls = Walls(points, up, torch.zeros_like(up), torch.full((2,), 0.5, dtype=torch.float64))
    contacts = torch.tensor([[0, 1], [0, 0]])
    after = separated(grains((0, 0, 0.006)), NONE, walls, contacts, sweeps=1)
    assert after.pos[0].tolist() == pytest.approx([0.0, 0.0, R])


@pytest.mark.parametrize("state", ["full", "differences"])
def test_a_simulator_with_projection_leaves_less_overlap(state):
    scene = scenes.scene(120, 2)
    crowd = state_in_box([120], half_m=0.05, spin=state == "full")
    with torch.inference_mode():
        plain, projected = (simulator(scene, state=state, projection_sweeps=sweeps)(crowd) for sweeps in (0, 10))

    def overlap(pos: torch.Tensor) -> float:
        return float((2 * R - torch.pdist(pos)).clamp(min=0).sum())

    assert overlap(projected.pos) < 0.5 * overlap(plain.pos)
    if state == "differences":
        assert torch.allclose(projected.vel, (projected.pos - crowd.pos) / scene.frame_dt_s)


def test_grains_that_are_not_there_push_nobody():
    scene = scenes.scene(2, 2, outlet={"point_m": [0.0, 0.0, -5.0], "normal": [0.0, 0.0, -1.0]})
    before = replace(grains((0, 0, 0), (0.015, 0, 0)), ang_vel=torch.zeros(2, 3, dtype=torch.float64))
    alone = replace(before, active=torch.tensor([True, False]))
    model = simulator(scene, projection_sweeps=5)
    assert torch.equal(model(alone).pos[0], simulator(scene)(alone).pos[0])
