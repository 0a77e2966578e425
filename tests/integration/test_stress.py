"""The stability suite in its short form, on the bundles that ship; and what it says when something does not hold."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from gns_pyg import bundle, run, stability
from gns_pyg.config import CONF
from gns_pyg.dynamics.guard import Guard
from gns_pyg.errors import NumericalError
from gns_pyg.evaluation.stress import Bench, run_lines
from gns_pyg.evaluation.stress_hard import HARD
from gns_pyg.evaluation.stress_measured import MEASURED

DOCS = Path(__file__).parents[2] / "docs"


def config(folder, *overrides):
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose("stress", [f"folder={folder}", "form=short", *overrides])


@pytest.mark.parametrize("name", ["hopper", "drum"])
def test_every_hard_line_holds_for_what_ships(name, tmp_path):
    found = run.stress(config(tmp_path, f"bundle={name}"))
    assert {line["line"] for line in found["lines"]} == {*HARD, *MEASURED}
    assert json.loads((tmp_path / "stability.json").read_text())["lines"] == found["lines"]
    assert (tmp_path / "plots" / "stability.png").is_file()


def test_the_architecture_alone(tmp_path):
    lines = "lines=[coincident,isolated,units,100 m/s,infinity,float64]"
    small = ["model.hidden=16", "model.layers=1"]
    found = run.stress(config(tmp_path, "bundle=untrained", "scene=drum_small", *small, lines))
    assert [line["holds"] for line in found["lines"]] == [True] * 6
    assert not (tmp_path / "plots").exists()  # nothing of what is drawn was run


def test_a_line_that_fails_is_named_and_the_rest_is_written(tmp_path, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("on purpose")

    monkeypatch.setitem(HARD, "repeatable", broken)
    with pytest.raises(NumericalError, match="repeatable"):
        run.stress(config(tmp_path, "bundle=hopper", "lines=[repeatable,float64]"))
    marks = {line["line"]: line["holds"] for line in json.loads((tmp_path / "stability.json").read_text())["lines"]}
    assert marks == {"float32 against float64": True, "repeatable": False}


def bench(name):
    simulator, card = bundle.load(name), bundle.describe(name)["card"]
    case = run.unseen_cases(simulator.scene, None, card, None)[0]
    return Bench(simulator, case, card["coverage"], full=False)


def verdict(name, one):
    (line,) = run_lines(one, {name: HARD[name]}, hard=True)
    return line


def unguarded(simulator):
    simulator.guard = Guard(replace(simulator.scene, boundary={}))


@pytest.mark.parametrize(
    ("line", "spoil"),
    [
        (
            "grains up to 100 m/s",
            lambda simulator: setattr(simulator, "guard", Guard(replace(simulator.scene, boundary={}))),
        ),
        ("other units", lambda simulator: setattr(simulator.statistics, "correction", [1.0, 1.0])),
    ],
)
def test_the_lines_can_fail(line, spoil):
    """The check of the checks."""
    one = bench("hopper")
    assert verdict(line, one).holds
    one = bench("hopper")
    spoil(one.simulator)
    assert verdict(line, one).holds is False


def test_the_page_shows_what_was_found():
    found = json.loads((DOCS / "stability.json").read_text())
    page = (DOCS / "stability.md").read_text()
    assert stability.with_tables(page, found) == page
    assert set(re.findall(r"<!-- end of (\w+) -->", page)) == set(found)
    assert {"hopper", "drum"} <= {*found}
    for name, entry in found.items():
        assert entry["form"] == "full"
        assert {line["line"] for line in entry["lines"]} <= {*HARD, *MEASURED}
        assert not [line for line in entry["lines"] if line["holds"] is False], name
