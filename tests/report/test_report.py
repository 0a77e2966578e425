"""Figures, table and page of a small evaluation."""

import dataclasses
import re

import numpy as np
import pytest
from PIL import Image

from gns_pyg.bundle import SHIPPED
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import BundleError, DataError
from gns_pyg.evaluation.baselines import climatology
from gns_pyg.evaluation.errors import positions
from gns_pyg.evaluation.metrics import case_result, evaluate_cases, write_json
from gns_pyg.evaluation.stress import Line
from gns_pyg.report.page import Model, read_stability, write_page
from gns_pyg.report.plots import draw, write_picture, write_plots
from gns_pyg.report.sections import scene_summary
from gns_pyg.report.table import metric_rows, text_table
from gns_pyg.report.verdict import Verdict
from gns_pyg.scene.requirements import Requires, resolve
from gns_pyg.scene.scene import Motion
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
    names |= {"granular_temperature", "speed_distribution", "snapshots"}
    assert {file.stem for file in figures} == names
    for file in figures:
        assert file.read_bytes().startswith(b"\x89PNG" if file.suffix == ".png" else b"<?xml"), file


def test_a_picture_for_the_repository_looks_the_same_in_half_the_bytes(heap, tmp_path):
    figure = draw(heap[1], heap[0])["snapshots"]
    figure.savefig(tmp_path / "all.png", dpi=90)
    write_picture(figure, tmp_path / "new" / "few.png", dpi=90)
    every, few = (Image.open(tmp_path / name).convert("RGB") for name in ("all.png", "new/few.png"))
    assert few.size == every.size
    assert np.abs(np.asarray(few, float) - np.asarray(every, float)).mean() < 2.0  # of 255
    assert (tmp_path / "new" / "few.png").stat().st_size < (tmp_path / "all.png").stat().st_size / 2


def test_a_turning_scene_without_angle_of_repose(tmp_path):
    scene = scenes.rotating_box_case(tmp_path / "turning.h5", n_outside=1)
    evaluation = evaluate(tmp_path / "turning.h5", scene)
    figures = draw(evaluation, scene)
    assert "angle_of_repose" not in figures
    figures["snapshots"].savefig(tmp_path / "snapshots.png")
    assert "angle of repose" not in text_table("turning", metric_rows(evaluation.metrics), {})


def test_a_scene_that_grains_pass_through_without_a_boundary(tmp_path):
    scene = scenes.passing_case(tmp_path / "passing.h5")
    case = Trajectory(tmp_path / "passing.h5")
    pos = positions(case, 1)
    pos[20:] = np.nan  # the model has run empty
    result = case_result(case, scene, pos, 1, np.full(case.n_frames - 2, 5e-4), 2, seconds_per_simulated_second=2.0)
    evaluation = evaluate_cases([result], climatology([case], scene), scene)
    files = write_plots(evaluation, scene, tmp_path / "plots")
    assert {"outflow", "snapshots"} <= {file.stem for file in files}
    text = text_table("passing", metric_rows(evaluation.metrics), {})
    assert re.search(r"grains that have left +100 % +\d+\.\d % DEM", text)
    assert re.search(r"outflow error, largest +\d+\.\d % +0\.00 % mean of training cases", text)
    assert scene_summary(scene)["grains"] == "5 of 20 mm, 5 of 10 mm diameter"
    assert {"outlet", "inlet"} <= set(scene_summary(scene))


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        ({}, "floor, 50 boundary points"),
        (
            {"kind": "oscillation", "axis": [1.0, 0.0, 0.0], "amplitude_m": 0.02, "frequency_hz": 3.0},
            "by 20 mm at 3 Hz",
        ),
        ({"kind": "translation", "axis": [0.0, 1.0, 0.0], "speed_m_s": 0.1}, "moving at 0.1 m/s"),
        ({"kind": "rotation", "axis": [0.0, 0.0, 1.0], "function": "0.5 * t**2"}, "turning by 0.5 * t**2 rad"),
    ],
)
def test_open_moving_parts_are_drawn_and_described(tmp_path, motion, words):
    scene = scenes.heap_case(tmp_path / "heap.h5", "radial", angle_deg=25.0, n_frames=21)
    part = scene.boundary["walls"]
    part.shape, part.points, part.motion = {"kind": "floor", "size_m": [0.4, 0.4]}, 50, Motion(**motion)
    draw(evaluate(tmp_path / "heap.h5", scene), scene)["snapshots"].savefig(tmp_path / "snapshots.png")
    assert words in scene_summary(scene)["boundary"]


def test_table_states_human_units_beside_what_they_are_judged_by(heap):
    scene, evaluation = heap
    text = text_table(f"{scene.name}: 2 test cases", metric_rows(evaluation.metrics), {"run": "runs/1", "bundle": "b"})
    assert re.search(r"one-step error, whole run +0\.500 mm +0\.00 mm frozen \(best trivial", text)
    assert re.search(r"roll-out error, last frame +1\.73 mm +0\.00 mm frozen", text)
    assert re.search(r"angle of repose +2[45]\.\d° ± 0\.0° +25\.0° ± 0\.0° DEM", text)
    assert "2.00 s  60.0 s Yade (dt 100 µs, 1 core), network 30 times as fast" in text
    assert text.endswith("run: runs/1\nbundle: b")
    assert max(len(line) for line in text.splitlines()) <= 120


def test_table_shows_a_dash_for_what_is_not_known(heap):
    metrics = dict.fromkeys(heap[1].metrics, None) | {"test/one_step_error_m": float("nan")}
    text = text_table("unknown", metric_rows(metrics), {})
    assert re.search(r"one-step error, whole run +- ", text)
    assert "None" not in text
    assert "nan" not in text


CARD = {"cases": {"train": {"case_000.h5": "a"}, "val": {}, "test": {}, "answers": {}}}


def page(heap, figures, path, card=CARD, stability=None, config="seed: 1", scene=None, **changes):
    scene, evaluation = scene or heap[0], heap[1]
    metrics = evaluation.metrics | {"speed/threads": 1, "speed/device": "a processor"} | changes
    model = Model("runs/1/bundle", resolve(scene, {}, Requires()), card, stability)
    shown, versions = evaluation.cases[0].result, {"torch": "2.4"}
    write_page(path / "report.html", "A & B", metrics, figures, shown, scene, model, config, versions)
    return (path / "report.html").read_text()


def words(text):
    """What a reader sees of a page."""
    return re.sub(r"\s+", " ", re.sub(r"<script.*?</script>|<style.*?</style>|<[^>]+>", " ", text, flags=re.DOTALL))


def test_page_is_self_contained(heap, figures, tmp_path):
    text = page(heap, figures, tmp_path, config="name: <script>alert(1)</script>")
    assert "<script>alert" not in text
    shell = re.sub(r"<script.*?</script>", "", re.sub(r"base64,[^\"]+", "", text), flags=re.DOTALL)
    assert not re.search(r"https?:|//[a-z]|<script|<link|@import|url\(", shell)
    assert "<script src" not in text
    assert set(re.findall(r'src="([^,]+),', text)) == {"data:image/png;base64"}
    assert text.count("<img") == len(figures) // 2
    assert text.count("</script>") == 4, "data, frames, three.js and the player, none of them cut short"
    assert "A &amp; B" in text
    assert "20 mm diameter" in text
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]


def test_page_says_what_the_scene_required_and_why(heap, tmp_path):
    text = words(page(heap, [], tmp_path))
    assert "wall velocity no no part moves: no wall-velocity feature" in text
    assert "trained on 1 case, 0 for validation" in text


@pytest.mark.parametrize(
    ("cost", "own", "verdict"),
    [
        ({"dem_s": 100.0, "training_s": 1000.0}, 2.0, r"after 95 roll-outs"),  # 1100 s over 58 s/s * 0.2 s
        ({"dem_s": 100.0, "training_s": None}, 2.0, "not known: costs not recorded in this bundle"),
        (None, 2.0, "not known: costs not recorded in this bundle"),
        ({"dem_s": 100.0, "training_s": 1000.0}, 90.0, "never: the network is slower than Yade here"),
        (None, 90.0, "never: the network is slower than Yade here"),
    ],
)
def test_page_says_when_the_network_has_paid_for_itself(heap, tmp_path, cost, own, verdict):
    card = CARD | ({} if cost is None else {"cost": cost})
    text = words(page(heap, [], tmp_path, card, **{"speed/seconds_per_simulated_second": own}))
    assert f"has paid for itself {verdict}" in text
    assert ("slower than Yade: 1.5 times its time" in text) == (own == 90.0)


def test_page_gives_the_papers_figures_and_says_where_they_do_not_compare(heap, tmp_path):
    assert "The paper" not in words(page(heap, [], tmp_path))
    full, small = (dataclasses.replace(heap[0], name=name) for name in ("hopper", "hopper_small"))
    assert "93.9 mm at 2 s" in words(page(heap, [], tmp_path, scene=full))
    assert "do not compare" not in words(page(heap, [], tmp_path, scene=full))
    assert "hopper_small is another scene: the figures do not compare" in words(page(heap, [], tmp_path, scene=small))


LINES = [
    Line("ten times the length", True, True, "0 escaped"),
    Line("twice the speed", True, False, "3 escaped"),
    Line("settled pile", True, None, "walls move"),
    Line("fewer bits", False, None, "0.1 mm"),
]


def test_page_states_the_stability_verdict_or_how_to_get_one(heap, tmp_path):
    assert "not run: python stress.py bundle=runs/1/bundle" in words(page(heap, [], tmp_path))
    text = words(page(heap, [], tmp_path, stability=Verdict("full", LINES)))
    assert "full form of stress.py" in text
    assert "ten times the length holds 0 escaped" in text
    assert "twice the speed FAILS 3 escaped" in text
    assert "settled pile no mark walls move" in text
    assert "fewer bits - 0.1 mm" in text


def test_stability_is_read_from_the_bundle_or_beside_it(tmp_path):
    bundle = tmp_path / "bundle"
    bundle.mkdir()
    assert read_stability(bundle) is None
    for place, lines in ((tmp_path, LINES[1:]), (bundle, LINES)):
        write_json(place / "stability.json", {"form": "full", "lines": [line.plain() for line in lines]})
        assert read_stability(bundle) == Verdict("full", lines)


ODD = '{"form": "full", "lines": [{"line": "a", "hard": true, "holds": 2, "found": "b"}]}'


@pytest.mark.parametrize(
    "content", ["[", "3", "[]", '{"lines": [3]}', '{"lines": [{"line": "a"}]}', '{"lines": []}', ODD]
)
def test_a_stability_file_of_another_kind_is_refused(tmp_path, content):
    (tmp_path / "stability.json").write_text(content)
    with pytest.raises(BundleError, match=r"stability\.json"):
        read_stability(tmp_path)


def test_the_shipped_bundles_show_their_verdict():
    for name in ("hopper", "drum"):
        assert all(line.holds is not False for line in read_stability(SHIPPED / name).lines)


def test_page_names_a_missing_figure(heap, tmp_path):
    with pytest.raises(DataError, match=r"missing\.png"):
        page(heap, [tmp_path / "missing.png"], tmp_path)
