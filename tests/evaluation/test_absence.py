"""Scenes that grains leave and enter: who is absent counts nowhere."""

import numpy as np
import pytest

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import NumericalError
from gns_pyg.evaluation import contacts, observables
from gns_pyg.evaluation.baselines import Climatology, climatology, trivial_errors
from gns_pyg.evaluation.errors import position_error, positions, present
from gns_pyg.evaluation.metrics import case_result, evaluate_cases
from gns_pyg.evaluation.predict import one_step_errors, roll_out, write_rollout
from gns_pyg.scene.containment import outside
from tests import scenes
from tests.simulators import simulator

START = 5
HOPPER = {"kind": "revolution", "profile_m": [[0.02, 0.0], [0.1, 0.1], [0.1, 0.2]], "open_bottom": True}


@pytest.fixture
def passing(tmp_path):
    scene = scenes.passing_case(tmp_path / "passing.h5")
    return scene, Trajectory(tmp_path / "passing.h5")


def with_absent(pos, n=3):
    """The same grains, and `n` that are absent between them."""
    absent = np.full((len(pos), n, 3), np.nan)
    return np.concatenate([pos[:, :2], absent, pos[:, 2:]], axis=1)


def result(case, scene, pos):
    return case_result(case, scene, pos, START, np.full(case.n_frames - 2, 1e-3), 2, seconds_per_simulated_second=1.0)


def test_positions_are_nan_where_a_grain_is_absent(passing):
    case = passing[1]
    np.testing.assert_array_equal(present(positions(case)), case.active())
    assert case.active().all(axis=1).sum() == 0
    assert case.active()[0].sum() == 8


def test_position_error_is_taken_over_grains_in_both():
    pos_a, pos_b = np.zeros((2, 3, 3)), np.zeros((2, 3, 3))
    pos_a[0, 0, 0], pos_a[0, 1, 0], pos_a[0, 2, 0] = 1.0, 2.0, 4.0
    pos_a[0, 1], pos_b[0, 2], pos_a[1] = np.nan, np.nan, np.nan
    np.testing.assert_array_equal(position_error(pos_a, pos_b), [1.0, np.nan])


@pytest.mark.parametrize("kind", ["plane", "radial"])
def test_observables_are_those_of_the_grains_present(tmp_path, kind):
    scene = scenes.heap_case(tmp_path / "heap.h5", kind, angle_deg=25.0, n_frames=3)
    case = Trajectory(tmp_path / "heap.h5")
    pos = case.read("position") + np.linspace(0, 1e-3, 3)[:, None, None] * np.arange(case.n_grains)[:, None] / 100
    mass, radius = (np.concatenate([values[:2], values[:3], values[2:]]) for values in (case.mass, case.radius))
    more, times = with_absent(pos), case.times_s
    for ours, theirs in (
        (observables.center_of_mass(more, mass), observables.center_of_mass(pos, case.mass)),
        (observables.angle_of_repose(more, scene), observables.angle_of_repose(pos, scene)),
        (contacts.mean_overlap_ratio(more, radius), contacts.mean_overlap_ratio(pos, case.radius)),
        (observables.mean_speed(more, times), observables.mean_speed(pos, times)),
        (
            observables.granular_temperature(more, times, radius),
            observables.granular_temperature(pos, times, case.radius),
        ),
        (observables.escaped_grains(more, times, scene), observables.escaped_grains(pos, times, scene)),
        (position_error(more, more[:1]), position_error(pos, pos[:1])),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("kind", ["plane", "radial"])
def test_a_scene_that_has_run_empty_has_no_means(tmp_path, kind):
    scene = scenes.heap_case(tmp_path / "heap.h5", kind, angle_deg=25.0)
    pos, times, ones = np.full((2, 4, 3), np.nan), np.array([0.0, 0.1]), np.ones(4)
    assert np.isnan(observables.center_of_mass(pos, ones)).all()
    assert np.isnan(observables.angle_of_repose(pos, scene)).all()
    assert np.isnan(observables.mean_speed(pos, times)).all()
    assert np.isnan(observables.granular_temperature(pos, times, ones)).all()
    assert np.isnan(observables.outflow(pos)).all()
    np.testing.assert_array_equal(contacts.mean_overlap_ratio(pos, ones), 0.0)
    np.testing.assert_array_equal(observables.escaped_grains(pos, times, scene), 0)


def test_a_grain_that_enters_or_leaves_has_no_speed_in_that_step():
    pos = np.zeros((3, 2, 3))
    pos[:, 0, 0] = [0.0, 0.1, 0.3]
    pos[0, 1], pos[2, 1] = np.nan, np.nan
    np.testing.assert_allclose(observables.mean_speed(pos, np.array([0.0, 0.1, 0.2])), [1.0, 2.0])


def test_outflow_counts_those_who_were_there_at_the_start():
    pos = np.zeros((3, 5, 3))
    pos[1:, 0], pos[2, 1] = np.nan, np.nan  # they leave
    pos[:2, 4] = np.nan  # it enters
    np.testing.assert_allclose(observables.outflow(pos), [0.0, 0.25, 0.5])


def test_climatology_of_the_outflow_starts_anew_where_the_roll_out_does():
    known = Climatology(np.arange(3.0), np.zeros((3, 3)), None, np.array([0.0, 0.2, 0.6]))
    np.testing.assert_allclose(known.outflow_at(np.array([1.0, 2.0])), [0.0, 0.5])
    read = Climatology.from_plain({"times_s": [0.0], "center_of_mass_m": [[0.0] * 3], "angle_of_repose_deg": None})
    assert np.isnan(read.outflow_at(np.zeros(2))).all()


def test_trivial_predictors_see_those_who_stay(passing):
    errors = trivial_errors(passing[1], passing[0])
    assert all(np.isfinite(error).all() for error in errors.values())
    np.testing.assert_allclose(errors["instantaneous velocity, free flight"], 0.0, atol=1e-8)
    np.testing.assert_allclose(errors["last displacement + free-flight acceleration"], 0.0, atol=1e-8)


def test_an_untrained_model_is_exact_where_nothing_touches(passing, tmp_path):
    """Who leaves, who enters and when is exact too, in memory as in the file."""
    scene, case = passing
    model = simulator(scene, radius_features=True)
    pos, _ = roll_out(model, case, START)
    np.testing.assert_array_equal(present(pos), case.active(START))
    np.testing.assert_allclose(pos, positions(case, START), atol=1e-7)
    np.testing.assert_allclose(one_step_errors(model, case), 0.0, atol=1e-8)
    write_rollout(model, case, START, tmp_path / "rollout.h5")
    written = Trajectory(tmp_path / "rollout.h5")
    np.testing.assert_allclose(positions(written), pos, atol=1e-6)
    metrics = evaluate_cases([result(case, scene, pos)], climatology([case], scene), scene).metrics
    assert metrics["test/outflow_final"] == metrics["test/outflow_dem_final"] == pytest.approx(5 / 8, abs=0.2)
    assert metrics["test/outflow_error_max"] == 0
    assert metrics["test/outflow_error_climatology_max"] == pytest.approx(0.0, abs=1e-12)
    assert metrics["test/escaped_grains"] == 0
    assert metrics["test/rollout_error_final_m"] < 1e-7


def test_a_model_that_holds_grains_back_has_an_outflow_error(passing):
    scene, case = passing
    dem = positions(case, START)
    held = np.where(np.isnan(dem), dem[0], dem)
    metrics = evaluate_cases([result(case, scene, held)], climatology([case], scene), scene).metrics
    assert metrics["test/outflow_final"] == 0
    assert metrics["test/outflow_error_max"] == metrics["test/outflow_dem_final"] > 0


def test_a_position_that_is_no_number_is_still_refused(passing):
    scene, case = passing
    pos = positions(case, START)
    result(case, scene, pos)
    for value in ([np.nan, 0.0, 0.0], [np.inf] * 3):
        broken = pos.copy()
        broken[4, 0] = value
        with pytest.raises(NumericalError, match=f"frame {START + 4}"):
            result(case, scene, broken)


def test_a_grain_below_an_open_bottom_has_not_escaped():
    hopper = scenes.scene(4, 11, boundary={"hopper": {"shape": HOPPER, "points": 10, "friction_angle_rad": 0.5}})
    pos = np.array([[[0.0, 0.0, 0.1], [0.0, 0.0, -0.05], [0.2, 0.0, 0.1], [0.0, 0.0, 0.3]]])
    np.testing.assert_array_equal(outside(pos, np.zeros(1), hopper), [[False, False, True, True]])
