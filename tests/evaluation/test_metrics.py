"""The metrics of whole cases: perfect, frozen and broken roll-outs."""

import json

import numpy as np
import pytest

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import DataError, NumericalError
from gns_pyg.evaluation.baselines import climatology
from gns_pyg.evaluation.metrics import case_result, evaluate_cases, write_json
from tests import scenes

START = 10


def heap(tmp_path):
    scene = scenes.heap_case(tmp_path / "heap.h5", "plane", angle_deg=25.0, n_frames=21)
    return scene, Trajectory(tmp_path / "heap.h5")


def flight(tmp_path):
    scene = scenes.free_flight_case(tmp_path / "flight.h5")
    return scene, Trajectory(tmp_path / "flight.h5")


def result(case, scene, pos, first_frame=1):
    one_step = np.linspace(1e-3, 2e-3, case.n_frames - first_frame)
    return case_result(case, scene, pos, START, one_step, first_frame, seconds_per_simulated_second=2.0)


def test_perfect_roll_out(tmp_path):
    scene, case = heap(tmp_path)
    perfect = result(case, scene, case.read("position", START))
    metrics = evaluate_cases([perfect, perfect], climatology([case], scene), scene).metrics
    for key in (
        "test/rollout_error_final_m",
        "test/center_of_mass_error_max_m",
        "test/center_of_mass_error_climatology_max_m",
        "test/angle_of_repose_error_deg",
        "test/angle_of_repose_error_climatology_deg",
        "test/escaped_grains",
    ):
        assert metrics[key] == 0, key
    assert metrics["test/angle_of_repose_deg"] == pytest.approx(25.0, abs=0.5)
    assert metrics["test/mean_overlap_ratio"] == metrics["test/mean_overlap_ratio_dem"]
    assert metrics["speed/seconds_per_simulated_second"] == 2.0
    assert metrics["speed/yade_seconds_per_simulated_second"] == pytest.approx(12.0 / 0.2)
    assert (metrics["speed/yade_cores"], metrics["speed/yade_dt_s"]) == (1, 1e-4)


def test_frozen_roll_out_has_the_frozen_error(tmp_path):
    scene, case = flight(tmp_path)
    dem = case.read("position", START)
    frozen = result(case, scene, np.repeat(dem[:1], len(dem), axis=0))
    metrics = evaluate_cases([frozen], climatology([case], scene), scene).metrics
    moved = np.linalg.norm(dem[-1] - dem[0], axis=1).mean()
    assert metrics["test/rollout_error_final_m"] == metrics["test/rollout_error_final_frozen_m"]
    assert metrics["test/rollout_error_final_m"] == pytest.approx(moved)
    assert metrics["test/center_of_mass_error_max_m"] == metrics["test/center_of_mass_error_frozen_max_m"]
    assert not any("angle_of_repose" in key for key in metrics)


def test_one_step_errors_are_compared_at_the_same_frames(tmp_path):
    """Predictions of frame 1 have no trivial counterpart and are left out; the start is the roll-out's."""
    scene, case = flight(tmp_path)
    one = result(case, scene, case.read("position", START), first_frame=1)
    assert len(one.one_step_error_m) == len(one.trivial_error_m["frozen"]) == case.n_frames - 2
    np.testing.assert_allclose(one.one_step_times_s, case.times_s[2:])
    metrics = evaluate_cases([one], climatology([case], scene), scene).metrics
    errors = np.linspace(1e-3, 2e-3, case.n_frames - 1)
    assert metrics["test/one_step_error_at_start_m"] == pytest.approx(errors[START])  # of frame START + 1
    assert metrics["test/one_step_error_m"] == pytest.approx(errors[1:].mean())
    assert metrics["test/one_step_error_trivial_m"] < 1e-6
    assert "free" in metrics["test/one_step_error_trivial_name"]


def test_escapes_are_summed_over_cases(tmp_path):
    scene, case = flight(tmp_path)
    pos = case.read("position", START)
    pos[3:, :2, 2] = -100.0
    lost = result(case, scene, pos)
    evaluation = evaluate_cases([lost, lost], climatology([case], scene), scene)
    assert evaluation.metrics["test/escaped_grains"] == 4
    assert [entry["test/escaped_grains"] for entry in evaluation.per_case] == [2, 2]
    assert evaluation.per_case[0]["case"] == "flight"


def test_unfit_or_broken_roll_outs_are_refused(tmp_path):
    scene, case = flight(tmp_path)
    pos = case.read("position", START)
    with pytest.raises(DataError, match="roll-out"):
        result(case, scene, pos[:, :-1])
    with pytest.raises(DataError, match="roll-out"):
        result(case, scene, np.repeat(pos, 2, axis=0))
    pos[4, 2, 1] = np.nan
    with pytest.raises(NumericalError, match="frame 14"):
        result(case, scene, pos)
    with pytest.raises(DataError, match="test cases"):
        evaluate_cases([], climatology([case], scene), scene)


def test_json_is_strict(tmp_path):
    path = tmp_path / "deep" / "metrics.json"
    write_json(path, {"nan": float("nan"), "list": [np.float64(np.inf), np.int64(3)], "array": np.zeros(2), "n": None})
    text = path.read_text()

    def refuse(constant):
        raise AssertionError(constant)

    read = json.loads(text, parse_constant=refuse)
    assert read == {"nan": None, "list": [None, 3], "array": [0.0, 0.0], "n": None}
    assert [entry.name for entry in path.parent.iterdir()] == ["metrics.json"]
