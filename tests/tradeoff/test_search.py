"""The search near the front: real trials, tiny, kept in Optuna's own study."""

import optuna
import pytest
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from gns_pyg.errors import ConfigError
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.tradeoff.job import folder_of
from gns_pyg.tradeoff.points import Point, as_plain
from gns_pyg.tradeoff.search import search
from tests.tradeoff.samples import TINY, config

SPACE = ["search=['model.layers=1,2','requires.state=full,velocity']", "without_training=[]"]


def studied(results):
    storage = JournalStorage(JournalFileBackend(str(results / "optuna.log")))
    return optuna.load_study(study_name=None, storage=storage).trials


def test_trials_are_points_with_rows_and_a_stopped_search_goes_on(tmp_path):
    cfg = config(tmp_path, *TINY, *SPACE, "sweeps=[]", "trials=1")
    best = search(cfg)
    assert best
    assert all(len(trial["values"]) == 3 and min(trial["values"]) >= 0 for trial in best)
    assert {*best[0]["params"]} == {"model.layers", "requires.state"}
    search(cfg)
    trials = studied(tmp_path)
    assert len(trials) == 2
    assert all((folder_of(cfg, Point("trained", training)) / "row.json").is_file() for training in trained(trials))


def trained(trials):
    """The overrides of each trial, without the defaults."""
    defaults = {"model.layers": "1", "requires.state": "full"}
    return [tuple(f"{k}={v}" for k, v in trial.params.items() if v != defaults[k]) for trial in trials]


def test_what_the_table_holds_is_told_first(tmp_path):
    cfg = config(tmp_path, *TINY, *SPACE, "trials=0")
    point = Point("trained", ("requires.state=velocity",))
    case = {"test/center_of_mass_error_max_m": 0.01, "test/angle_of_repose_error_deg": 1.0}
    folder_of(cfg, point).mkdir(parents=True)
    write_json(folder_of(cfg, point) / "row.json", as_plain(point) | {"error": None, "cases": [case]})
    write_json(folder_of(cfg, point) / "time.json", {"cpu_s_per_simulated_s": 0.5})
    search(cfg)
    (trial,) = studied(tmp_path)
    assert trial.values == [0.5, 0.01, 1.0]
    assert trial.user_attrs["name"] == point.name


@pytest.mark.parametrize("space", ["[]", "[model.layers]", "['model.layers=1']"])
def test_a_search_through_nothing_is_refused(space, tmp_path):
    with pytest.raises(ConfigError, match=r"^search\n"):
        search(config(tmp_path, *TINY, f"search={space}"))
