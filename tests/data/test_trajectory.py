"""Trajectory files: what goes in comes out, reading is lazy, a broken file says everything that is wrong with it."""

import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_pyg.data.schema import GRAINS, RUN_KEYS, UNITS
from gns_pyg.data.trajectory import CHUNK_FRAMES, Trajectory, TrajectoryWriter
from gns_pyg.errors import DataError

RUN = {"wall_clock_s": 1.5, "cores": 1, "steps": 200, "dt_s": 1e-4, "creator": "Yade", "creator_version": "2023.02a"}
DECIMALS = {"position": 7, "velocity": 5, "angular_velocity": 3}
BOUNDARY = {"floor": {"vertices": np.eye(3), "triangles": [[0, 1, 2]], "motion": {"kind": "none"}}}


def fields(n_frames: int, n_grains: int, seed: int = 0) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(seed)
    return {name: generator.uniform(-3, 3, (n_frames, n_grains, 3)) for name in UNITS}


def write(path: Path, values: dict[str, np.ndarray]) -> Path:
    n_frames, n_grains = values["position"].shape[:2]
    scene = {"name": "test", "frame_dt_s": 0.01, "grains": {"count": n_grains}}
    with TrajectoryWriter(path, scene, np.full(n_grains, 0.01), np.full(n_grains, 0.004), BOUNDARY, DECIMALS) as writer:
        for k in range(n_frames):
            writer.append(100 * k, 0.01 * k, *(values[name][k] for name in UNITS))
        writer.finish(RUN | {"case": 3})
    return path


@pytest.fixture
def good(tmp_path) -> Path:
    return write(tmp_path / "case.h5", fields(20, 5))


@settings(max_examples=15, deadline=None)
@given(n_frames=st.integers(1, 2 * CHUNK_FRAMES + 1), n_grains=st.integers(1, 6), seed=st.integers(0, 99))
def test_what_goes_in_comes_out(tmp_path_factory, n_frames, n_grains, seed) -> None:
    values = fields(n_frames, n_grains, seed)
    trajectory = Trajectory(write(tmp_path_factory.mktemp("data") / "case.h5", values))
    assert (trajectory.n_frames, trajectory.n_grains) == (n_frames, n_grains)
    for name, decimals in DECIMALS.items():
        assert trajectory.read(name) == pytest.approx(values[name], abs=0.51 * 10**-decimals)
    assert trajectory.times_s == pytest.approx(0.01 * np.arange(n_frames))
    assert trajectory.scene["name"] == "test"
    assert trajectory.run == RUN | {"case": 3}
    assert trajectory.radius.tolist() == [0.01] * n_grains


def test_grains_at_rest_and_slow_ones_keep_their_digits(tmp_path) -> None:
    values = fields(CHUNK_FRAMES + 1, 5)
    values["velocity"][:, :3] = 0.0
    values["velocity"][:, 3] = 1.2e-5
    velocity = Trajectory(write(tmp_path / "case.h5", values)).read("velocity")
    assert velocity[:, :3] == pytest.approx(0, abs=1e-12)
    assert velocity[:, 3] == pytest.approx(1e-5, abs=1e-12)


def test_a_part_of_the_frames_is_that_part_of_the_whole(good) -> None:
    trajectory = Trajectory(good)
    assert (trajectory.read("velocity", 7, 12) == trajectory.read("velocity")[7:12]).all()


def test_an_open_trajectory_travels_to_workers_which_open_the_file_anew(good) -> None:
    trajectory = Trajectory(good)
    whole = trajectory.read("position")
    assert pickle.loads(pickle.dumps(trajectory))._file is None
    assert (pickle.loads(pickle.dumps(trajectory)).read("position") == whole).all()


def test_the_hash_is_that_of_the_run_and_not_of_the_name(good, tmp_path) -> None:
    same = write(tmp_path / "other.h5", fields(20, 5))
    different = write(tmp_path / "different.h5", fields(20, 5, seed=1))
    assert Trajectory(good).content_hash() == Trajectory(same).content_hash()
    assert Trajectory(good).content_hash() != Trajectory(different).content_hash()


def test_the_layout_is_h5md(good) -> None:
    with h5py.File(good) as file:
        assert tuple(file["h5md"].attrs["version"]) == (1, 1)
        assert "name" in file["h5md/author"].attrs
        assert file["h5md/modules/units"].attrs["system"] == "SI"
        assert file["h5md/creator"].attrs["name"] == "Yade"
        assert file[f"{GRAINS}/box"].attrs["dimension"] == 3
        assert list(file[f"{GRAINS}/box"].attrs["boundary"]) == ["none"] * 3
        for name, unit in UNITS.items():
            element = file[f"{GRAINS}/{name}"]
            assert element["value"].attrs["unit"] == unit
            assert element["time"].attrs["unit"] == "s"
            assert element["step"][:].tolist() == list(range(0, 2000, 100))
        assert file[f"{GRAINS}/velocity/time"] == file[f"{GRAINS}/position/time"]  # one data set, linked
        assert file["boundary/floor/vertices"].shape == (3, 3)


def test_the_boundary_comes_back(good) -> None:
    (name,) = Trajectory(good).boundary
    assert (Trajectory(good).boundary[name]["vertices"] == np.eye(3)).all()
    assert Trajectory(good).boundary[name]["motion"] == {"kind": "none"}


def test_every_violation_is_reported_at_once(good) -> None:
    with h5py.File(good, "a") as file:
        del file["h5md"], file[f"{GRAINS}/mass"], file["parameters"].attrs["dt_s"], file[f"{GRAINS}/box"]
        file[f"{GRAINS}/velocity/value"].attrs["unit"] = "km h-1"
        file[f"{GRAINS}/position/time"][4] = 0.0
        file[f"{GRAINS}/radius"][2] = -1.0
    with pytest.raises(DataError) as caught:
        Trajectory(good)
    told = str(caught.value)
    for fragment in ("h5md", "mass", "dt_s", "box", "km h-1", "strictly increasing", "radius"):
        assert fragment in told
    assert "docs/data_format.md" in told


def replace(path: Path, name: str, value: np.ndarray) -> None:
    with h5py.File(path, "a") as file:
        unit = file[f"{GRAINS}/{name}/value"].attrs["unit"]
        del file[f"{GRAINS}/{name}/value"]
        file.create_dataset(f"{GRAINS}/{name}/value", data=value).attrs["unit"] = unit


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (np.zeros((20, 4, 3)), r"shape \(20, 4, 3\), expected \(20, 5, 3\)"),
        (np.zeros((20, 5)), r"expected floats \(n_frames, n_grains, 3\)"),
        (np.zeros((20, 5, 3), int), "int64"),
        (np.where(np.arange(300).reshape(20, 5, 3) == 200, np.nan, 0.0), "not finite at frame 13, grain 1"),
    ],
)
def test_a_field_of_wrong_shape_type_or_content_is_refused(good, value, told) -> None:
    replace(good, "angular_velocity", value)
    with pytest.raises(DataError, match=told):
        Trajectory(good)


def test_units_are_compared(good) -> None:
    places = [f"{GRAINS}/radius", f"{GRAINS}/mass", f"{GRAINS}/position/time", "boundary/floor/vertices"]
    with h5py.File(good, "a") as file:
        for place in places:
            file[place].attrs["unit"] = "mm"
        file[f"{GRAINS}/position/value"].attrs["unit"] = [1, 2]
    with pytest.raises(DataError) as caught:
        Trajectory(good)
    for place in places:
        assert f"/{place}: unit 'mm', expected" in str(caught.value)
    assert "position/value: unit 'array([1, 2])', expected 'm'" in str(caught.value)


@pytest.mark.parametrize("shape", [(0, 5, 3), (20, 0, 3)])
def test_a_file_without_frames_or_grains_is_refused(good, shape) -> None:
    for name in UNITS:
        replace(good, name, np.zeros(shape))
    with pytest.raises(DataError, match=f"{shape[0]} frames of {shape[1]} grains, expected at least 1"):
        Trajectory(good)


@pytest.mark.parametrize("content", ["{not json", 3.0, "[1, 2]"])
@pytest.mark.parametrize(("place", "name"), [("parameters", "scene"), ("boundary/floor", "motion")])
def test_an_attribute_that_is_no_json_object_is_a_violation(good, place, name, content) -> None:
    with h5py.File(good, "a") as file:
        file[place].attrs[name] = content
        del file["parameters"].attrs["cores"]
    with pytest.raises(DataError, match=rf"attribute `{name}` is no[\s\S]*JSON") as caught:
        Trajectory(good)
    assert "attribute `cores` missing" in str(caught.value)


NEEDED = [
    *("h5md", GRAINS, f"{GRAINS}/box", f"{GRAINS}/radius", f"{GRAINS}/mass", "parameters", "boundary/floor"),
    *("boundary/floor/vertices", "boundary/floor/triangles"),
    *(f"{GRAINS}/{name}{part}" for name in UNITS for part in ("", "/value", "/time")),
]


@pytest.mark.parametrize("replacement", ["nothing", "a group", "text", "one number"])
@pytest.mark.parametrize("place", NEEDED)
def test_something_else_in_a_place_is_a_violation_named_by_it(good, place, replacement) -> None:
    if (place, replacement) in ((f"{GRAINS}/box", "a group"), ("boundary/floor", "nothing")):
        return  # an empty box will do, and a scene may have no boundary
    with h5py.File(good, "a") as file:
        del file[place]
        if replacement == "a group":
            file.create_group(place)
        elif replacement != "nothing":
            file[place] = "text" if replacement == "text" else 1.0
    with pytest.raises(DataError, match="delete the file and generate it again") as caught:
        Trajectory(good)
    assert f"/{place}" in str(caught.value)


def test_a_boundary_that_is_no_group_is_a_violation(good) -> None:
    with h5py.File(good, "a") as file:
        del file["boundary"]
        file["boundary"] = 1.0
    with pytest.raises(DataError, match="/boundary: a data set, expected a group"):
        Trajectory(good)


def test_triangles_that_are_no_rows_of_vertices_are_a_violation(good) -> None:
    with h5py.File(good, "a") as file:
        file["boundary/floor/triangles"][0, 2] = 3
    with pytest.raises(DataError, match=r"/boundary/floor/triangles: not all are rows of vertices \(0 to 2\)"):
        Trajectory(good)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.95])
def test_a_truncated_file_is_refused(good, share) -> None:
    data = good.read_bytes()
    good.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DataError, match=r"case\.h5"):
        Trajectory(good)


def test_a_heap_on_which_the_hdf5_library_never_ends_is_refused_unread(good) -> None:
    content = bytearray(good.read_bytes())
    place = content.index(b"GCOL") + 16
    while content[place : place + 2] != b"\0\0":  # object 0 is the heap's free space
        place += 16 + -(-int.from_bytes(content[place + 8 : place + 16], "little") // 8) * 8
    content[place + 8 : place + 16] = bytes(8)
    good.write_bytes(content)
    with pytest.raises(DataError, match="free space of size 0"):
        Trajectory(good)


def test_a_missing_file_names_the_command_that_makes_it(tmp_path) -> None:
    with pytest.raises(DataError, match=r"data_gen\.generate"):
        Trajectory(tmp_path / "nothing.h5")


def leftovers(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


def test_a_run_that_fails_leaves_no_file(tmp_path) -> None:
    values = fields(10, 5)
    values["velocity"][6, 2, 1] = np.inf
    with pytest.raises(DataError, match="velocity of grain 2 is not finite at step 600"):
        write(tmp_path / "case.h5", values)
    assert leftovers(tmp_path) == []


def test_a_run_without_all_its_facts_is_refused(tmp_path) -> None:
    with (
        pytest.raises(DataError, match=RUN_KEYS[0]),
        TrajectoryWriter(tmp_path / "case.h5", {}, np.ones(1), np.ones(1), {}, DECIMALS) as writer,
    ):
        writer.finish({})
    assert leftovers(tmp_path) == []


def test_the_final_name_appears_only_when_the_run_is_complete(tmp_path) -> None:
    frame = np.zeros((1, 3))
    with TrajectoryWriter(tmp_path / "case.h5", {}, np.ones(1), np.ones(1), {}, DECIMALS) as writer:
        for k in range(2 * CHUNK_FRAMES):
            writer.append(k, 0.1 * k, frame, frame, frame)
        assert not (tmp_path / "case.h5").exists()
        writer.finish(RUN)
        assert leftovers(tmp_path) == ["case.h5"]
    assert leftovers(tmp_path) == ["case.h5"]


def test_every_third_frame_is_as_if_no_other_were_stored(good) -> None:
    stored, thin = Trajectory(good), Trajectory(good, every=3)
    assert thin.n_frames == 7
    assert thin.frame_dt_s == pytest.approx(0.03)
    assert thin.content_hash() == stored.content_hash()
    for start, stop in ((0, None), (2, 5), (5, 100), (3, 3), (-2, None)):
        assert (thin.read("velocity", start, stop) == stored.read("velocity")[::3][start:stop]).all()
        assert len(thin.active(start, stop)) == len(thin.read("velocity", start, stop))
