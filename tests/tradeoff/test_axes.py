"""Axes: one figure per case, less is better, nothing that a row does not tell."""

import pytest

from gns_pyg.tradeoff.axes import axes_of

CASE = {
    "test/center_of_mass_error_max_m": 0.01,
    "test/center_of_mass_error_climatology_max_m": 0.004,
    "test/granular_temperature_m2_s2": 0.02,
    "test/granular_temperature_m2_s2_dem": 0.01,
    "test/mean_overlap_ratio": 0.001,
    "test/mean_overlap_ratio_dem": 0.003,
    "test/one_step_error_m": None,
    "test/one_step_error_trivial_m": 0.0008,
    "test/escaped_grains": 2,
}
OTHER = CASE | {"test/center_of_mass_error_max_m": 0.03}


def test_mean_and_range_over_cases():
    axes = axes_of({"kind": "trained", "cases": [CASE, OTHER]})
    assert axes["center_of_mass_error_m"] == {
        "mean": pytest.approx(0.02),
        "least": 0.01,
        "most": 0.03,
        "cases": [0.01, 0.03],
    }
    assert axes["granular_temperature_error"]["mean"] == pytest.approx(1.0)
    assert axes["overlap_error"]["mean"] == pytest.approx(0.002)
    assert axes["escaped_grains"]["most"] == 2
    assert "one_step_error_m" not in axes
    assert "angle_of_repose_error_deg" not in axes


def test_climatology_and_the_trivial_step_tell_their_own_alone():
    assert axes_of({"kind": "climatology", "cases": [CASE]}).keys() == {"center_of_mass_error_m"}
    assert axes_of({"kind": "climatology", "cases": [CASE]})["center_of_mass_error_m"]["mean"] == 0.004
    assert axes_of({"kind": "trivial", "cases": [CASE]})["one_step_error_m"]["mean"] == 0.0008


def test_a_failed_row_tells_nothing():
    assert axes_of({"kind": "trained", "error": "it broke"}) == {}
