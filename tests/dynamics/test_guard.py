"""No grain passes a wall: however fast, wherever it hits, whatever the wall does."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gns_pyg.dynamics.guard import Guard
from gns_pyg.scene.containment import outside
from tests import scenes, simulators

BOX = {"walls": {"shape": scenes.BOX | {"size_m": [0.4, 0.4, 0.4]}, "points": 200, "friction_angle_rad": 0.5}}
DRUM = {
    "drum": {
        "shape": {"kind": "cylinder", "radius_m": 0.2, "length_m": 0.3, "axis": [1.0, 0.0, 0.0], "segments": 24},
        "points": 200,
        "friction_angle_rad": 0.5,
        "motion": {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 30.0},
    }
}
HOURGLASS = {
    "hopper": {
        "shape": {
            "kind": "revolution",
            "profile_m": [[0.2, -0.3], [0.2, -0.1], [0.08, 0.0], [0.2, 0.1], [0.2, 0.3]],
            "segments": 16,
        },
        "points": 400,
        "friction_angle_rad": 0.5,
    }
}


def step(state, way):
    """The state after a step of 10 ms in which every grain goes `way`, m."""
    return replace(state, pos=state.pos + way, vel=way / 0.01, time_s=state.time_s + 0.01)


@pytest.mark.parametrize("boundary", [BOX, DRUM, HOURGLASS])
@pytest.mark.parametrize("most_m", [0.02, 1.0])
def test_whoever_goes_anywhere_stays_inside(boundary, most_m):
    scene = scenes.scene(200, 5, boundary=boundary)
    guard, state = Guard(scene), simulators.state_in_box([150, 50], half_m=0.07)
    state = replace(state, time_s=torch.zeros_like(state.time_s))
    random = torch.Generator().manual_seed(3)
    for _ in range(60):
        way = most_m * (2 * torch.rand(state.pos.shape, generator=random, dtype=torch.float64) - 1)
        state = guard(state, step(state, way))
        assert not outside(state.pos[None].numpy(), state.time_s[:1].numpy(), scene).any()
    assert guard.crossings > 100
    assert guard.first is not None
    assert guard.first.part in boundary


def test_who_meets_no_wall_is_left_alone():
    guard, state = Guard(scenes.scene(40, 5, boundary=BOX)), simulators.state_in_box([40])
    after = step(state, torch.full_like(state.pos, 0.01))
    assert guard(state, after) is after
    assert guard.crossings == 0


def test_the_wall_takes_the_velocity_into_it_and_no_other():
    guard = Guard(scenes.scene(1, 5, boundary=BOX))
    state = simulators.state_in_box([1])
    state = replace(state, pos=torch.tensor([[0.0, 0.0, -0.195]]).double())
    held = guard(state, step(state, torch.tensor([[0.03, 0.0, -1.0]]).double()))
    torch.testing.assert_close(held.vel, torch.tensor([[3.0, 0.0, 0.0]]).double())
    torch.testing.assert_close(held.pos[0, 2], torch.tensor(-0.195).double())
    torch.testing.assert_close(guard.first.speed_m_s, float(np.hypot(3.0, 100.0)))


def test_a_turning_wall_pushes():
    """Flat out against the mantle: the grain gets no velocity into it, in the frame that turns with the wall."""
    guard = Guard(scenes.scene(1, 5, boundary=DRUM))
    state = replace(simulators.state_in_box([1]), time_s=torch.zeros(1, dtype=torch.float64))
    state = replace(state, pos=torch.tensor([[0.0, 0.19, 0.0]]).double())
    held = guard(state, step(state, torch.tensor([[0.0, 0.1, 0.0]]).double()))
    assert 0.17 < held.pos[0].norm() < 0.2
    outwards = held.pos[0] / held.pos[0].norm()
    assert abs(held.vel[0] @ outwards) < 30.0 * 0.2 * np.sin(np.pi / 24) + 1e-9  # a facet's normal is not the radius


def test_from_outside_grains_come_in():
    guard = Guard(scenes.scene(1, 5, boundary=BOX))
    state = replace(simulators.state_in_box([1]), pos=torch.tensor([[0.0, 0.0, 0.25]]).double())
    after = step(state, torch.tensor([[0.0, 0.0, -0.1]]).double())
    assert guard(state, after) is after


def test_an_edge_between_two_facets_is_no_gap():
    """Straight at edges and corners of the mesh, from the middle."""
    scene = scenes.scene(1, 5, boundary=HOURGLASS)
    guard = Guard(scene)
    corners = guard.parts[0].corners.flatten(0, 1)
    middles = (guard.parts[0].corners + guard.parts[0].corners.roll(1, 1)).flatten(0, 1) / 2
    targets = torch.cat([corners, middles])
    state = simulators.state_in_box([len(targets)], half_m=0.001)
    state = replace(state, pos=targets * torch.tensor([0.0, 0.0, 0.9]) + targets * torch.tensor([0.3, 0.3, 0.0]))
    state = replace(state, time_s=torch.zeros(1, dtype=torch.float64))
    held = guard(state, step(state, 2.0 * (targets - state.pos)))
    assert not outside(held.pos[None].numpy(), np.zeros(1), scene).any()


def test_absent_grains_pass():
    guard, state = Guard(scenes.scene(1, 5, boundary=BOX)), simulators.state_in_box([2])
    state = replace(state, active=torch.tensor([True, False]))
    held = guard(state, step(state, torch.full_like(state.pos, 1.0)))
    assert held.pos[0].abs().max() < 0.2
    assert held.pos[1].abs().max() > 0.5


def test_gradients_pass_the_guard():
    guard, state = Guard(scenes.scene(1, 5, boundary=BOX)), simulators.state_in_box([5])
    way = torch.full_like(state.pos, 0.5).requires_grad_()
    held = guard(state, step(state, way))
    (held.pos.sum() + held.vel.sum()).backward()
    assert torch.isfinite(way.grad).all()
    assert way.grad.abs().sum() > 0


@pytest.mark.parametrize("state_kind", ["full", "differences"])
def test_the_simulator_s_grains_stay_inside_whatever_its_networks_say(state_kind):
    scene = scenes.scene(60, 5, boundary=DRUM)
    model = simulators.simulator(scene, state=state_kind)
    model.correction = lambda state: (
        50.0
        * torch.randn(
            len(state.pos), len(model.scale), generator=torch.Generator().manual_seed(int(state.time_s[0] * 1e6))
        )
    )
    state = simulators.state_in_box([60], spin=state_kind == "full")
    for _ in range(20):
        before, state = state, model(state)
        assert not outside(state.pos[None].numpy(), state.time_s.numpy(), scene).any()
    assert model.guard.crossings > 20
    if state_kind == "differences":
        torch.testing.assert_close(state.vel, (state.pos - before.pos) / scene.frame_dt_s)


def test_a_floor_of_slivers_stops_grains_too():
    floor = {"kind": "floor", "size_m": [0.2, 1e-5]}
    guard = Guard(scenes.scene(1, 5, boundary={"floor": {"shape": floor, "points": 10, "friction_angle_rad": 0.5}}))
    state = replace(simulators.state_in_box([1]), pos=torch.tensor([[0.05, 0.0, 0.01]]).double())
    assert guard(state, step(state, torch.tensor([[0.0, 0.0, -0.1]]).double())).pos[0, 2] > 0
