"""Functions of time: arithmetic alone, the same in Yade and torch, and one clear error for everything else."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_pyg.errors import ConfigError
from gns_pyg.scene.motion import way
from gns_pyg.scene.scene import Motion, Scene
from gns_pyg.scene.travel import LONGEST, travel
from tests import scenes


def moving(function: str, kind: str = "translation") -> Motion:
    return Motion(kind=kind, axis=[1.0, 0.0, 0.0], function=function)


def scene_with(function: str) -> Scene:
    part = {"shape": scenes.BOX, "points": 10, "friction_angle_rad": 0.5}
    motion = {"kind": "translation", "axis": [1, 0, 0], "function": function}
    return scenes.scene(1, 101, boundary={"box": part | {"motion": motion}})  # 1 s


@pytest.mark.parametrize(
    "function",
    [
        "__import__('os').system('x')",
        "().__class__",
        "t.real",
        "t[0]",
        "[t][0]",
        "f'{t}'",
        "'t'",
        "lambda: t",
        "(t := 1)",
        "t if t else 1",
        "t and 1",
        "t > 0",
        "t // 1",
        "t % 1",
        "~t",
        "min(t, 1)",
        "sin(t, t)",
        "sin(*t)",
        "sin(x=t)",
        "sin",
        "x",
        "1j * t",
        "None",
        "t; t",
        "t = 1",
        "import os",
        "t\0",
        "²",
        "",
        "(",
        "t" * 10_000,
        "(" * 10_000 + "t" + ")" * 10_000,
        "-" * 10_000 + "t",
        "(" * 150 + "t",
        "[" * LONGEST,
    ],
)
def test_what_is_no_arithmetic_in_t_is_refused_with_one_error(function) -> None:
    with pytest.raises(ConfigError, match=r"^scene\.boundary\.box\.motion\.function\n[\s\S]*arithmetic") as caught:
        scene_with(function)
    assert len(str(caught.value)) < 500
    assert caught.value.__cause__ is None


@pytest.mark.parametrize(
    "function",
    [
        "10**10**10",
        "1e400 * t - 1e400 * t",
        "1e308 * 10 * t",
        "exp(1000) * t",
        "sqrt(-1) * t",
        "1 / t",
        "1 / 0 * t",
        "t / sin(t)",
        "1 + t",
        "cos(t)",
        "(t - 1)**0.5 - (-1)**0.5",  # complex
        "sqrt(t)",  # infinitely fast at t = 0
        "exp(1000 * t) - 1",  # from here on all is well at t = 0
        "1 / (t - 0.5) + 2",
        "sqrt(0.5 - t) - sqrt(0.5)",
        "tan(t * pi)",
    ],
)
def test_a_function_that_is_not_0_at_the_start_or_not_finite_in_the_run_is_refused(function) -> None:
    with pytest.raises(ConfigError, match=r"^scene\.boundary\.box\.motion\.function\n"):
        scene_with(function)


@pytest.mark.parametrize(
    ("function", "value"),
    [
        ("t", 0.5),
        (" t ", 0.5),
        ("0", 0.0),
        ("-" * 150 + "t", 0.5),
        ("(" * 99 + "t" + ")" * 99, 0.5),
        ("pi * t", math.pi / 2),
        ("0.5 * t**2", 0.125),
        ("2 * (sin(t + 1) - sin(1))", 2 * (math.sin(1.5) - math.sin(1))),
        ("exp(-t) - 1 + tanh(t) * cos(0) / sqrt(4)", math.exp(-0.5) - 1 + math.tanh(0.5) / 2),
    ],
)
def test_arithmetic_gives_its_value_everywhere(function, value) -> None:
    motion = scene_with(function).boundary["box"].motion
    assert travel(motion, 0.5, math) == pytest.approx(value)
    assert way(motion, torch.tensor([0.5, 0.5], dtype=torch.float64))[0].tolist() == pytest.approx([value] * 2)


def terms() -> st.SearchStrategy[str]:
    leaf = st.sampled_from(["t", "pi", "0.7", "2"])

    def larger(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
        call = st.builds("{}({})".format, st.sampled_from(["sin", "cos", "tanh"]), inner)
        power = st.builds("{}**{}".format, call, st.integers(0, 4))
        return st.one_of(call, power, st.builds("({} {} {})".format, inner, st.sampled_from("+-*"), inner))

    return st.recursive(leaf, larger, max_leaves=8)


@settings(max_examples=100, deadline=None)
@given(terms(), st.floats(0.1, 2.0))
def test_yade_and_torch_read_a_function_alike_and_the_speed_is_its_derivative(function, t) -> None:
    motion, h = moving(function), 1e-4
    here, before, after = (travel(motion, time_s, math) for time_s in (t, t - h, t + h))
    come, speed = (value.item() for value in way(motion, torch.tensor([t], dtype=torch.float64)))
    assert come == pytest.approx(here, rel=1e-12, abs=1e-12)
    assert speed == pytest.approx((after - before) / (2 * h), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        ({"kind": "oscillation", "amplitude_m": 0.1, "frequency_hz": 1.0}, "function"),
        ({"kind": "none"}, "function"),
        ({"kind": "rotation", "rate_rad_s": 1.0}, "function"),
        ({"kind": "translation", "speed_m_s": 1.0}, "function"),
    ],
)
def test_a_function_stands_in_for_a_constant_rate_only(changes, where) -> None:
    with pytest.raises(ConfigError, match=rf"^here\.{where}\n"):
        Motion(**({"axis": [1.0, 0.0, 0.0], "function": "t"} | changes)).check("here")
