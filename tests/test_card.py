"""Cards of bundles: what the code writes, and what a person needs to read there."""

import json
from pathlib import Path

import pytest

from gns_pyg import bundle
from gns_pyg.card import FILE, card_page
from gns_pyg.results import BUNDLES
from tests import scenes
from tests.simulators import simulator

RESULTS = json.loads((Path(__file__).parents[1] / "docs" / "results.json").read_text())
JUDGED = {values["bundle"]: values["metrics"] for values in RESULTS.values()}


def stored(name):
    return (bundle.SHIPPED / name / FILE).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", sorted(path.name for path in bundle.SHIPPED.iterdir()))
def test_a_shipped_card_is_what_the_code_writes(name):
    """gns_pyg.results.rewrite_pages() writes them anew."""
    assert name in BUNDLES
    assert stored(name) == card_page(bundle.describe(name), JUDGED[name])


@pytest.mark.parametrize("name", sorted(BUNDLES))
def test_a_card_tells_data_scene_range_errors_speed_and_licence(name):
    text, description, metrics = stored(name), bundle.describe(name), JUDGED[name]
    card = description["card"]
    for purpose in ("train", "val", "test"):
        assert all(file in text for file in card["cases"][purpose])
    for what, (low, high) in card["coverage"].items():
        assert f"| {what} | {low:.4g} | {high:.4g} |" in text
    assert f"{1e3 * metrics['test/one_step_error_m']:.4g} mm" in text
    assert f"{1e3 * metrics['test/rollout_error_final_twin_m']:.4g} DEM twins" in text
    assert f"| {metrics['speed/seconds_per_simulated_second']:.4g} on {metrics['speed/device']} |" in text
    assert f"{metrics['speed/yade_seconds_per_simulated_second']:.4g} Yade" in text
    assert all(reason in text for reason in description["requires"]["reasons"].values())
    assert "MIT" in text


def test_saving_a_bundle_writes_its_card_with_its_own_figures(tmp_path):
    metrics = JUDGED["hopper"] | {"test/escaped_grains": 17, "test/angle_of_repose_deg": None}
    own = simulator(scenes.scene(5, 3))
    bundle.save(tmp_path / "judged", own, {"metrics": metrics})
    text = (tmp_path / "judged" / FILE).read_text(encoding="utf-8")
    assert text == card_page(bundle.describe(tmp_path / "judged"))
    assert "| grains lost, all cases | 17 |" in text
    assert "angle of repose |" not in text
    bundle.save(tmp_path / "new", own, {})
    assert "Not judged" in (tmp_path / "new" / FILE).read_text(encoding="utf-8")


def test_every_table_of_a_card_has_its_columns():
    for line, following in zip(lines := stored("hopper").splitlines(), lines[1:], strict=False):
        if line.startswith("|") and following.startswith("|"):
            assert line.count("|") == following.count("|")
