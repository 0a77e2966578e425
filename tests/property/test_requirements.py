"""Rows that claim to be exact: a model without what its scene does not need gives the same next state."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import scenes
from tests.simulators import IMPULSE, PAPER, simulator, state_in_box

SMALL_BOX = {"kind": "box", "size_m": [0.15, 0.15, 0.15], "center_m": [0.0, 0.0, 0.0]}
PART = {"shape": SMALL_BOX, "points": 300, "friction_angle_rad": 0.5}
OTHER = {"shape": {"kind": "floor", "size_m": [0.1, 0.1]}, "points": 60, "friction_angle_rad": 0.5}
TURNING = {"kind": "rotation", "axis": [1.0, 0.3, 0.0], "rate_rad_s": 3.0}
SHAKEN = {"kind": "oscillation", "axis": [0.0, 0.0, 1.0], "amplitude_m": 0.01, "frequency_hz": 8.0}
WALLS = {
    "still": {"walls": PART, "floor": OTHER},
    "moving": {"walls": PART | {"motion": TURNING}, "floor": OTHER | {"motion": SHAKEN}, "other": OTHER},
}
MODELS = {"contact": {}, "differences": {"state": "differences"}, "paper": PAPER, "impulse": IMPULSE}
OUTLET = {"point_m": [0.0, 0.0, -9.0], "normal": [0.0, 0.0, -1.0]}

states = given(st.integers(0, 10**6), st.lists(st.integers(0, 25), min_size=1, max_size=3))
few = settings(max_examples=8, deadline=None)


def same_step(one, other, seed, sizes, **changes):
    """Both models take a random state to the same next one, to 1e-10 of the largest displacement and velocity."""
    state = replace(state_in_box(sizes, seed, half_m=0.08, spin=one.requires.state == "full"), **changes)
    after, again = one(state), other(state)
    for name in ("pos", "vel", "ang_vel"):
        was, a, b = (getattr(s, name) for s in (state, after, again))
        if a is not None:
            scale = (a - was).abs().max() if a.numel() else 0.0
            assert (a - b).abs().max() <= 1e-10 * scale if a.numel() else a.shape == b.shape


def pair(boundary, row, model, pruned=True):
    """The model as the scene requires it, and the one with `row` forced; with the same weights."""
    scene = scenes.scene(20, 5, boundary=boundary)
    forced = simulator(scene, dtype=torch.float64, **model, **{row: not pruned})
    own = simulator(scene, dtype=torch.float64, **model)
    return own, forced


@pytest.mark.parametrize("model", MODELS)
@few
@states
def test_no_wall(model, seed, sizes):
    own, forced = pair({}, "wall_network", MODELS[model], pruned=False)
    assert own.wall_network is None
    assert not any("wall" in name for name in own.state_dict())
    own.load_state_dict({name: value for name, value in forced.state_dict().items() if "wall" not in name})
    same_step(own, forced, seed, sizes)


@pytest.mark.parametrize("walls", WALLS)
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("row", ["static_walls", "reachable_points"])
@few
@states
def test_walls_built_once_and_only_where_grains_are(row, model, walls, seed, sizes):
    own, forced = pair(WALLS[walls], row, MODELS[model])
    own.load_state_dict(forced.state_dict())
    same_step(own, forced, seed, sizes)
    same_step(own, forced, seed + 1, sizes)  # with what the first step has built


@pytest.mark.parametrize("model", MODELS)
@few
@states
def test_no_wall_velocity_where_nothing_moves(model, seed, sizes):
    own, forced = pair(WALLS["still"], "wall_velocity", MODELS[model], pruned=False)
    weights, name = forced.state_dict(), "wall_network.encode_sender.0.weight"
    if name in weights:  # an impulse network has no more weights where walls move
        kept = [column for column in range(weights[name].shape[1]) if column not in (3, 4, 5)]  # normal, velocity, ...
        weights = weights | {name: weights[name][:, kept]}
    own.load_state_dict(weights)
    same_step(own, forced, seed, sizes)


@few
@states
def test_no_mask_where_nobody_leaves(seed, sizes):
    own, forced = pair(WALLS["still"], "active_mask", {}, pruned=False)
    own.load_state_dict(forced.state_dict())
    active = torch.ones(sum(sizes), dtype=torch.bool)
    state = state_in_box(sizes, seed, half_m=0.08)
    assert torch.equal(own(state).pos, forced(replace(state, active=active)).pos)


@few
@given(st.integers(0, 10**6), st.integers(0, 25), st.integers(0, 10))
def test_grains_that_left_are_as_if_never_there(seed, n, n_left):
    model = simulator(scenes.scene(n + n_left or 1, 5, boundary=WALLS["still"], outlet=OUTLET), dtype=torch.float64)
    state = state_in_box([n + n_left], seed, half_m=0.08)
    there = torch.randperm(n + n_left, generator=torch.Generator().manual_seed(seed)) < n
    after = model(replace(state, active=there))
    alone = model(replace(state.pick(there), active=torch.ones(n, dtype=torch.bool)))
    assert torch.equal(after.active, there)
    assert torch.allclose(after.pos[there], alone.pos, rtol=0, atol=1e-14)
    assert torch.equal(after.pos[~there], state.pos[~there])
    assert not after.vel[~there].any()


@few
@states
def test_free_grains_follow_the_law_exactly(seed, sizes):
    """Not exact against the DEM (docs/requirements.md), but what is left out gets exactly the free-flight law."""
    model = simulator(scenes.scene(20, 5, boundary=WALLS["still"]), dtype=torch.float64)
    state = state_in_box(sizes, seed, half_m=0.08)
    graph, free = model.graph(state), model.integrator.without_contact(state)
    alone = torch.ones(sum(sizes), dtype=torch.bool)
    alone[graph.grain_edges[1]] = False
    alone[graph.wall_edges[1]] = False
    after = model(state)
    assert torch.equal(after.pos[alone], free.pos[alone])
    assert torch.equal(after.vel[alone], free.vel[alone])
