"""Initial states: without overlap, clear of the walls, reproducible, and refused when the grains do not fit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from data_gen.initial import initial_state
from gns_pyg.errors import GeometryError
from gns_pyg.scene.mesh import build_mesh, distance, inside
from gns_pyg.scene.scene import Scene
from tests import scenes

HOPPER = {"kind": "revolution", "profile_m": [[0.1, 0.0], [0.05, 0.1], [0.1, 0.2], [0.1, 0.4]], "segments": 16}
DRUM = {"kind": "cylinder", "radius_m": 0.1, "length_m": 0.15, "axis": [1.0, 0.0, 0.0], "segments": 24}


def make(arrangement: str, count: int = 60, seed: int = 0, shape: dict = HOPPER, **limits: float):
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


def test_grains_need_a_closed_part() -> None:
    scene, meshes = make("random")
    meshes["walls"].update_faces(np.arange(len(meshes["walls"].faces)) > 0)
    with pytest.raises(GeometryError, match="3 open edges"):
        initial_state(scene, meshes, 0)
