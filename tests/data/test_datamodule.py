"""Finding, checking and splitting cases; windows and the order they are drawn in."""

import itertools
from collections.abc import Callable
from dataclasses import asdict

import h5py
import numpy as np
import pytest
import torch
import trimesh

from gns_pyg.data.datamodule import DataConfig, check_inside, check_same_scene, find_cases, split
from gns_pyg.data.statistics import measure
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import UpdateSampler, Windows
from gns_pyg.dynamics.integrator import Integrator
from gns_pyg.errors import ConfigError, DataError, GeometryError
from gns_pyg.scene.scene import Scene
from gns_pyg.state import Window
from tests import scenes


@pytest.fixture
def folder(tmp_path):
    for case in range(6):
        scenes.free_flight_case(tmp_path / f"case_{case:03d}.h5", n_frames=8, seed=case)
    return tmp_path


SCENE = scenes.scene(20, 8)


def test_no_case_serves_two_purposes(folder):
    cases = split(SCENE, DataConfig(dir=str(folder)))
    assert [len(part) for part in (cases.train, cases.val, cases.test)] == [3, 1, 2]
    hashes = [digest for part in cases.describe().values() for digest in part.values()]
    assert len(set(hashes)) == 6


def test_missing_cases_say_how_to_make_them(tmp_path):
    with pytest.raises(DataError, match=r"python -m data_gen\.generate"):
        find_cases(SCENE, str(tmp_path))


def test_a_case_of_another_scene_is_refused_with_the_difference(folder):
    other = Scene.from_config(asdict(SCENE) | {"damping": 0.3})
    with pytest.raises(DataError, match="damping = 0.0"):
        split(other, DataConfig(dir=str(folder)))


def test_a_frame_may_be_a_whole_number_of_recorded_ones(folder):
    longer = Scene.from_config(asdict(SCENE) | {"frame_dt_s": 0.02})
    case = split(longer, DataConfig(dir=str(folder))).train[0]
    assert case.times_s == pytest.approx([0.0, 0.02, 0.04, 0.06])
    odd = Scene.from_config(asdict(SCENE) | {"frame_dt_s": 0.015})
    with pytest.raises(DataError, match="frame_dt_s = 0.01 "):
        split(odd, DataConfig(dir=str(folder)))


@pytest.mark.parametrize(("key", "value"), [("val_cases", -1), ("workers", -1), ("test_fraction", 1.0)])
def test_a_data_key_out_of_range_is_named(key, value):
    with pytest.raises(ConfigError, match=f"data.{key}"):
        DataConfig(**{key: value})


def double(name: str) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[name][...] = 2 * file[name][:]

    return change


def late(file: h5py.File) -> None:
    file["particles/grains/position/time"][5] += 1e-6


def fewer(file: h5py.File) -> None:
    for name in ("position/value", "velocity/value", "angular_velocity/value", "radius", "mass"):
        data = file[f"particles/grains/{name}"]
        kept, unit = data[..., :9, :] if data.ndim == 3 else data[:9], data.attrs["unit"]
        del file[f"particles/grains/{name}"]
        file.create_dataset(f"particles/grains/{name}", data=kept).attrs["unit"] = unit


def no_walls(file: h5py.File) -> None:
    del file["boundary/walls"]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (double("particles/grains/position/time"), "frame 1 is 0.02 s after the first"),
        (late, "frame 5 is 0.050001 s after the first"),
        (double("particles/grains/radius"), "grain 0 has a radius of 0.02 m"),
        (fewer, r"9 grains stored \(scene: 20\)"),
        (double("boundary/walls/vertices"), "boundary.walls: another mesh stored"),
        (no_walls, "boundary.walls: a mesh in the scene only"),
    ],
)
def test_a_case_that_holds_something_else_than_it_says_is_refused(tmp_path, change, told):
    scenes.free_flight_case(tmp_path / "case.h5", n_frames=8)
    check_same_scene(Trajectory(tmp_path / "case.h5"), SCENE)
    with h5py.File(tmp_path / "case.h5", "r+") as file:
        change(file)
    with pytest.raises(DataError, match=told):
        check_same_scene(Trajectory(tmp_path / "case.h5"), SCENE)


def from_file(path) -> Scene:
    shape = {"kind": "file", "path": str(path)}
    return scenes.scene(20, 8, boundary={"walls": {"shape": shape, "points": 200, "friction_angle_rad": 0.5}})


def test_a_mesh_file_that_changed_behind_its_path_is_found(tmp_path):
    trimesh.creation.box([4.0, 4.0, 4.0]).export(tmp_path / "walls.stl")
    scene = from_file(tmp_path / "walls.stl")
    scenes.write_case(tmp_path / "case.h5", scene, np.zeros((8, 20, 3)))
    check_same_scene(Trajectory(tmp_path / "case.h5"), scene)
    trimesh.creation.box([4.0, 4.0, 4.1]).export(tmp_path / "walls.stl")
    with pytest.raises(DataError, match=r"boundary\.walls: another mesh"):
        check_same_scene(Trajectory(tmp_path / "case.h5"), scene)


def test_a_container_made_of_an_open_file_is_refused(tmp_path):
    box = trimesh.creation.box([4.0, 4.0, 4.0])
    box.update_faces(np.arange(len(box.faces)) > 0)
    box.export(tmp_path / "walls.stl")
    scene = from_file(tmp_path / "walls.stl")
    scenes.write_case(tmp_path / "case.h5", scene, np.zeros((8, 20, 3)))
    with pytest.raises(GeometryError, match=r"scene\.boundary\.walls\n[\s\S]*not supported as containers yet"):
        check_inside(Trajectory(tmp_path / "case.h5"), scene)


def test_a_case_may_start_at_any_time(tmp_path):
    scenes.free_flight_case(tmp_path / "case.h5", n_frames=8)
    with h5py.File(tmp_path / "case.h5", "r+") as file:
        file["particles/grains/position/time"][...] += 1.2345
    check_same_scene(Trajectory(tmp_path / "case.h5"), SCENE)


def test_a_grain_outside_is_named(tmp_path):
    pos = np.zeros((8, 20, 3))
    pos[:, 7] = [3.0, 0.0, 0.0]
    for case in range(3):
        scenes.write_case(tmp_path / f"case_{case:03d}.h5", SCENE, pos + 1e-3 * case)
    with pytest.raises(DataError, match="1 grain.* outside .* grain 7"):
        split(SCENE, DataConfig(dir=str(tmp_path)))


def test_too_few_cases_are_refused(tmp_path):
    scenes.free_flight_case(tmp_path / "case_000.h5", n_frames=8)
    with pytest.raises(DataError, match="test_fraction"):
        split(SCENE, DataConfig(dir=str(tmp_path)))


def test_short_cases_are_refused(folder):
    with pytest.raises(DataError, match="8 frames"):
        Windows(split(SCENE, DataConfig(dir=str(folder))).train, 9)


def test_windows_are_the_stored_frames(folder):
    cases = split(SCENE, DataConfig(dir=str(folder))).train
    windows = Windows(cases, 3)
    assert len(windows) == 3 * 6
    window = windows[6 + 2]  # the second case, from frame 2
    assert np.array_equal(window.pos.numpy(), cases[1].read("position", 2, 5))
    assert window.time_s.item() == pytest.approx(0.02)


def test_collate_keeps_graphs_apart(folder):
    windows = Windows(split(SCENE, DataConfig(dir=str(folder))).train, 3)
    batch = Window.collate([windows[0], windows[9]])
    assert torch.equal(batch.pos[:, batch.batch == 1], windows[9].pos)
    assert batch.time_s.tolist() == [windows[0].time_s.item(), windows[9].time_s.item()]


def test_sampler_visits_every_item_once_per_epoch_and_resumes_anywhere():
    batches = list(itertools.islice(UpdateSampler(10, 4, seed=3), 10))
    drawn = [item for batch in batches for item in batch]
    for epoch in range(4):
        assert sorted(drawn[10 * epoch : 10 * epoch + 10]) == list(range(10))
    for first in range(10):
        assert list(itertools.islice(UpdateSampler(10, 4, 3, first), 10 - first)) == batches[first:]


def test_statistics_are_root_mean_squares(folder):
    cases = split(SCENE, DataConfig(dir=str(folder))).train
    statistics = measure(cases, Integrator(SCENE, "velocity", free_flight=False))
    assert statistics.velocity_m_s == pytest.approx(np.sqrt(np.mean(cases[0].read("velocity") ** 2)), rel=0.2)


def test_a_field_that_is_not_there_is_named(tmp_path):
    scenes.free_flight_case(tmp_path / "case.h5")
    with h5py.File(tmp_path / "case.h5", "r+") as file:
        file["parameters"].attrs["creator"] = "gns_pyg"
        del file["particles/grains/angular_velocity"]
    with pytest.raises(DataError, match="angular_velocity"):
        Trajectory(tmp_path / "case.h5").read("angular_velocity")
