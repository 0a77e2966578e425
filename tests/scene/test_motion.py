"""Rigid motion: velocities are derivatives of positions, the body frame is its inverse, shapes stay as they are."""

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_pyg.scene.motion import to_body, to_world, turn, way
from gns_pyg.scene.scene import Motion

numbers = st.floats(-3.0, 3.0)
FUNCTIONS = ["0.5 * t**2", "0.2 * sin(6.28 * t)", "tanh(t) / 3", "exp(-t) - 1", "0.1 * t * cos(3 * t)", "0"]


@st.composite
def motions(draw) -> dict[str, Any]:
    kind = draw(st.sampled_from(["none", "rotation", "translation", "oscillation"]))
    axis = draw(st.lists(numbers, min_size=3, max_size=3).filter(lambda a: math.hypot(*a) > 0.1))
    values: dict[str, Any] = {"axis": axis, "origin_m": draw(st.lists(numbers, min_size=3, max_size=3))}
    if kind == "oscillation":
        values |= {"amplitude_m": draw(numbers), "frequency_hz": draw(numbers)}
    elif kind != "none":
        function = draw(st.none() | st.sampled_from(FUNCTIONS))
        rate = "rate_rad_s" if kind == "rotation" else "speed_m_s"
        values |= {rate: draw(numbers)} if function is None else {"function": function}
    return values | {"kind": kind}  # not the record: type checks of the tests draw random items of lists


def moving(values: dict[str, Any]) -> Motion:
    motion = Motion(**values)
    motion.check("motion")
    return motion


def points(seed: int, n: int = 20) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    pos = torch.rand(n, 3, dtype=torch.float64, generator=generator) * 2 - 1
    return pos, torch.rand(n, dtype=torch.float64, generator=generator) * 2


@settings(max_examples=100, deadline=None)
@given(motions(), st.integers(0, 1000))
def test_a_wall_s_velocity_is_the_central_difference_of_its_position(values, seed) -> None:
    motion = moving(values)
    pos, time_s = points(seed)
    vel, h = to_world(motion, pos, time_s)[1], 1e-5
    difference = (to_world(motion, pos, time_s + h)[0] - to_world(motion, pos, time_s - h)[0]) / (2 * h)
    torch.testing.assert_close(vel, difference, rtol=1e-5, atol=1e-5)


@settings(max_examples=100, deadline=None)
@given(motions(), st.integers(0, 1000))
def test_to_body_inverts_to_world(values, seed) -> None:
    motion = moving(values)
    pos, time_s = points(seed)
    torch.testing.assert_close(to_body(motion, to_world(motion, pos, time_s)[0], time_s), pos, rtol=0, atol=1e-12)
    torch.testing.assert_close(to_world(motion, to_body(motion, pos, time_s), time_s)[0], pos, rtol=0, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(motions(), st.integers(0, 1000), st.floats(0, 2))
def test_a_part_stays_rigid_and_starts_in_its_body_frame(values, seed, t) -> None:
    motion, pos = moving(values), points(seed)[0]
    placed = to_world(motion, pos, torch.full((len(pos),), t, dtype=torch.float64))[0]
    torch.testing.assert_close(torch.cdist(placed, placed), torch.cdist(pos, pos), rtol=0, atol=1e-6)
    at_start = to_world(motion, pos, torch.zeros(len(pos), dtype=torch.float64))[0]
    torch.testing.assert_close(at_start, pos, rtol=0, atol=1e-12)
    axes = turn(motion, torch.eye(3, dtype=torch.float64), torch.full((3,), t, dtype=torch.float64))
    torch.testing.assert_close(axes @ axes.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert torch.linalg.det(axes) > 0


def test_a_quarter_turn_an_oscillation_and_a_way_known_by_hand() -> None:
    point, second = torch.tensor([[2.0, 0.0, 0.0]], dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    spin = Motion("rotation", [0.0, 0.0, 5.0], [1.0, 0.0, 0.0], rate_rad_s=math.pi / 2)
    shake = Motion("oscillation", [0.0, 2.0, 0.0], amplitude_m=0.1, frequency_hz=0.25)
    slide = Motion("translation", [3.0, 4.0, 0.0], function="5 * t**2")
    for motion, pos, vel in (
        (spin, [1.0, 1.0, 0.0], [-math.pi / 2, 0.0, 0.0]),
        (shake, [2.0, 0.1, 0.0], [0.0, 0.0, 0.0]),
        (slide, [5.0, 4.0, 0.0], [6.0, 8.0, 0.0]),
    ):
        placed = to_world(motion, point, second)
        assert placed[0][0].tolist() == pytest.approx(pos, abs=1e-12)
        assert placed[1][0].tolist() == pytest.approx(vel, abs=1e-12)


@pytest.mark.parametrize(
    ("function", "speed"),
    [
        ("(t - 1)**4 - 1", lambda t: 4 * (t - 1) ** 3),
        ("(t - 1)**5 + 1", lambda t: 5 * (t - 1) ** 4),
        ("(t - 2)**(-3) + 0.125", lambda t: -3 * (t - 2) ** -4),
        ("0.1 * cos(6 * t)**6 - 0.1", lambda t: -3.6 * torch.cos(6 * t) ** 5 * torch.sin(6 * t)),
        ("(1 + t)**0.5 - 1", lambda t: 0.5 * (1 + t) ** -0.5),
    ],
)
def test_the_speed_of_powers_is_exact(function, speed):
    """Of a negative base too, where a complex logarithm would leave 1e-16 over the tiny step."""
    time_s = torch.linspace(0.0, 1.5, 16, dtype=torch.float64)
    found = way(Motion(kind="translation", axis=[1.0, 0.0, 0.0], function=function), time_s)[1]
    assert torch.allclose(found, speed(time_s), rtol=1e-12, atol=1e-12)
