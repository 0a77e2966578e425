"""The plan of an inlet: as many as asked, in time, in the rectangle, and never one into the other."""

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gns_pyg.errors import ConfigError
from gns_pyg.scene.inlet import entries
from gns_pyg.scene.scene import Scene
from tests import scenes

INLET: dict[str, Any] = {
    "count": 40,
    "rate_per_s": 200.0,
    "center_m": [0.1, -0.2, 1.0],
    "size_m": [0.1, 0.07],
    "velocity_m_s": [0.0, 0.0, -2.0],
}


def scene(count: int = 50, frame_dt_s: float = 0.01, seed: int = 0, **inlet) -> Scene:
    return scenes.scene(count, 11, frame_dt_s, seed=seed, inlet=INLET | inlet)


def test_grains_enter_at_the_rate_inside_the_rectangle_with_the_velocity_asked_for() -> None:
    plan = entries(scene())
    assert plan.time_s == pytest.approx(np.arange(1, 41) / 200)
    assert (np.abs(plan.pos - INLET["center_m"]) <= [0.05 - scenes.RADIUS_M, 0.035 - scenes.RADIUS_M, 0]).all()
    assert (plan.vel == INLET["velocity_m_s"]).all()


def test_the_seed_fixes_the_plan_and_another_one_changes_it() -> None:
    assert (entries(scene()).pos == entries(scene()).pos).all()
    assert (entries(scene()).pos != entries(scene(seed=1)).pos).any()


def test_without_an_inlet_nothing_enters() -> None:
    plan = entries(scenes.scene(3, 2))
    assert (plan.time_s.shape, plan.pos.shape, plan.vel.shape) == ((0,), (0, 3), (0, 3))


@settings(max_examples=60, deadline=None)
@given(
    rate=st.floats(1, 5000),
    speed=st.floats(0.05, 10),
    size=st.tuples(st.floats(0.02, 0.2), st.floats(0.02, 0.2)),
    frame_dt_s=st.floats(0.001, 0.03),
    seed=st.integers(0, 100),
)
def test_no_grain_enters_where_an_earlier_one_still_is(rate, speed, size, frame_dt_s, seed) -> None:
    values = {"rate_per_s": rate, "size_m": list(size), "velocity_m_s": [0.0, 0.0, -speed]}
    try:
        plan = entries(scene(frame_dt_s=frame_dt_s, seed=seed, **values))
    except ConfigError:
        assume(False)
    frame = np.ceil(plan.time_s / frame_dt_s - 1e-9)  # a grain is there from the first frame at or after its time
    for k in range(1, len(plan.pos)):
        flown = (frame[k] - frame[:k])[:, None] * frame_dt_s * plan.vel[:k]
        assert np.linalg.norm(plan.pos[:k] + flown - plan.pos[k], axis=1).min() >= 2 * scenes.RADIUS_M - 1e-9


@pytest.mark.parametrize(
    ("changes", "key", "told"),
    [
        ({"rate_per_s": 1e6}, "rate_per_s", "at most"),
        ({"velocity_m_s": [0.0, 0.0, 0.0]}, "rate_per_s", "at most"),
        ({"size_m": [0.1, 0.02]}, "size_m", "room for one grain"),
    ],
)
def test_what_cannot_enter_is_refused(changes, key, told) -> None:
    with pytest.raises(ConfigError, match=rf"^scene\.inlet\.{key}\n[\s\S]*{told}"):
        entries(scene(**changes))


def test_the_highest_rate_that_the_error_names_is_possible() -> None:
    with pytest.raises(ConfigError) as caught:
        entries(scene(rate_per_s=1e6))
    entries(scene(rate_per_s=0.999 * float(caught.value.expected.split()[2])))
