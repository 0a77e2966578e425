"""A short version of the long fault run (`python -m tests.faults`): damaged and hostile files of every kind."""

import pytest

from tests.faults import mutations, samples

N = {"trajectory.h5": 150, "bundle": 40, "scene.yaml": 60, "mesh.stl": 60, "checkpoint.ckpt": 8}
FOUND = {"trajectory.h5": [4905, 5620], "bundle": [155, 203], "scene.yaml": [1122, 1393], "checkpoint.ckpt": [85]}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults") / "samples"
    samples.write_samples(folder)
    return folder


def test_the_samples_are_sound(sound):
    for name, open_it in samples.OPEN.items():
        open_it(sound / name, sound / "data")


@pytest.mark.parametrize("name", N)
def test_damaged_files_are_refused_in_our_own_words_or_give_sound_objects(sound, name, tmp_path):
    counts, wrong, _ = mutations.check(name, sound, tmp_path / "work", range(10_000, 10_000 + N[name]))
    assert wrong == {}
    assert counts["refused"] > N[name] / 4


@pytest.mark.parametrize("name", FOUND)
def test_what_the_long_run_found_is_mended(sound, name, tmp_path):
    for seed in FOUND[name]:
        counts, wrong, _ = mutations.check(name, sound, tmp_path / "work", range(seed, seed + 1))
        assert wrong == {}
        assert counts["refused"] == 1
