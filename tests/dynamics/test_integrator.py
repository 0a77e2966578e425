"""Free flight, and the target as the exact inverse of the step."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gns_pyg.dynamics.integrator import STATES, Integrator
from gns_pyg.errors import ConfigError
from gns_pyg.scene.free_flight import cundall, free_flight
from tests import scenes
from tests.simulators import state_in_box


@pytest.mark.parametrize("free_flight", [True, False])
@pytest.mark.parametrize("kind", STATES)
def test_target_is_the_inverse_of_integrate(kind, free_flight):
    integrator = Integrator(scenes.scene(50, 5, damping=0.2), kind, free_flight=free_flight)
    state = state_in_box([30, 20], spin=kind == "full")
    correction = torch.randn(50, 3 * integrator.n_groups, dtype=torch.float64)
    following = integrator.integrate(state, correction)
    assert torch.allclose(integrator.target(state, following), correction, atol=1e-10)
    assert torch.allclose(following.time_s, state.time_s + 0.01)


def test_differences_follow_the_paper_s_equation_11():
    integrator = Integrator(scenes.scene(10, 5), "differences", free_flight=False)
    state, velocity = state_in_box([10], spin=False), torch.randn(10, 3, dtype=torch.float64)
    following = integrator.integrate(state, velocity)
    assert torch.allclose(following.pos, state.pos + velocity * 0.01)
    assert torch.allclose(following.vel, velocity)


@given(v0=st.floats(-3, 3), dt=st.floats(1e-4, 0.2), damping=st.floats(0, 0.9))
def test_free_flight_equals_fine_time_stepping(v0, dt, damping):
    scene = scenes.scene(1, 5, damping=damping)
    pos, vel = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[0.3, 0.0, v0]], dtype=torch.float64)
    end_pos, end_vel = free_flight(pos, vel, scene, dt)
    n, z, v = 2000, 0.0, v0
    for _ in range(n):  # what Yade does: leap-frog with a damped force
        a = -9.81 * (1 - damping * (1 if -9.81 * (v - 9.81 * dt / n / 2) >= 0 else -1))
        v += a * dt / n
        z += v * dt / n
    assert end_vel[0, 2].item() == pytest.approx(v, abs=0.05 * dt + 1e-6)
    assert end_pos[0, 2].item() == pytest.approx(z, abs=0.05 * dt**2 + 2e-5)
    assert torch.allclose(end_pos[0, :2], torch.tensor([0.3 * dt, 0.0], dtype=torch.float64))


def test_every_graph_has_its_own_damping():
    integrator = Integrator(scenes.scene(1, 5, damping=0.9), "full", free_flight=True)
    state = replace(state_in_box([3, 2]), vel=torch.zeros(5, 3, dtype=torch.float64))
    parameters = torch.tensor([[1000.0, 1e6, 0.25, 0.5, damping] for damping in (0.0, 0.4)], dtype=torch.float64)
    fallen = integrator.without_contact(replace(state, parameters=parameters)).vel[:, 2]
    assert fallen.tolist() == pytest.approx([-0.0981] * 3 + [-0.6 * 0.0981] * 2)


def test_damping_that_spares_gravity_leaves_plain_ballistics():
    scene = replace(scenes.scene(1, 5, damping=0.5), damping_on_gravity=False)
    pos, vel = free_flight(torch.zeros(1, 3, dtype=torch.float64), torch.ones(1, 3, dtype=torch.float64), scene, 0.1)
    assert vel[0, 2].item() == pytest.approx(1 - 0.981)
    assert pos[0, 2].item() == pytest.approx(0.1 - 0.5 * 9.81 * 0.01)


def test_unknown_state_is_refused():
    with pytest.raises(ConfigError, match="differences or velocity or full"):
        Integrator(scenes.scene(1, 5), "momentum", free_flight=True)


@given(vel=st.floats(-3, 3), gained=st.floats(-3, 3), damping=st.floats(0, 0.9))
def test_damping_of_a_steady_force_is_the_dem_s_law_in_small_steps(vel, gained, damping):
    """Yade's law for a component of the force: less by a share where it speeds up, more where it slows down."""
    now, steps = vel, 4000
    for _ in range(steps):
        now += gained / steps * (1 - damping * np.sign(gained * (now + gained / steps / 2)))
    v, g = (torch.full((1, 3), x, dtype=torch.float64) for x in (vel, gained))
    damped = v + g + cundall(v, g, torch.full((1, 1), damping, dtype=torch.float64))
    np.testing.assert_allclose(damped, now, atol=2e-3)


def test_damping_of_gravity_is_that_of_free_flight():
    scene, state = scenes.scene(40, 5, damping=0.2), state_in_box([40])
    gained = torch.tensor([[0.0, 0.0, -9.81]]).double().expand(40, 3) * 0.01
    end = free_flight(state.pos, state.vel, scene, 0.01)[1]
    damped = state.vel + gained + cundall(state.vel, gained, torch.full((40, 1), 0.2).double())
    assert torch.allclose(end, damped, atol=1e-14)
