"""A grain that stands stays, one that is free falls, and nothing that moves is held."""

from dataclasses import replace

import torch

from gns_pyg.dynamics.rest import rested
from gns_pyg.dynamics.rollout import rollout
from tests import scenes, simulators

TURNING = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 3.0}


def model_that_trembles(**changes):
    """Contacts hold every grain but for a velocity of 2 mm/s; g dt is 98 mm/s."""
    model = simulators.simulator(scenes.scene(8, 5, **changes))
    free = torch.tensor([[0.0, 0.0, 9.81 * 0.01 / 2], [0.0, 0.0, 9.81 * 0.01], [0.0, 0.0, 0.0]]).flatten()
    model.correction = lambda state: ((free + 0.002) / model.scale).expand(len(state.pos), -1)
    return model


def standing(n=8):
    state = simulators.state_in_box([n])
    return replace(state, vel=torch.zeros_like(state.vel), ang_vel=torch.zeros_like(state.vel))


def test_trembling_grains_stay_where_they_are():
    model, state = model_that_trembles(), standing()
    *_, last = rollout(model, state, 50)
    assert torch.equal(last.pos, state.pos)
    assert torch.equal(last.vel, state.vel)


def test_moving_grains_go_on():
    model, state = model_that_trembles(), standing()
    state = replace(state, vel=state.vel + 0.05)
    assert not torch.equal(model(state).pos, state.pos)


def test_nothing_rests_beside_a_wall_that_moves_or_without_gravity():
    box = {"shape": scenes.BOX, "points": 200, "friction_angle_rad": 0.5, "motion": TURNING}
    for changes in ({"boundary": {"walls": box}}, {"gravity_m_s2": [0.0, 0.0, 0.0]}):
        model, state = model_that_trembles(**changes), standing()
        assert not model.requires.rest
        assert not torch.equal(model(state).pos, state.pos)


def test_a_free_grain_falls_even_with_strong_damping():
    model = simulators.simulator(scenes.scene(8, 5, damping=0.9))
    model.correction = lambda state: torch.zeros(len(state.pos), len(model.scale))
    state = standing()
    assert (model(state).pos[:, 2] < state.pos[:, 2]).all()


def test_nothing_moves_nothing_is_recomputed():
    model, state, calls = model_that_trembles(), standing(), []

    def counted(state):
        calls.append(1)
        return model(state)

    states = list(rollout(counted, state, 30, settles=model.settles))
    assert len(calls) == 1
    assert torch.equal(states[-1].pos, state.pos)
    torch.testing.assert_close(states[-1].time_s, state.time_s + 30 * 0.01)


def test_a_grain_that_keeps_its_place_keeps_no_velocity():
    """As the shipped hopper's would: its networks are not quite of one mind about places and velocities."""
    state = standing()
    trembling = replace(state, vel=state.vel + 0.02)
    gained_m_s = torch.full((8,), 0.098, dtype=torch.float64)
    after = rested(trembling, replace(trembling, pos=state.pos + 1e-6), gained_m_s, 0.01)
    assert torch.equal(after.pos, state.pos)
    assert torch.equal(after.vel, state.vel)


def test_no_grain_in_free_flight_is_held_not_even_at_the_top():
    model = simulators.simulator(scenes.scene(8, 5))
    model.correction = lambda state: torch.zeros(len(state.pos), len(model.scale))
    state = standing(400)
    state.vel[:, 2] = torch.linspace(-0.2, 0.2, 400, dtype=torch.float64)
    after = model(state)
    held = (after.pos == state.pos).all(dim=1)
    assert model.requires.rest
    assert not held.any()
