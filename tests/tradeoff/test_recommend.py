"""What is recommended, and what is said instead."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from gns_pyg.config import CONF
from gns_pyg.errors import ConfigError, DataError
from gns_pyg.tradeoff.recommend import recommend, sentence
from tests.tradeoff.samples import row, seeds, yade

ROOT = Path(__file__).parents[2]
ROWS = [seeds(), yade(1e-4, 2.0, 0.005, within_scatter=True), row("model.hidden=16", 0.5, 0.05, 5.0, updates=7)]


@pytest.fixture
def cfg(tmp_path):
    (tmp_path / "tradeoff.json").write_text(json.dumps({"hopper": ROWS}))

    def with_limits(*limits):
        with initialize_config_dir(f"{CONF}/tradeoff", version_base="1.3"):
            return compose("recommend", [f"table={tmp_path / 'tradeoff.json'}", *limits])

    return with_limits


def test_yade_is_named_where_it_is_the_honest_answer(cfg):
    assert recommend(cfg("max_center_of_mass_error_m=0.01"))["kind"] == "yade"
    text = sentence(ROWS[1], ROWS, "hopper", 1.0)
    assert text.startswith("run Yade with dt = 0.0001 instead of a network")


def test_a_network_comes_with_its_command_its_break_even_and_what_it_gets_wrong(cfg):
    found = recommend(cfg("max_seconds=1")) | {"break_even_rollouts": 130}
    text = sentence(found, ROWS, "hopper", 1.0)
    assert "train.py experiment=hopper model.hidden=16 training.updates=7" in text
    assert "130" in text
    assert "outside the scatter between DEM seeds in centre of mass, mm, angle of repose, degrees" in text
    assert "4 times as fast" in text


def test_what_nothing_reaches_is_said_with_what_would_do(cfg):
    with pytest.raises(DataError, match=r"Yade, dt = 0\.0001 s takes 2 s"):
        recommend(cfg("max_seconds=0.001"))


def test_limits_are_numbers_and_scenes_are_there(cfg):
    with pytest.raises(ConfigError, match="max_seconds"):
        recommend(cfg("max_seconds=soon"))
    with pytest.raises(DataError, match="nothing of silo"):
        recommend(cfg("experiment=silo", "max_seconds=1"))
    with pytest.raises(DataError, match="nowhere"):
        recommend(cfg("table=nowhere.json", "max_seconds=1"))


def test_the_first_word_of_the_command_asks_for_it(tmp_path):
    (tmp_path / "table.json").write_text(json.dumps({"drum": ROWS}))
    words = ["recommend", "experiment=drum", f"table={tmp_path}/table.json", "max_seconds=3"]
    done = subprocess.run(
        [sys.executable, "tradeoff.py", *words],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "run Yade with dt = 0.0001" in done.stdout + done.stderr
