"""Jobs: a row for every point, whatever happens on the way."""

import json
import shutil

import numpy as np

from gns_pyg.files import held
from gns_pyg.tradeoff.app import collect, work
from gns_pyg.tradeoff.job import do, folder_of
from gns_pyg.tradeoff.points import Point, points
from tests.faults.kills import forked, kill, wait
from tests.tradeoff.samples import TINY, config

TIMES = ("training_cpu_s", "speed/", "seconds")


def without_times(value):
    if isinstance(value, dict):
        return {key: without_times(v) for key, v in value.items() if not key.startswith(TIMES)}
    return [without_times(each) for each in value] if isinstance(value, list) else value


def rows(results):
    return {path.parent.name: without_times(json.loads(path.read_text())) for path in results.glob("*/row.json")}


def test_a_sweep_killed_twice_ends_with_the_same_rows(tmp_path):
    """The same table, and the same figures in it: each point's number of updates, which a clock decides, is given."""
    whole = config(tmp_path / "whole", *TINY)
    done = work(whole)
    assert [row["error"] for row in done if row["kind"] in ("trained", "without_training")] == [None] * 3
    for plan in (tmp_path / "whole").glob("*/plan.json"):
        place = tmp_path / "killed" / plan.parent.name / plan.name
        place.parent.mkdir(parents=True)
        shutil.copy(plan, place)
    start = forked(lambda _: work(config(tmp_path / "killed", *TINY)))
    random, kills = np.random.default_rng(), 0
    while kills < 2:
        pid = start(tmp_path / "killed")
        if wait(pid, random.uniform(0.2, 4.0)) is None:
            kill(pid, family=True)
            kills += 1
        else:  # it had ended: start anew, to kill that
            for row in (tmp_path / "killed").glob("*/row.json"):
                row.unlink()
    assert wait(start(tmp_path / "killed")) == 0
    assert rows(tmp_path / "killed") == rows(tmp_path / "whole")
    assert len(rows(tmp_path / "whole")) == len(points(whole))
    assert not list((tmp_path / "killed").glob("*/.trial_*"))


def test_a_finished_point_is_not_done_again_and_one_in_work_is_left_alone(tmp_path):
    cfg, point = config(tmp_path, *TINY), Point("frozen", ())
    with held(folder_of(cfg, point)):
        pid = forked(lambda _: do(cfg, point) is None or 1 / 0)(tmp_path)  # a lock is of a process
        assert wait(pid) == 0
    assert do(cfg, point)["error"] is None
    path = folder_of(cfg, point) / "row.json"
    before = path.stat().st_mtime_ns
    do(cfg, point)
    assert path.stat().st_mtime_ns == before


def test_a_point_that_fails_says_why_in_its_row(tmp_path):
    cfg = config(tmp_path, *TINY)
    row = do(cfg, Point("trained", ("scene.boundary.hopper.points=50",)))
    assert "scene.boundary.hopper.points" in row["error"]
    assert "axes" not in row
    after = do(cfg, Point("without_training", ("scene.boundary.hopper.points=50",), ("projection_sweeps=1",)))
    assert "failed" in after["error"]


def test_one_point_by_its_number_and_the_table_of_what_is_there(tmp_path):
    cfg = config(tmp_path, *TINY)
    numbers = [number for number, point in enumerate(points(cfg)) if point.kind in ("seeds", "climatology", "trivial")]
    for number in numbers:
        work(config(tmp_path, *TINY, f"point={number}"))
    table = collect(cfg)
    assert [row["kind"] for row in table] == ["seeds", "climatology", "trivial"]
    assert json.loads((tmp_path / "tradeoff.json").read_text())["hopper"] == table
    assert set(table[2]["axes"]) == {"one_step_error_m"}
