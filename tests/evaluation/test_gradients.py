"""Gradients through unrolled steps: free flight, where they are known, and finite differences, where they are not."""

from dataclasses import replace

import pytest
import torch

from gns_pyg.errors import ConfigError, NumericalError
from gns_pyg.evaluation.gradients import gradient_norms
from tests import scenes
from tests.simulators import simulator, state_in_box

BOX = {"shape": {"kind": "box", "size_m": [0.15] * 3}, "points": 300, "friction_angle_rad": 0.5}


def test_in_free_flight_the_gradient_is_twice_the_final_position():
    model, state = simulator(scenes.scene(1, 5, boundary={})), state_in_box([1])
    norms, now = gradient_norms(model, state, [3, 0, 1]), state
    for count in range(4):
        if count in norms:
            assert norms[count] == pytest.approx(2 * now.pos.norm().item())
        now = model(now)
    assert list(norms) == [0, 1, 3]


def test_the_gradient_is_the_slope_of_the_unrolled_steps():
    """In the direction of the gradient itself, where the slope is its norm."""
    model, state = simulator(scenes.scene(8, 5, boundary={"walls": BOX}), dtype=torch.float64), state_in_box([8])
    leaf = state.pos.clone().requires_grad_()
    now = replace(state, pos=leaf)
    for _ in range(3):
        now = model(now)
    (gradient,) = torch.autograd.grad(now.pos.square().sum(), leaf)
    norm = gradient_norms(model, state, [3])[3]
    assert norm == pytest.approx(float(gradient.norm()))

    def final(shift_m: float) -> float:
        moved = replace(state, pos=state.pos + shift_m * gradient / gradient.norm())
        with torch.no_grad():
            for _ in range(3):
                moved = model(moved)
        return float(moved.pos.square().sum())

    assert (final(1e-8) - final(-1e-8)) / 2e-8 == pytest.approx(norm, rel=1e-4)


def test_what_has_no_gradient_is_refused():
    model, state = simulator(scenes.scene(4, 5, boundary={"walls": BOX})), state_in_box([4])
    with pytest.raises(ConfigError, match="counts"):
        gradient_norms(model, state, [-1])
    with torch.no_grad():
        next(model.grain_network.parameters()).fill_(torch.inf)
    crowd = replace(state, pos=0.1 * state.pos)
    with pytest.raises(NumericalError, match="(?s)step 1 of 2.*grain"):
        gradient_norms(model, crowd, [2])
