"""Figures, table and page of a small evaluation."""

import re

import numpy as np
import pytest

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import DataError
from gns_pyg.evaluation.baselines import climatology
from gns_pyg.evaluation.metrics import case_result, evaluate_cases
from gns_pyg.report.page import write_page
from gns_pyg.report.plots import draw, write_plots
from gns_pyg.report.table import metrics_table
from tests import scenes


def evaluate(path, scene, start=10):
    case = Trajectory(path)
    pos = case.read("position", start)
    pos += np.linspace(0, 1e-3, len(pos))[:, None, None]
    result = case_result(case, scene, pos, start, np.full(case.n_frames - 1, 5e-4), 1, seconds_per_simulated_second=2.0)
    return evaluate_cases([result, result], climatology([case], scene), scene)


@pytest.fixture(scope="module")
def heap(tmp_path_factory):
    path = tmp_path_factory.mktemp("heap") / "case_000.h5"
    scene = scenes.heap_case(path, "radial", angle_deg=25.0, n_frames=21)
    return scene, evaluate(path, scene)


@pytest.fixture(scope="module")
def figures(heap, tmp_path_factory):
    return write_plots(heap[1], heap[0], tmp_path_factory.mktemp("plots"))


def test_every_figure_is_written_as_png_and_svg(figures):
    names = {"rollout_error", "one_step_error", "center_of_mass", "angle_of_repose", "overlap", "mean_speed"}
    names |= {"granular_temperature", "snapshots"}
    assert {file.stem for file in figures} == names
    for file in figures:
        assert file.read_bytes().startswith(b"\x89PNG" if file.suffix == ".png" else b"<?xml"), file


def test_a_turning_scene_without_angle_of_repose(tmp_path):
    scene = scenes.rotating_box_case(tmp_path / "turning.h5", n_outside=1)
    evaluation = evaluate(tmp_path / "turning.h5", scene)
    figures = draw(evaluation, scene)
    assert "angle_of_repose" not in figures
    figures["snapshots"].savefig(tmp_path / "snapshots.png")
    assert "angle of repose" not in metrics_table(evaluation.metrics, "turning", {})


def test_table_states_human_units_beside_what_they_are_judged_by(heap):
    scene, evaluation = heap
    text = metrics_table(evaluation.metrics, f"{scene.name}: 2 test cases", {"run": "runs/1", "bundle": "b"})
    assert re.search(r"one-step error, whole run +0\.500 mm +0\.00 mm frozen \(best trivial", text)
    assert re.search(r"roll-out error, last frame +1\.73 mm +0\.00 mm frozen", text)
    assert re.search(r"angle of repose +2[45]\.\d° ± 0\.0° +25\.0° ± 0\.0° DEM", text)
    assert "2.00 s  60.0 s Yade (dt 100 µs, 1 core), network 30 times as fast" in text
    assert text.endswith("run: runs/1\nbundle: b")
    assert max(len(line) for line in text.splitlines()) <= 120


def test_table_shows_a_dash_for_what_is_not_known(heap):
    metrics = dict.fromkeys(heap[1].metrics, None) | {"test/one_step_error_m": float("nan")}
    text = metrics_table(metrics, "unknown", {})
    assert re.search(r"one-step error, whole run +- ", text)
    assert "None" not in text
    assert "nan" not in text


def test_page_is_self_contained(heap, figures, tmp_path):
    scene, evaluation = heap
    config = "name: <script>alert(1)</script>"
    path = write_page(tmp_path / "report.html", "A & B", evaluation.metrics, figures, scene, config, {"torch": "2.4"})
    text = path.read_text()
    assert not re.search(r"https?:|//[a-z]|<script|<link|@import|url\(", re.sub(r"base64,[^\"]+", "", text))
    assert set(re.findall(r'src="([^,]+),', text)) == {"data:image/png;base64"}
    assert text.count("<img") == len(figures) // 2
    assert "A &amp; B" in text
    assert "20 mm diameter" in text
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]


def test_page_names_a_missing_figure(heap, tmp_path):
    scene, evaluation = heap
    with pytest.raises(DataError, match=r"missing\.png"):
        write_page(tmp_path / "r.html", "t", evaluation.metrics, [tmp_path / "missing.png"], scene, "", {})
