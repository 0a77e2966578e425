"""Trivial predictors and climatology on runs whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.evaluation.baselines import best_trivial, climatology, trivial_errors
from tests import scenes

BALLISTIC = "instantaneous velocity, free flight"
BY_DIFFERENCE = "last displacement + free-flight acceleration"


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_ballistic_predictors_are_exact_in_free_flight(tmp_path, damping):
    scene = scenes.free_flight_case(tmp_path / "flight.h5", damping=damping, rising=False)
    errors = trivial_errors(Trajectory(tmp_path / "flight.h5"), scene)
    for name in (BALLISTIC, BY_DIFFERENCE):
        assert errors[name].shape == (19,)
        np.testing.assert_allclose(errors[name], 0.0, atol=1e-7)
    np.testing.assert_allclose(errors["last displacement repeated"], 9.81 * (1 - damping) * 0.01**2, rtol=1e-3)
    assert best_trivial([errors])[0] in (BALLISTIC, BY_DIFFERENCE)


def test_damped_flight_is_exact_through_the_turning_point(tmp_path):
    scene = scenes.free_flight_case(tmp_path / "flight.h5", damping=0.3, rising=True)
    errors = trivial_errors(Trajectory(tmp_path / "flight.h5"), scene)
    np.testing.assert_allclose(errors[BALLISTIC], 0.0, atol=1e-7)


def test_frozen_is_the_displacement(tmp_path):
    scene = scenes.free_flight_case(tmp_path / "flight.h5")
    case = Trajectory(tmp_path / "flight.h5")
    moved = np.linalg.norm(np.diff(case.read("position"), axis=0), axis=2).mean(axis=1)
    np.testing.assert_allclose(trivial_errors(case, scene)["frozen"], moved[1:])


def test_best_trivial_is_chosen_over_all_cases():
    cases = [{"a": np.array([1.0, 1.0]), "b": np.array([0.0, 0.0])}, {"a": np.array([1.0]), "b": np.array([4.0])}]
    assert best_trivial(cases) == ("a", 1.0)


def test_climatology_of_identical_cases_is_the_case(tmp_path):
    for name in "ab":
        scene = scenes.heap_case(tmp_path / f"{name}.h5", "plane", angle_deg=25.0)
    training = [Trajectory(tmp_path / f"{name}.h5") for name in "ab"]
    expected = climatology(training, scene)
    truth = expected.center_of_mass_m
    assert expected.center_of_mass_error_m(training[0].times_s, truth) == 0.0
    assert expected.mean_angle_of_repose_deg(scene) == pytest.approx(25.0, abs=0.5)


def test_the_expected_angle_ends_where_the_roll_out_does(tmp_path):
    scene = scenes.heap_case(tmp_path / "a.h5", "plane", angle_deg=25.0)
    expected = climatology([Trajectory(tmp_path / "a.h5")], scene)
    flatter_later = np.where(expected.times_s > expected.times_s[2], 10.0, 30.0)
    longer = replace(expected, angle_of_repose_deg=flatter_later)
    from_start = replace(scene, angle_of_repose=replace(scene.angle_of_repose, from_s=0.0))
    assert longer.mean_angle_of_repose_deg(from_start, expected.times_s[2]) == pytest.approx(30.0)
    assert longer.mean_angle_of_repose_deg(from_start) < 30.0


def test_climatology_is_the_mean_and_is_held_past_its_end(tmp_path):
    for seed in (0, 1):
        scene = scenes.free_flight_case(tmp_path / f"{seed}.h5", seed=seed)
    cases = [Trajectory(tmp_path / f"{seed}.h5") for seed in (0, 1)]
    expected = climatology(cases, scene)
    curves = [case.read("position").mean(axis=1) for case in cases]
    np.testing.assert_allclose(expected.center_of_mass_m, np.mean(curves, axis=0), atol=1e-12)
    np.testing.assert_allclose(expected.center_of_mass_at(np.array([9.0]))[0], expected.center_of_mass_m[-1])
    assert expected.angle_of_repose_deg is None
    assert np.isnan(expected.mean_angle_of_repose_deg(scene))
