"""Numbers that are honest by construction, and a run that talks to no one."""

import shutil
import sys

import pytest
import torch

from gns_pyg import bundle, run
from gns_pyg.card import seen_earlier
from gns_pyg.data.datamodule import EMBEDDED, DataConfig, open_to_compare, split
from gns_pyg.data.statistics import measure
from gns_pyg.dynamics.integrator import Integrator
from gns_pyg.errors import ConfigError, DataError
from gns_pyg.evaluation.judge import judge
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.evaluation.twins import read_twins, twins_path
from gns_pyg.report.sections import trained_on
from gns_pyg.results import BUNDLES, REDUCED, kept_for_testing, long_runs, own_cases
from gns_pyg.scene.scene import Scene
from tests.faults import samples

WATCHED: list[str] = []


def watch(event, arguments):
    if WATCHED and event in ("socket.connect", "socket.getaddrinfo", "socket.sendto"):
        WATCHED.append(f"{event} {arguments!r}")


sys.addaudithook(watch)


@pytest.fixture
def data(tmp_path):
    samples.write_cases(tmp_path / "data", 5)
    return tmp_path / "data"


def test_a_run_that_is_there_twice_is_refused_whatever_its_name(data):
    scene = Scene.from_config(samples.config("train", data, data / "scene.yaml").scene)
    split(scene, DataConfig(dir=str(data)))
    shutil.copyfile(data / "case_000.h5", data / "case_004.h5")
    with pytest.raises(DataError, match=r"case_004\.h5[\s\S]*the same run as case_000\.h5"):
        split(scene, DataConfig(dir=str(data)))


def test_statistics_come_from_training_cases_alone(data, tmp_path):
    overrides = ["data.test_fraction=0.2", "data.val_cases=1"]
    samples.train(data, tmp_path / "a", *overrides)
    scene = Scene.from_config(samples.config("train", data, data / "scene.yaml").scene)
    cases = split(scene, DataConfig(dir=str(data), test_fraction=0.2, val_cases=1))
    used = run.bundle.load(tmp_path / "a" / "bundle")
    integrator = Integrator(used.scene, used.requires.state, free_flight=used.requires.free_flight)
    assert used.statistics == measure(cases.train, integrator)
    assert used.statistics != measure([*cases.train, *cases.test], integrator)


def test_judging_draws_no_random_number(data, tmp_path, monkeypatch):
    samples.train(data, tmp_path / "a", "data.test_fraction=0.2")
    used = run.bundle.load(tmp_path / "a" / "bundle")
    cases = split(used.scene, DataConfig(dir=str(data)))

    def drawn(*_, **__):
        raise AssertionError("a random number was drawn while judging")

    for name in ("randn", "rand", "randint", "normal", "randn_like", "rand_like"):
        monkeypatch.setattr(torch, name, drawn)
    expected = run.climatology(cases.train, used.scene)
    first, second = (judge(used, cases.test, expected, 0.02).metrics for _ in range(2))
    told = {key for key in first if not key.startswith("speed/")}
    assert all(first[key] == second[key] or first[key] != first[key] for key in told)


def test_twins_of_another_run_are_refused(data):
    scene = Scene.from_config(samples.config("train", data, data / "scene.yaml").scene)
    first, second, *_ = split(scene, DataConfig(dir=str(data))).train
    stored = {"times_s": [0.0, 1.0], "mean_distance_m": [0.0, 1.0], "std_distance_m": [0.0, 0.1]}
    write_json(twins_path(first.path), stored | {"content_hash": first.content_hash()})
    assert read_twins(first, first.times_s) is not None
    write_json(twins_path(second.path), stored | {"content_hash": first.content_hash()})
    with pytest.raises(DataError, match="twins of the run"):
        read_twins(second, second.times_s)


@pytest.mark.parametrize("name", REDUCED)
def test_results_are_those_of_the_runs_that_a_bundle_kept_for_testing(name):
    scene, card = bundle.load(name).scene, bundle.card(name)
    cases = own_cases(scene)
    assert [case.path.name for case in kept_for_testing(cases, scene, card)] == sorted(card["cases"]["test"])
    with pytest.raises(DataError, match="those that the bundle kept"):
        kept_for_testing(cases[:-1], scene, card)


@pytest.mark.parametrize("name", sorted({*BUNDLES} - {*REDUCED}))
def test_the_one_embedded_case_of_a_full_scene_does_not_stand_for_all_that_were_kept(name):
    scene, card = bundle.load(name).scene, bundle.card(name)
    with pytest.raises(DataError, match="those that the bundle kept"):
        kept_for_testing(own_cases(scene), scene, card)


def test_resuming_with_other_data_is_refused_and_the_difference_named(data, tmp_path):
    samples.train(data, tmp_path / "a")
    (data / "case_000.h5").rename(data / "case_009.h5")
    with pytest.raises(ConfigError, match=r"cases\.train\.case_009\.h5"):
        samples.train(data, tmp_path / "a")


def test_what_training_started_from_has_seen_does_not_judge(data, tmp_path, caplog):
    """Weights do not forget: a bundle that goes on from another knows that one's cases, too."""
    samples.train(data, tmp_path / "one")
    (tmp_path / "few").mkdir()
    for name in ("scene.yaml", "case_000.h5", "case_002.h5"):
        shutil.copyfile(data / name, tmp_path / "few" / name)
    start = f"training.start_from={tmp_path / 'one' / 'bundle'}"
    samples.train(tmp_path / "few", tmp_path / "two", start, "data.test_fraction=0.5")
    assert "1 of 1 test cases left out" in caplog.text
    assert (tmp_path / "two" / "metrics.json").read_text().strip() == "{}"
    card = bundle.card(tmp_path / "two" / "bundle")
    assert len(card["starts"]) == 5
    assert seen_earlier(card) == 4
    assert "earlier on 4 others" in trained_on(card)
    assert "| 4 others |" in (tmp_path / "two" / "bundle" / "card.md").read_text()
    used = [f"bundle={tmp_path / 'two' / 'bundle'}", f"data.dir={data}", "start_s=0.02"]
    assert run.evaluate(samples.config("evaluate", tmp_path / "three", None, *used)) == {}


def test_resuming_with_other_data_workers_gives_the_same_sequence(data, tmp_path):
    rate = ["training.halvings=0", "training.unroll_from=0"]
    samples.train(data, tmp_path / "one", *rate)
    samples.train(data, tmp_path / "two", *rate, "training.updates=5")
    checkpoint = tmp_path / "two" / "checkpoints" / "last.ckpt"
    samples.train(data, tmp_path / "rest", *rate, f"ckpt_path={checkpoint}", "data.workers=2")
    one, two = (run.bundle.load(tmp_path / name / "bundle").state_dict() for name in ("one", "rest"))
    assert all(torch.equal(one[key], two[key]) for key in one)


def test_nothing_is_sent_over_the_network(data, tmp_path):
    WATCHED.append("on")
    try:
        samples.train(data, tmp_path / "a", "data.test_fraction=0.2")
        used = [f"bundle={tmp_path / 'a' / 'bundle'}", f"data.dir={data}", "start_s=0.02"]
        run.evaluate(samples.config("evaluate", tmp_path / "b", None, *used))
        assert WATCHED == ["on"]
    finally:
        WATCHED.clear()


def test_a_long_run_that_starts_as_a_training_case_does_not_judge(monkeypatch):
    """Cases of a longer scene are recorded anew: only their start tells that a bundle has seen their first seconds."""
    scene, card = bundle.load("hopper").scene, bundle.card("hopper")
    path = EMBEDDED / "hopper_small_long" / "case_020.h5"
    start = open_to_compare(path, scene).start()
    monkeypatch.setattr(bundle, "card", lambda name: card | {"starts": [*card["starts"], start]})
    with pytest.raises(DataError, match=r"case_020\.h5"):
        long_runs("hopper", scene)
