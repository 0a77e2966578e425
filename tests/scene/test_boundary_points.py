"""Boundary points: exact number, evenly spread, leaving no hole that a grain could leak through, normals inwards."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hydra import compose, initialize_config_dir
from scipy.spatial import cKDTree

import gns_pyg
from gns_pyg.errors import ConfigError, GeometryError
from gns_pyg.scene.boundary_points import (
    LARGEST_HOLE,
    BoundaryPoints,
    check_density,
    sample_boundary_points,
    sufficient_points,
)
from gns_pyg.scene.mesh import build_mesh, container, distance, inside
from gns_pyg.scene.scene import Scene

SCENES = ("hopper", "drum", "hopper_small", "drum_small", "drum_bidisperse", "hopper_discharge", "silo_stl", "pile")
CUTOFF_RADII = 2.5  # the paper's cutoff


@cache
def sampled(name: str):
    """(scene, mesh, points, spacing of the densest packing) of the scene's one part."""
    with initialize_config_dir(str(Path(gns_pyg.__file__).parent / "conf"), version_base=None):
        scene = Scene.from_config(compose(overrides=[f"+scene={name}"]).scene)
    ((part_name, part),) = scene.boundary.items()
    mesh = build_mesh(part_name, part)
    spacing = np.sqrt(2 * mesh.area / (np.sqrt(3) * part.points))
    return scene, mesh, sample_boundary_points(mesh, part.points, seed=scene.seed), spacing


@pytest.mark.parametrize("name", SCENES)
def test_points_are_as_many_as_asked_lie_on_the_surface_and_keep_apart(name) -> None:
    scene, mesh, points, spacing = sampled(name)
    assert len(points.pos) == len(points.normal) == next(iter(scene.boundary.values())).points
    assert distance(mesh, points.pos) == pytest.approx(0, abs=1e-9)
    assert cKDTree(points.pos).query(points.pos, k=2)[0][:, 1].min() > 0.66 * spacing


@pytest.mark.parametrize("name", SCENES)
def test_no_hole_is_larger_than_the_module_promises(name) -> None:
    _, mesh, points, spacing = sampled(name)
    surface = trimesh.sample.sample_surface(mesh, 100_000, seed=1)[0]
    assert cKDTree(points.pos).query(surface)[0].max() < LARGEST_HOLE * spacing


@pytest.mark.parametrize("name", SCENES)
def test_a_grain_that_touches_the_wall_anywhere_sees_a_point(name) -> None:
    scene, mesh, points, _ = sampled(name)
    radius = scene.grains.radii_m[0]
    surface, triangle = trimesh.sample.sample_surface(mesh, 100_000, seed=1)
    centre = surface + (-radius if mesh.is_watertight else radius) * mesh.face_normals[triangle]
    fits = distance(mesh, centre) > radius * (1 - 1e-6)  # not in a corner narrower than the grain
    assert cKDTree(points.pos).query(centre[fits])[0].max() < CUTOFF_RADII * radius


@pytest.mark.parametrize("name", SCENES)
def test_normals_are_unit_and_point_inwards(name) -> None:
    scene, _, points, _ = sampled(name)
    assert np.linalg.norm(points.normal, axis=1) == pytest.approx(1)
    within, closed = points.pos + 1e-6 * points.normal, container(*next(iter(scene.boundary.items())))
    assert (within[:, 2] > 0).all() if closed is None else inside(closed, within).all()


def test_the_same_seed_gives_the_same_points_and_another_gives_others() -> None:
    mesh = trimesh.creation.box([1.0, 1.0, 1.0])
    first, again, other = (sample_boundary_points(mesh, 200, seed) for seed in (3, 3, 4))
    assert (first.pos == again.pos).all()
    assert (first.pos != other.pos).any()


def test_normals_of_an_open_part_follow_its_winding() -> None:
    plate = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    assert sample_boundary_points(plate, 20).normal == pytest.approx(np.tile([0.0, 0.0, 1.0], (20, 1)))


@pytest.mark.parametrize("n", [1, 2])
def test_few_points_are_possible(n) -> None:
    assert len(sample_boundary_points(trimesh.creation.box([1.0, 1.0, 1.0]), n).pos) == n


def test_no_points_at_all_are_refused() -> None:
    with pytest.raises(ConfigError, match="points"):
        sample_boundary_points(trimesh.creation.box([1.0, 1.0, 1.0]), 0)


def test_the_sufficient_number_closes_every_hole() -> None:
    mesh, radius = trimesh.creation.box([0.3, 0.3, 0.3]), 0.01
    points = sample_boundary_points(mesh, sufficient_points(mesh, radius, CUTOFF_RADII * radius))
    surface, triangle = trimesh.sample.sample_surface(mesh, 50_000, seed=1)
    centre = surface - radius * mesh.face_normals[triangle]
    assert cKDTree(points.pos).query(centre[distance(mesh, centre) > 0.999 * radius])[0].max() < CUTOFF_RADII * radius


@pytest.mark.parametrize("name", SCENES)
def test_our_scenes_have_points_enough_and_a_third_of_them_is_too_few(name) -> None:
    scene, mesh, points, _ = sampled(name)
    radius = scene.grains.radii_m[0]
    check_density("walls", points, mesh, CUTOFF_RADII * radius, radius)
    few = sample_boundary_points(mesh, len(points.pos) // 3, seed=scene.seed)
    with pytest.raises(GeometryError, match=r"scene\.boundary\.walls\.points\n") as caught:
        check_density("walls", few, mesh, CUTOFF_RADII * radius, radius)
    assert f"{len(few.pos)} points" in caught.value.found
    enough = int(caught.value.remedy.split("points=")[1].split(",")[0])
    assert enough > len(few.pos)
    check_density("walls", sample_boundary_points(mesh, enough), mesh, CUTOFF_RADII * radius, radius)


def test_one_hole_among_many_points_is_found() -> None:
    mesh = trimesh.creation.box([0.3, 0.3, 0.3])
    points = sample_boundary_points(mesh, 3 * sufficient_points(mesh, 0.01, 0.025))
    far = np.linalg.norm(points.pos - [0.15, 0.0, 0.0], axis=1) > 0.03
    check_density("box", points, mesh, 0.025, 0.01)
    with pytest.raises(GeometryError, match=r"scene\.boundary\.box\.points"):
        check_density("box", BoundaryPoints(points.pos[far], points.normal[far]), mesh, 0.025, 0.01)


def test_a_cutoff_within_a_grain_sees_no_wall() -> None:
    mesh = trimesh.creation.box([0.3, 0.3, 0.3])
    with pytest.raises(ConfigError, match=r"model\.cutoff_wall_radii"):
        check_density("box", sample_boundary_points(mesh, 10), mesh, 0.01, 0.01)
