"""Initial states: without overlap, clear of the walls, reproducible, and refused when the grains do not fit."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from data_gen.initial import initial_state
from gns_pyg.errors import GeometryError
from gns_pyg.scene.inlet import entries
from gns_pyg.scene.mesh import build_mesh, distance, inside
from gns_pyg.scene.scene import Inlet, Outlet, Scene
from tests import scenes

HOPPER = {"kind": "revolution", "profile_m": [[0.1, 0.0], [0.05, 0.1], [0.1, 0.2], [0.1, 0.4]], "segments": 16}
DRUM = {"kind": "cylinder", "radius_m": 0.1, "length_m": 0.15, "axis": [1.0, 0.0, 0.0], "segments": 24}
FLOOR = {"kind": "floor", "size_m": [1.0, 1.0]}


def make(arrangement: str, count: int = 60, seed: int = 0, shape: dict = HOPPER, **limits):
    scene = scenes.scene(
        count,
        2,
        seed=seed,
        initial={"arrangement": arrangement, "speed_max_m_s": 0.5, **limits},
        boundary={"walls": {"shape": shape, "points": 10, "friction_angle_rad": 0.5}},
    )
    return scene, {name: build_mesh(name, part) for name, part in scene.boundary.items()}


def clear(scene: Scene, meshes: dict, pos: np.ndarray) -> bool:
    radius = scene.grains.radius_m
    return all(inside(mesh, pos).all() and distance(mesh, pos).min() >= radius for mesh in meshes.values())


@settings(max_examples=15, deadline=None)
@given(
    arrangement=st.sampled_from(["random", "dense"]),
    shape=st.sampled_from([HOPPER, DRUM]),
    seed=st.integers(0, 1000),
    case=st.integers(0, 50),
)
def test_grains_lie_clear_of_each_other_and_of_the_walls(arrangement, shape, seed, case) -> None:
    scene, meshes = make(arrangement, 60, seed, shape)
    start = initial_state(scene, meshes, case)
    assert start.pos.shape == start.vel.shape == start.ang_vel.shape == (60, 3)
    assert pdist(start.pos).min() >= 2 * scene.grains.radius_m
    assert clear(scene, meshes, start.pos)
    assert np.abs(start.vel).max() <= 0.5
    assert not start.ang_vel.any()


@pytest.mark.parametrize("arrangement", ["random", "dense"])
def test_seed_and_case_fix_the_start_and_each_changes_it(arrangement) -> None:
    scene, meshes = make(arrangement)
    first, again, other_case = (initial_state(scene, meshes, case) for case in (0, 0, 1))
    other_seed = initial_state(*make(arrangement, seed=1), 0)
    assert (first.pos == again.pos).all()
    assert (first.vel == again.vel).all()
    assert not np.allclose(first.pos, other_case.pos)
    assert not np.allclose(first.pos, other_seed.pos)


@pytest.mark.parametrize("arrangement", ["random", "dense"])
def test_centres_stay_within_the_heights_asked_for(arrangement) -> None:
    z = initial_state(*make(arrangement, z_min_m=0.22, z_max_m=0.36), 0).pos[:, 2]
    assert 0.22 <= z.min() < z.max() <= 0.36


def test_a_dense_start_is_close_packed() -> None:
    scene, meshes = make("dense", 100, shape=DRUM)
    nearest = cKDTree(initial_state(scene, meshes, 0).pos)
    touching = nearest.query_pairs(1.01 * 2 * scene.grains.radius_m)
    assert 2 * len(touching) / 100 > 6  # 12 in the bulk of a close packing, fewer at its surface


def test_one_grain_is_possible() -> None:
    assert initial_state(*make("dense", 1), 0).pos.shape == (1, 3)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"arrangement": "random", "count": 2000}, "of 2000 grains"),
        ({"arrangement": "dense", "count": 5000}, "5000 grains"),
        ({"arrangement": "random", "z_min_m": 0.6}, "region for grain centres is empty"),
    ],
)
def test_too_many_grains_are_refused_with_a_remedy(arguments, told) -> None:
    with pytest.raises(GeometryError, match=rf"{told}[\s\S]*remedy: +lower scene\.grains\.count"):
        initial_state(*make(**arguments), 0)


@pytest.mark.parametrize("region", [{}, {"region_m": [[-0.2, -0.2, -0.2], [0.2, 0.2, 0.2]]}])
def test_a_mesh_file_with_a_hole_is_refused(region, tmp_path) -> None:
    box = trimesh.creation.box([1.0, 1.0, 1.0])
    box.update_faces(np.arange(len(box.faces)) > 0)
    box.export(tmp_path / "open.stl")
    scene, meshes = make("random", shape={"kind": "file", "path": str(tmp_path / "open.stl")}, **region)
    with pytest.raises(GeometryError, match=r"^scene\.boundary\.walls\n[\s\S]*3 open edges[\s\S]*close the holes"):
        initial_state(scene, meshes, 0)


@pytest.mark.parametrize("arrangement", ["random", "dense"])
class TestRegion:
    def test_a_floor_alone_needs_a_region(self, arrangement) -> None:
        with pytest.raises(GeometryError, match=r"^scene\.initial\.region_m\n[\s\S]*nothing encloses[\s\S]*walls"):
            initial_state(*make(arrangement, shape=FLOOR), 0)

    def test_grains_lie_in_the_region_and_above_the_floor(self, arrangement) -> None:
        region = [[-0.1, -0.1, -0.1], [0.1, 0.1, 0.2]]
        pos = initial_state(*make(arrangement, shape=FLOOR, region_m=region), 0).pos
        assert (np.abs(pos[:, :2]) <= 0.1).all()
        assert (np.abs(pos[:, 2]) >= scenes.RADIUS_M).all()

    def test_a_region_narrows_what_encloses_grains(self, arrangement) -> None:
        region = [[-1.0, -1.0, 0.2], [0.0, 1.0, 1.0]]
        scene, meshes = make(arrangement, region_m=region)
        pos = initial_state(scene, meshes, 0).pos
        assert clear(scene, meshes, pos)
        assert pos[:, 0].max() <= 0
        assert pos[:, 2].min() >= 0.2

    def test_no_grain_starts_beyond_the_outlet(self, arrangement) -> None:
        scene, meshes = make(arrangement)
        scene = replace(scene, outlet=Outlet([0.0, 0.0, 0.25], [0.0, 0.0, -2.0]))
        assert initial_state(scene, meshes, 0).pos[:, 2].min() >= 0.25


@settings(max_examples=10, deadline=None)
@given(
    arrangement=st.sampled_from(["random", "dense"]),
    share=st.sampled_from([[], [0.5, 0.5], [0.1, 0.9], [0.25, 0.75]]),
    case=st.integers(0, 50),
)
def test_several_radii_do_not_overlap_are_as_many_as_their_share_says_and_are_shuffled(
    arrangement, share, case
) -> None:
    scene, meshes = make(arrangement)
    scene = replace(scene, grains=replace(scene.grains, radius_m=[0.01, 0.006], share=share))
    start = initial_state(scene, meshes, case)
    of_each = {radius: int((start.radius == radius).sum()) for radius in (0.01, 0.006)}
    assert of_each == dict(scene.grains.counts)
    assert of_each[0.01] == pytest.approx(60 * (share or [0.5])[0], abs=1)
    touching = start.radius[:, None] + start.radius
    assert (pdist(start.pos) >= squareform(touching, checks=False)).all()
    walls = meshes["walls"]
    assert (distance(walls, start.pos) >= start.radius).all()
    assert not np.array_equal(start.radius, np.sort(start.radius)[::-1])
    assert not np.array_equal(start.radius, initial_state(scene, meshes, case + 1).radius)


def test_grains_that_enter_later_wait_where_they_will_enter() -> None:
    scene, meshes = make("random")
    scene = replace(scene, inlet=Inlet(20, 100.0, [0.0, 0.0, 0.39], [0.1, 0.1], [0.0, 0.0, -1.0]))
    start = initial_state(scene, meshes, 0)
    assert start.active.tolist() == [True] * 40 + [False] * 20
    assert (start.pos[40:] == entries(scene).pos).all()
    assert not start.vel[40:].any()
