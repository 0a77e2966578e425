"""Who can touch something within the frame, on pairs whose answer is known; and who passes outlet and inlet."""

from dataclasses import replace

import pytest
import torch

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import read_window
from gns_pyg.errors import ConfigError
from gns_pyg.state import State
from tests import scenes
from tests.simulators import simulator

RADIUS = scenes.RADIUS_M
FLOOR = {"kind": "floor", "size_m": [0.2, 0.2]}


def state(pos, vel):
    pos, vel = (torch.tensor(values, dtype=torch.float64) for values in (pos, vel))
    n = len(pos)
    return State(
        pos=pos,
        vel=vel,
        ang_vel=torch.zeros_like(pos),
        radius=torch.full((n,), RADIUS, dtype=torch.float64),
        time_s=torch.zeros(1, dtype=torch.float64),
        batch=torch.zeros(n, dtype=torch.long),
    )


def in_networks(model, at):
    graph = model.graph(at)
    there = torch.zeros(len(at.pos), dtype=torch.bool)
    there[graph.grain_edges[1]] = True
    there[graph.wall_edges[1]] = True
    return there.tolist()


@pytest.mark.parametrize(
    ("gap", "approach", "touches"),
    [
        (0.0, 0.0, True),
        (-1e-3, -1.0, True),  # overlapping, flying apart
        (0.5 * RADIUS, 0.0, False),
        (0.5 * RADIUS, 0.3, False),  # closes 3 mm of 5 in a frame; the margin is 1 mm
        (0.5 * RADIUS, 0.45, True),
        (0.5 * RADIUS, -0.45, False),
    ],
)
@pytest.mark.parametrize("self_loops", [False, True])
def test_two_grains(gap, approach, touches, self_loops):
    model = simulator(scenes.scene(2, 5, boundary={}), self_loops=self_loops)
    distance = 2 * RADIUS + gap
    at = state([[0, 0, 0], [distance, 0, 0]], [[approach / 2, 0, 0], [-approach / 2, 0, 0]])
    assert in_networks(model, at) == [touches] * 2


@pytest.mark.parametrize(
    ("motion", "height", "touches"),
    [
        ({}, 1.05 * RADIUS, True),
        ({}, 1.5 * RADIUS, False),
        ({"kind": "translation", "axis": [0, 0, 1], "speed_m_s": 0.5}, 1.5 * RADIUS, True),
        ({"kind": "translation", "axis": [0, 0, 1], "speed_m_s": -0.5}, 1.5 * RADIUS, False),
        # at rest now, 5 mm higher at the end of the frame
        ({"kind": "translation", "axis": [0, 0, 1], "function": "0.005 * (t / 0.01)**2"}, 1.5 * RADIUS, True),
    ],
)
def test_a_grain_over_a_floor(motion, height, touches):
    part = {"shape": FLOOR, "points": 400, "friction_angle_rad": 0.5, "motion": motion}
    model = simulator(scenes.scene(1, 5, boundary={"floor": part}, gravity_m_s2=[0.0, 0.0, 0.0]))
    assert in_networks(model, state([[0.003, 0.001, height]], [[0.0, 0.0, 0.0]])) == [touches]


def test_a_grain_that_is_pushed_counts_with_its_neighbour():
    model = simulator(scenes.scene(3, 5, boundary={}))
    at = state([[0, 0, 0], [2 * RADIUS, 0, 0], [0, 2.4 * RADIUS, 0]], [[0, 0, 0]] * 3)
    assert in_networks(model, at) == [True, True, False]


def test_pairs_that_cannot_touch_exchange_nothing():
    """A chain of touching grains over a floor, and one that flies towards its end."""
    part = {"shape": FLOOR, "points": 400, "friction_angle_rad": 0.5}
    changes = {"touching_pairs": True, "cutoff_grain_radii": 3.0}
    scene = scenes.scene(4, 5, boundary={"floor": part}, gravity_m_s2=[0.0, 0.0, 0.0])
    row = [[0, 0, 1.04 * RADIUS], [2 * RADIUS, 0, 1.2 * RADIUS], [4.04 * RADIUS, 0, 1.2 * RADIUS]]
    at = state([*row, [3.2 * RADIUS, 2.5 * RADIUS, 1.2 * RADIUS]], [[0, 0, 0]] * 3 + [[0.5, -0.6, 0]])
    for network in ("message", "impulse"):
        graph = simulator(scene, network=network, **changes).graph(at)
        pairs = {tuple(sorted(pair)) for pair in graph.grain_edges.T.tolist()}
        assert pairs == {(0, 1), (1, 2), (2, 3)}  # and not (1, 3), also within the cutoff, which do not meet
        assert set(graph.wall_edges[1].tolist()) == {0}


def test_loops_are_no_touching_pairs():
    with pytest.raises(ConfigError, match="model.self_loops"):
        simulator(scenes.scene(2, 5, boundary={}), self_loops=True, touching_pairs=True)


def test_passing_grains_step_by_step(tmp_path):
    """Nothing touches: a step from any recorded frame gives the next one, who left and who entered included."""
    scene = scenes.passing_case(tmp_path / "case.h5")
    case, model = Trajectory(tmp_path / "case.h5"), simulator(scene, dtype=torch.float64)
    for frame in range(1, case.n_frames - 1):
        window = read_window(case, frame - 1, 3)
        before, expected = (model.integrator.read(window, k) for k in (1, 2))
        after = model(before)
        assert torch.equal(after.active, expected.active)
        assert torch.allclose(after.pos, expected.pos, atol=1e-7)
        assert torch.allclose(after.vel, expected.vel, atol=1e-7)
    left = replace(before, active=torch.zeros_like(before.active))
    assert torch.equal(model(left).pos, left.pos)
