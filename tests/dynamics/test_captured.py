"""The step in tensors of fixed size: the same step, no overflow unseen, nothing that a CUDA graph could not hold."""

from dataclasses import replace

import pytest
import torch

from gns_pyg.dynamics.captured import Captured
from tests import scenes, simulators
from tests.graph.test_neighbors import Capturable

NARROW = {"kind": "box", "size_m": [0.26, 0.26, 0.26], "center_m": [0.0, 0.0, 0.0]}
STILL = {"shape": NARROW, "points": 600, "friction_angle_rad": 0.5}
MOTION = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 3.0}
DRUM = {"shape": {"kind": "cylinder", "radius_m": 0.13, "length_m": 0.26}, "points": 600, "friction_angle_rad": 0.4}
SCENES = {
    "no boundary": {"boundary": {}},
    "still box": {"boundary": {"walls": STILL}},
    "drum": {"boundary": {"drum": DRUM | {"motion": MOTION}}},
    "drum and box": {"boundary": {"drum": DRUM | {"motion": MOTION}, "walls": STILL}},
    "outlet": {"boundary": {"walls": STILL}, "outlet": {"point_m": [0.0, 0.0, -0.05], "normal": [0.0, 0.0, -1.0]}},
}


def model_and_state(scene: str, n_per_graph: list[int], **changes):
    values = SCENES[scene]
    model = simulators.simulator(scenes.scene(sum(n_per_graph[:1]), 5, **values), dtype=torch.float64, **changes)
    state = simulators.state_in_box(n_per_graph, half_m=0.1, spin=model.requires.state == "full")
    if model.requires.active_mask:
        there = torch.rand(len(state.pos), generator=torch.Generator().manual_seed(0)) < 0.7
        state = replace(state, active=there)
    return model, state


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("n_per_graph", [[90], [60, 60]])
def test_the_step_is_the_simulator_s(scene, n_per_graph) -> None:
    model, state = model_and_state(scene, n_per_graph)
    same_step(model, state)


@pytest.mark.parametrize(
    "changes",
    [
        simulators.PAPER,
        simulators.IMPULSE,
        simulators.TOUCHING,
        {"touching_pairs": True},
        {"nearest_points": True},
        {"self_loops": True},
        {"free_grains": False},
        {"state": "velocity"},
        {"layers": 1},
    ],
)
def test_the_step_is_the_simulator_s_whatever_the_model(changes) -> None:
    same_step(*model_and_state("drum and box", [80], **changes))


@pytest.mark.parametrize("changes", [{}, simulators.IMPULSE, {"nearest_points": True}])
def test_two_radii(changes) -> None:
    grains = scenes.scene(80, 5).grains
    parts = {"boundary": {"walls": STILL}, "grains": {"count": 80, "radius_m": [0.01, 0.015], "share": [0.5, 0.5]}}
    parts["grains"]["material"] = vars(grains.material)
    model = simulators.simulator(scenes.scene(80, 5, **parts), dtype=torch.float64, **changes)
    state = simulators.state_in_box([80], half_m=0.1)
    state = replace(state, radius=torch.where(torch.arange(80) < 40, 0.01, 0.015).double())
    same_step(model, state)


def same_step(model, state) -> None:
    captured = Captured(model)
    with torch.inference_mode():
        for _ in range(3):
            expected, found = model(state), captured(state)
            for field in ("pos", "vel", "ang_vel"):
                if getattr(expected, field) is not None:
                    torch.testing.assert_close(getattr(found, field), getattr(expected, field), rtol=0, atol=1e-10)
            assert torch.equal(found.time_s, expected.time_s)
            assert expected.active is None or torch.equal(found.active, expected.active)
            state = expected


def test_an_overflow_is_seen_and_the_step_done_again() -> None:
    model, state = model_and_state("drum and box", [90])
    captured = Captured(model)
    with torch.inference_mode():
        captured(state)
        fitted = list(captured.capacities)
        assert min(fitted[:4]) > 1
        captured(state)
        assert captured.capacities == fitted
        denser = replace(state, pos=state.pos * 0.6)
        assert (captured.step(denser)[1] > torch.tensor(fitted)).any()
        assert torch.allclose(captured(denser).pos, model(denser).pos, atol=1e-10)
        assert captured.capacities > fitted


@pytest.mark.parametrize(
    ("scene", "changes"),
    [("no boundary", {}), ("drum and box", {}), ("drum and box", {"nearest_points": True}), ("outlet", {})],
)
def test_a_cuda_graph_can_hold_the_step(scene, changes) -> None:
    model, state = model_and_state(scene, [90], **changes)
    for network in (model.grain_network, model.wall_network):
        if network is not None:
            network.sparse = False  # as on a GPU
    captured = Captured(model)
    with torch.inference_mode():
        captured(state)
        with Capturable():
            captured.step(state)


@pytest.mark.parametrize("scene", SCENES)
def test_the_step_needs_no_value_and_stays_on_its_device(scene) -> None:
    """The meta device has shapes only: an operation that reads a value or mixes devices fails there."""
    model, state = model_and_state(scene, [90])
    captured = Captured(model.to("meta"))
    captured.capacities = [300] * len(captured.capacities)
    with torch.inference_mode():
        after, needed = captured.step(state.to("meta"))
    assert after.pos.device.type == needed.device.type == "meta"
    assert after.pos.shape == state.pos.shape
