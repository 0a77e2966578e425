"""A short version of the long fault run (`python -m tests.faults`): every kind of work is killed a few times."""

import pytest

from tests.faults import kills

KILLS = {"training": 3, "roll-out": 3, "report": 2}


@pytest.fixture(scope="module")
def works(tmp_path_factory):
    return kills.works(tmp_path_factory.mktemp("works"))


@pytest.mark.parametrize("name", KILLS)
def test_killed_work_given_again_ends_as_if_it_had_not_been(works, name, tmp_path):
    work, _ = works[name]
    hit, recovered, wrong = kills.campaign(work, tmp_path, KILLS[name], seed=2)
    assert wrong == []
    assert hit == recovered == KILLS[name]


@pytest.mark.yade
def test_killed_data_generation_too(works, tmp_path):
    if "data generation" not in works:
        pytest.skip("Yade is not installed (apt-get install yade)")
    assert kills.campaign(works["data generation"][0], tmp_path, 2, seed=2) == (2, 2, [])


def test_a_cut_file_is_seen(works, tmp_path):
    """The check of the checks: a file that is cut off is unsound, whatever its kind."""
    work, _ = works["report"]
    (folder := tmp_path / "run").mkdir()
    assert kills.wait(work.start(folder)) == 0
    assert kills.unsound(folder) == []
    endings = {path.suffix: path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")}
    for path in (cut := [path for ending, path in endings.items() if ending in (".json", ".html", ".png", ".svg")]):
        path.write_bytes(path.read_bytes()[:-20])
    assert len(kills.unsound(folder)) == len(cut) == 4
