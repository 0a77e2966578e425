"""A grain's mean motion as a part of the state: what it is, whom it reaches, that a step treats it like the rest."""

import itertools
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from gns_pyg import bundle
from gns_pyg.dynamics import memory
from gns_pyg.dynamics.captured import Captured
from gns_pyg.dynamics.execution import Execution
from gns_pyg.dynamics.places import elsewhere
from gns_pyg.dynamics.rollout import rollout
from gns_pyg.errors import ConfigError
from gns_pyg.state import Walls
from tests import scenes, simulators

WALLS = {"walls": {"shape": {"kind": "box", "size_m": [0.26] * 3, "center_m": [0.0] * 3}, "points": 600}}
WALLS["walls"]["friction_angle_rad"] = 0.5
STEPS, DT_S = 8, 0.01


def model(frames: int = STEPS, **changes):
    """One that looks at what grains remember."""
    scene = scenes.scene(40, 5, boundary=WALLS)
    network = simulators.simulator(scene, dtype=torch.float64, memory=frames, **(simulators.IMPULSE | changes))
    generator = torch.Generator().manual_seed(1)
    for name, weights in network.named_parameters():
        if ".from_drift." in name:
            weights.data.copy_(torch.randn(weights.shape, generator=generator, dtype=weights.dtype))
    return network


def slow_state(n: int = 40):
    """Grains that creep, each its own way, but for the first ten, which fly."""
    state = simulators.state_in_box([n])
    drift = 0.02 * torch.randn(n, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    drift[:10] = 1.0
    return replace(state, drift=drift)


def test_what_moves_evenly_has_its_velocity_as_drift() -> None:
    vel = torch.tensor([[0.1, -0.2, 0.3], [0.0, 0.0, 0.0]], dtype=torch.float64)
    pos = torch.arange(25, dtype=torch.float64)[:, None, None] * DT_S * vel
    torch.testing.assert_close(memory.recorded(pos, float(STEPS), DT_S), vel)
    torch.testing.assert_close(memory.recorded(pos[:2], 1.0, DT_S), vel)


def test_what_is_read_is_what_steps_would_have_remembered() -> None:
    """The mean over recorded frames, and step by step from rest; they differ by what lies before the record."""
    generator = torch.Generator().manual_seed(0)
    pos = 1e-3 * torch.randn(60, 5, 3, generator=generator, dtype=torch.float64).cumsum(0)
    state = replace(simulators.state_in_box([5]), drift=torch.zeros(5, 3, dtype=torch.float64))
    nothing = torch.zeros(5, dtype=torch.float64)
    for one, two in itertools.pairwise(pos):
        after = memory.remembered(replace(state, pos=one), replace(state, pos=two), STEPS, DT_S, nothing)
        state = replace(state, drift=after.drift)
    scale = pos.diff(dim=0).std() / DT_S
    assert ((memory.recorded(pos, float(STEPS), DT_S) - state.drift).abs() < 2e-3 * scale).all()
    short = memory.recorded(pos[-1 - memory.FRAMES * STEPS :], float(STEPS), DT_S)
    assert ((short - state.drift).abs() < 0.1 * scale).all()


def test_what_stands_forgets_and_who_enters_remembers_its_velocity() -> None:
    state = slow_state()
    state = replace(state, drift=1e-5 * state.drift, active=torch.arange(40) >= 5)
    entered = replace(state, active=torch.ones(40, dtype=torch.bool))
    after = memory.remembered(state, entered, STEPS, DT_S, torch.full((40,), 1e-3, dtype=torch.float64))
    torch.testing.assert_close(after.drift[:5], state.vel[:5])
    assert not after.drift[5:].any()


def test_fast_grains_go_as_without_a_memory_and_slow_ones_do_not() -> None:
    network = model()
    plain = simulators.simulator(network.scene, dtype=torch.float64, **simulators.IMPULSE)
    plain.load_state_dict({k: v for k, v in network.state_dict().items() if ".from_drift." not in k})
    state = slow_state()
    fast, blind = replace(state, drift=10 * state.vel), model()
    for name, weight in blind.named_parameters():
        if ".from_drift." in name:
            torch.nn.init.zeros_(weight)
    assert torch.equal(network.correction(fast), blind.correction(fast))
    torch.testing.assert_close(network.correction(fast), plain.correction(fast), rtol=0, atol=1e-13)  # other widths
    assert (network.correction(state) - plain.correction(state)).abs().max() > 1e-3
    assert network(state).drift is not None
    assert plain(replace(state, drift=None)).drift is None


def test_a_state_made_by_hand_remembers_its_velocity() -> None:
    network, state = model(), slow_state()
    said, unsaid = network(replace(state, drift=state.vel)), network(replace(state, drift=None))
    assert torch.equal(said.pos, unsaid.pos)
    assert torch.equal(said.drift, unsaid.drift)


def test_a_captured_step_and_tiles_give_the_same() -> None:
    network, state = model(), slow_state()
    captured, tiled = Captured(network), model()
    tiled.execution = Execution(tile_grains=7)
    begun = replace(state, drift=None)
    with torch.inference_mode():
        for before in (begun, network(begun), network(network(begun))):
            expected = network(before)
            for found in (captured(before), tiled(before)):
                for field in ("pos", "vel", "ang_vel", "drift"):
                    torch.testing.assert_close(getattr(found, field), getattr(expected, field), rtol=0, atol=1e-10)


def test_a_heap_at_rest_is_at_rest() -> None:
    """Every grain held where it is: what it remembers dies out, and the state becomes the same for good."""
    network, state = model(), slow_state()
    state = replace(state, pos=state.pos[:1].repeat(40, 1), vel=torch.zeros_like(state.vel), drift=state.drift * 0.1)
    state = replace(state, pos=state.pos + 0.03 * torch.arange(40, dtype=torch.float64)[:, None], ang_vel=0 * state.vel)
    network.advance = lambda state, correction: replace(state, time_s=state.time_s + DT_S)
    states = list(rollout(network, state, 200, settles=True))
    assert not states[-1].drift.any()
    assert states[10].drift.any()


def test_a_bundle_keeps_it(tmp_path) -> None:
    network, state = model(), slow_state()
    loaded = bundle.load(bundle.save(tmp_path / "bundle", network, {})).double()
    assert loaded.config.memory == STEPS
    torch.testing.assert_close(loaded.correction(state), network.correction(state), rtol=0, atol=1e-6)


def test_memory_needs_impulses_and_walls_that_stand() -> None:
    with pytest.raises(ConfigError, match=r"model\.memory(.|\n)*message"):
        simulators.simulator(scenes.scene(40, 5), memory=STEPS)
    moving = {"walls": WALLS["walls"] | {"motion": {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 3.0}}}
    with pytest.raises(ConfigError, match=r"model\.memory(.|\n)*move"):
        simulators.simulator(scenes.scene(40, 5, boundary=moving), memory=STEPS, **simulators.IMPULSE)


def test_turned_it_turns_with_the_rest() -> None:
    network, state = model(), slow_state()
    q = torch.from_numpy(Rotation.from_euler("xyz", [17, 63, -115], degrees=True).as_matrix())
    graph = network.graph(state)
    assert graph.walls is not None
    w = graph.walls
    other = replace(graph, walls=Walls(w.pos @ q.T, w.normal @ q.T, w.vel @ q.T, w.friction_angle))
    network.scene.gravity_m_s2 = [0.0, 0.0, 0.0]
    vectors = {name: getattr(state, name) @ q.T for name in ("pos", "vel", "ang_vel", "drift")}
    expected = network.effects(state, graph).view(-1, 3, 3) @ q.T
    torch.testing.assert_close(network.effects(replace(state, **vectors), other).view(-1, 3, 3), expected)


def test_in_other_units_it_is_the_same_motion() -> None:
    network, state = model(), slow_state()
    with elsewhere(network, state, length=10.0, time=10.0**0.5) as (other, there):
        torch.testing.assert_close(other(there).drift / 10.0**0.5, network(state).drift, rtol=0, atol=1e-8)
