"""Twins stored with the data, the horizon read from them, ensembles, and models finer than the recorded frames."""

import json

import numpy as np
import pytest

from gns_pyg.data.datamodule import open_to_compare
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import ConfigError, DataError
from gns_pyg.evaluation.baselines import climatology
from gns_pyg.evaluation.ensemble import SHIFT_M, Ensemble, roll_out_ensemble
from gns_pyg.evaluation.errors import positions
from gns_pyg.evaluation.metrics import case_result, evaluate_cases
from gns_pyg.evaluation.predict import one_step_errors, roll_out, write_rollout
from gns_pyg.evaluation.twins import Twins, horizon, read_twins, twins_path
from tests import scenes
from tests.simulators import simulator

TIMES = np.array([0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize(("error", "seconds"), [([0, 1, 2, 4], 0.2), ([0, 3, 1, 1], 0.1), ([0, 1, 1, 1], 0.3)])
def test_the_horizon_ends_at_half_of_the_twins_late_distance(error, seconds):
    twins = Twins(np.array([0.0, 1.0, 2.0, 4.0]), np.zeros(4))
    assert horizon(np.array(error, float), TIMES, twins) == pytest.approx(seconds)


def falling(folder, n_frames=40):
    scene = scenes.free_flight_case(folder / "case_000.h5", n_frames=n_frames)
    return scene, Trajectory(folder / "case_000.h5")


def stored(case, **changes):
    values = {"times_s": [0.1, 0.3], "mean_distance_m": [0.0, 2e-3], "std_distance_m": [0.0, 1e-3]} | changes
    twins_path(case.path).write_text(json.dumps({"content_hash": case.content_hash()} | values))


def test_twins_are_read_between_their_frames_and_only_from_the_same_start(tmp_path):
    case = falling(tmp_path)[1]
    assert read_twins(case, TIMES) is None
    stored(case)
    np.testing.assert_allclose(read_twins(case, TIMES).mean_m, [0.0, 1e-3, 2e-3, 2e-3])
    assert read_twins(case, TIMES + 0.1) is None
    stored(case, times_s="soon")
    with pytest.raises(DataError, match=r"data_gen\.twins"):
        read_twins(case, TIMES)


def test_metrics_set_a_roll_out_beside_its_twins(tmp_path):
    scene, case = falling(tmp_path, 120)
    times_s, pos = case.times_s[10:], positions(case, 10)
    stored(
        case,
        times_s=times_s.tolist(),
        mean_distance_m=np.linspace(0, 2e-3, 110).tolist(),
        std_distance_m=[0.0] * 110,
        center_of_mass_max_m=[1e-4, 3e-4],
        angle_of_repose_deg=[None, None],
    )
    moved = pos + np.array([1e-3, 0, 0]) * np.linspace(0, 1, 110)[:, None, None]
    result = case_result(case, scene, moved, 10, np.zeros(118), 2, 1.0)
    metrics = evaluate_cases([result], climatology([case], scene), scene).metrics
    assert metrics["test/rollout_error_final_twin_m"] == pytest.approx(2e-3)
    assert metrics["test/rollout_error_over_twin"] == pytest.approx(0.5)
    assert metrics["test/center_of_mass_error_twin_max_m"] == pytest.approx(2e-4)
    assert "test/angle_of_repose_error_twin_deg" not in metrics
    assert metrics["test/horizon_s"] == pytest.approx(times_s[-1] - times_s[0])
    assert metrics["test/horizon_twin_s"] == pytest.approx((times_s[-1] - times_s[0]) / 2, abs=0.011)


def test_the_score_of_equal_members_is_their_absolute_error():
    members = {"speed": np.tile([1.0, 2.0, np.nan], (4, 1))}
    ensemble = Ensemble(TIMES[:3], members, {"speed": np.array([1.5, 2.0, 3.0])}, np.zeros((4, 3)), 0, 1.0)
    assert ensemble.crps() == {"speed": pytest.approx(0.25)}


def test_members_of_free_grains_stay_a_micrometre_apart(tmp_path):
    scene, case = falling(tmp_path)
    ensemble = roll_out_ensemble(simulator(scene), case, 10, 8)
    distance = ensemble.error_m
    np.testing.assert_allclose(distance, np.tile(distance[:, :1], (1, 30)), rtol=1e-3)
    assert distance.mean() == pytest.approx(SHIFT_M * np.sqrt(8 / np.pi), rel=0.3)  # mean length of such a shift
    assert len(np.unique(distance[:, 0])) == 8
    assert ensemble.plain()["members"] == 8


class TestStepsBetweenFrames:
    """Frames 10 ms apart, steps of 2.5 ms; free fall, which every step size solves exactly without damping."""

    @pytest.fixture
    def finer(self, tmp_path):
        from dataclasses import replace

        scene, case = falling(tmp_path)
        return case, simulator(replace(scene, frame_dt_s=scene.frame_dt_s / 4))

    def test_roll_outs_and_single_steps_meet_the_frames(self, finer, tmp_path):
        case, model = finer
        np.testing.assert_allclose(one_step_errors(model, case), 0.0, atol=1e-7)
        np.testing.assert_allclose(roll_out(model, case, 5)[0], positions(case, 5), atol=1e-7)
        write_rollout(model, case, 5, tmp_path / "rollout.h5")
        written = Trajectory(tmp_path / "rollout.h5")
        np.testing.assert_allclose(written.times_s, case.times_s[5:], atol=1e-12)
        assert written.scene["frame_dt_s"] == pytest.approx(case.frame_dt_s)
        assert written.run["steps"] == 4 * (case.n_frames - 6)

    def test_cases_are_opened_at_what_both_reach(self, finer):
        case, model = finer
        assert open_to_compare(case.path, model.scene).n_frames == case.n_frames
        rare = open_to_compare(case.path, model.scene, 2 * case.frame_dt_s)
        assert rare.frame_dt_s == pytest.approx(2 * case.frame_dt_s)
        with pytest.raises(ConfigError, match="whole number"):
            open_to_compare(case.path, model.scene, 0.4 * case.frame_dt_s)
        with pytest.raises(ConfigError, match="compare_every_s"):
            open_to_compare(case.path, model.scene, -1.0)

    def test_a_state_of_differences_needs_every_frame(self, finer):
        case, model = finer
        differences = simulator(model.scene, state="differences")
        with pytest.raises(ConfigError, match="differences"):
            roll_out(differences, case, 5)


def test_the_same_run_recorded_otherwise_has_the_same_start(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    one, two = falling(tmp_path / "a", 40)[1], falling(tmp_path / "b", 20)[1]
    assert one.content_hash() != two.content_hash()
    np.testing.assert_allclose(one.start(), two.start(), atol=1e-9)
