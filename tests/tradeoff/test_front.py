"""From rows to answers."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gns_pyg.errors import ConfigError
from gns_pyg.tradeoff.front import (
    best_network,
    break_even,
    choose,
    equivalent_yade,
    error,
    front,
    seconds,
    within_scatter,
)
from tests.tradeoff.samples import row, seeds, yade

FEW = st.sampled_from([0.1, 0.2, 0.5, 1.0, 2.0])
ROWS = st.lists(st.tuples(FEW, FEW, FEW), min_size=1, max_size=12)


def goals(found):
    return (seconds(found), error(found, "center_of_mass_error_m"), error(found, "angle_of_repose_error_deg"))


@given(ROWS)
def test_the_front_is_what_nobody_beats(values):
    rows = [row(str(number), *each) for number, each in enumerate(values)]
    names = {found["name"] for found in front(rows)}
    assert names
    for one in rows:
        beaten = any(
            goals(other) != goals(one) and all(a <= b for a, b in zip(goals(other), goals(one), strict=True))
            for other in rows
        )
        assert (one["name"] in names) == (not beaten)


def test_failed_untimed_and_yardstick_rows_are_on_no_front():
    rows = [row("a", 1.0), row("failed", 0.1, error="it broke"), row("untimed", None), seeds(0.0, 0.0)]
    assert [found["name"] for found in front(rows)] == ["a"]


def test_the_equivalent_step_is_the_last_before_the_first_that_leaves_the_scatter():
    rows = [seeds(), yade(1e-5, 20, 0.01), yade(1e-4, 2, 0.015), yade(2e-4, 1, 0.03), yade(4e-4, 0.5, 0.01)]
    assert equivalent_yade(rows)["dt_s"] == 1e-4
    rows[2]["error"] = "Yade ended with status 1"
    assert equivalent_yade(rows)["dt_s"] == 1e-5
    assert equivalent_yade(rows[1:]) is None  # without other seeds nobody knows the scatter


def test_within_scatter_asks_all_observables():
    assert within_scatter(row("a", 1, 0.02, 2.0), [seeds()])
    assert not within_scatter(row("a", 1, 0.02, 2.1), [seeds()])


def test_the_scatter_is_the_largest_difference_between_two_seeds():
    other = seeds(0.02)
    other["axes"]["center_of_mass_error_m"]["most"] = 0.03
    assert within_scatter(row("a", 1, 0.03, 2.0), [other])
    assert not within_scatter(row("a", 1, 0.031, 2.0), [other])


def test_the_best_network_is_the_fastest_that_no_one_can_tell_from_dem():
    rows = [seeds(), yade(1e-4, 0.1, 0.005), row("fast", 0.2, 0.2, 9.0), row("b", 3.0, 0.019, 1.0), row("a", 2.0, 0.02)]
    assert best_network(rows)["name"] == "a"
    assert best_network(rows[:3]) is None


def test_break_even_counts_cases_and_training_against_what_a_roll_out_saves():
    rows, cost = [seeds(), yade(1e-4, 3.0, 0.01)], {"cases_s": 50.0, "simulated_s": 2.0}
    assert break_even(row("a", 1.0, training_cpu_s=150.0), rows, cost) == 50  # (50 + 150) / (2 * 2)
    assert break_even(row("a", 3.0, training_cpu_s=150.0), rows, cost) == math.inf
    assert break_even(row("a", 1.0), rows, cost) is None
    assert break_even(row("a", 1.0, training_cpu_s=150.0), rows[:1], cost) is None
    untimed = [seeds(), yade(1e-4, None, 0.01)]
    assert break_even(row("a", 1.0, training_cpu_s=150.0), untimed, cost) is None
    assert break_even(row("a", None, training_cpu_s=150.0), untimed, cost) is None


ROWS_TO_CHOOSE = [
    seeds(),
    yade(1e-4, 2.0, 0.005),
    row("fast", 0.2, 0.2, 9.0),
    row("good", 1.0, 0.03, 1.0),
    row("indistinguishable", 3.0, 0.019, 1.0),
]


@pytest.mark.parametrize(
    ("simulated_s", "max_seconds", "most", "name"),
    [
        (1.0, 0.5, {}, "fast"),
        (1.0, 1.5, {}, "good"),
        (2.0, 1.5, {}, "fast"),
        (1.0, 9.0, {}, "Yade, dt = 0.0001 s"),  # the faster of two that no one can tell from DEM
        (1.0, None, {"center_of_mass_error_m": 0.03}, "good"),
        (1.0, None, {"center_of_mass_error_m": 0.02}, "Yade, dt = 0.0001 s"),
        (1.0, None, {"center_of_mass_error_m": 1.0}, "fast"),
    ],
)
def test_the_choice(simulated_s, max_seconds, most, name):
    assert choose(ROWS_TO_CHOOSE, simulated_s, max_seconds, most)["name"] == name


def test_nothing_within_the_limits_is_nothing():
    assert choose(ROWS_TO_CHOOSE, 1.0, 0.01, {}) is None


def test_a_choice_without_limits_or_by_an_unknown_axis_is_refused():
    with pytest.raises(ConfigError, match="no limit"):
        choose(ROWS_TO_CHOOSE, 1.0, None, {})
    with pytest.raises(ConfigError, match="max_beauty"):
        choose(ROWS_TO_CHOOSE, 1.0, None, {"beauty": 1.0})
