"""Meshes: closed where they must be, the winding number against analytic bodies, distances, every user error."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_pyg.errors import ConfigError, GeometryError
from gns_pyg.scene.mesh import build_mesh, container, distance, inside, same_mesh
from gns_pyg.scene.scene import Part

PROFILE = [[0.25, 0.0], [0.25, 0.3], [0.1, 0.45], [0.25, 0.6], [0.25, 0.9]]


def part(**shape) -> Part:
    return Part(shape=shape, points=100, friction_angle_rad=0.5)


def hopper(segments: int = 96):
    return build_mesh("hopper", part(kind="revolution", profile_m=PROFILE, segments=segments))


@pytest.mark.parametrize(
    ("shape", "volume", "area"),
    [
        ({"kind": "box", "size_m": [1.0, 2.0, 3.0], "center_m": [5.0, 0.0, 0.0]}, 6.0, 22.0),
        (
            {"kind": "cylinder", "radius_m": 0.5, "length_m": 2.0, "axis": [1, 1, 0], "segments": 400},
            np.pi / 2,
            2.5 * np.pi,
        ),
        (
            {"kind": "revolution", "profile_m": [[0.0, 0.0], [1.0, 1.0]], "segments": 400},
            np.pi / 3,
            np.pi * (1 + 2**0.5),
        ),
    ],
)
def test_primitives_are_closed_and_have_the_volume_and_area_of_their_body(shape, volume, area) -> None:
    mesh = build_mesh("body", part(**shape))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(volume, rel=1e-3)
    assert mesh.area == pytest.approx(area, rel=1e-3)


@pytest.mark.parametrize(
    "shape",
    [
        {"kind": "box", "size_m": [1, 2, 3], "center_m": [5, 0, 0]},
        {"kind": "cylinder", "radius_m": 1, "length_m": 2, "axis": [1, 0, 0]},
        {"kind": "revolution", "profile_m": [[0.1, 0], [1, 2]]},
    ],
)
def test_whole_numbers_are_numbers(shape) -> None:
    def decimal(value):
        return [decimal(item) for item in value] if isinstance(value, list) else float(value)

    exact = {"kind": shape["kind"]} | {key: decimal(value) for key, value in shape.items() if key != "kind"}
    mesh, other = build_mesh("body", part(**shape)), build_mesh("body", part(**exact))
    assert (mesh.triangles == other.triangles).all()


def test_the_same_mesh_is_the_same_triangles_however_their_corners_are_numbered() -> None:
    mesh = hopper(12)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    renumbered = {"vertices": mesh.vertices[order], "triangles": np.argsort(order)[mesh.faces]}
    assert same_mesh(renumbered, mesh)
    assert not same_mesh(renumbered | {"vertices": mesh.vertices[order] + 1e-8}, mesh)
    assert not same_mesh(renumbered | {"triangles": renumbered["triangles"][1:]}, mesh)


def test_a_cylinder_lies_along_its_axis_around_the_origin() -> None:
    mesh = build_mesh("drum", part(kind="cylinder", radius_m=0.15, length_m=0.6, axis=[-2.0, 0.0, 0.0], segments=72))
    assert mesh.bounds[:, 0] == pytest.approx([-0.3, 0.3])
    assert np.hypot(mesh.vertices[:, 1], mesh.vertices[:, 2]).max() == pytest.approx(0.15)


def test_inside_agrees_with_the_analytic_hopper() -> None:
    pos = np.random.default_rng(0).uniform([-0.3, -0.3, -0.1], [0.3, 0.3, 1.0], (20_000, 3))
    radius, allowed = np.hypot(pos[:, 0], pos[:, 1]), np.interp(pos[:, 2], *np.array(PROFILE)[:, ::-1].T)
    within = (radius < allowed) & (pos[:, 2] > 0) & (pos[:, 2] < 0.9)
    clear = np.abs(radius - allowed) > 0.001  # the polygon's sides lie within 0.2 mm of the circle
    assert (inside(hopper(), pos) == within)[clear].all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_inside_does_not_depend_on_where_a_body_lies_and_how_it_is_wound(seed) -> None:
    generator = np.random.default_rng(seed)
    mesh, pos = hopper(12), generator.uniform(-0.3, 0.9, (200, 3))
    pose = trimesh.transformations.random_rotation_matrix(generator.uniform(size=3))
    pose[:3, 3] = generator.uniform(-5, 5, 3)
    moved = mesh.copy().apply_transform(pose)
    assert (inside(moved, trimesh.transform_points(pos, pose)) == inside(mesh, pos)).all()


def test_inside_is_the_same_in_one_block_and_in_many(monkeypatch) -> None:
    pos = np.random.default_rng(0).uniform(-0.3, 0.9, (500, 3))
    whole = inside(hopper(12), pos), distance(hopper(12), pos)
    monkeypatch.setattr("gns_pyg.scene.mesh.BLOCK", 1)
    assert (inside(hopper(12), pos) == whole[0]).all()
    assert distance(hopper(12), pos) == pytest.approx(whole[1])


def test_no_points_give_no_answers() -> None:
    assert inside(hopper(12), np.zeros((0, 3))).shape == (0,)
    assert distance(hopper(12), np.zeros((0, 3))).shape == (0,)


def test_distance_to_a_box_is_exact_on_both_sides() -> None:
    mesh = build_mesh("box", part(kind="box", size_m=[2.0, 2.0, 2.0]))
    pos = np.random.default_rng(0).uniform(-2, 2, (2000, 3))
    outside = np.linalg.norm(np.maximum(np.abs(pos) - 1, 0), axis=1)
    within = np.clip(1 - np.abs(pos).max(axis=1), 0, None)
    assert distance(mesh, pos) == pytest.approx(outside + within, abs=1e-12)


def test_distance_to_any_mesh_is_that_of_its_nearest_surface_point() -> None:
    mesh = hopper(12)
    surface = trimesh.sample.sample_surface(mesh, 200_000, seed=0)[0]
    pos = np.random.default_rng(1).uniform(-0.3, 0.9, (50, 3))
    sampled = np.array([np.linalg.norm(surface - point, axis=1).min() for point in pos])
    assert (sampled >= distance(mesh, pos) - 1e-12).all()
    assert sampled == pytest.approx(distance(mesh, pos), abs=0.01)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_a_mesh_file_is_the_same_body_in_the_unit_that_scale_says(tmp_path, suffix) -> None:
    path = tmp_path / f"box.{suffix}"
    trimesh.creation.box([200.0, 100.0, 50.0]).export(path)
    mesh = build_mesh("box", part(kind="file", path=str(path), scale=0.001))
    assert mesh.is_watertight
    assert mesh.extents == pytest.approx([0.2, 0.1, 0.05])


def test_a_file_whose_normals_point_inwards_is_refused(tmp_path) -> None:
    box = trimesh.creation.box([1.0, 1.0, 1.0])
    box.invert()
    box.export(tmp_path / "box.stl")
    with pytest.raises(GeometryError, match=r"box\.stl\n[\s\S]*point inwards[\s\S]*flip its normals"):
        build_mesh("box", part(kind="file", path=str(tmp_path / "box.stl")))


def test_the_package_s_own_file_is_found_from_anywhere(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert build_mesh("silo", part(kind="file", path="conf/scene/silo.stl", scale=0.001)).is_watertight


def test_a_floor_is_flat_where_it_is_put_and_faces_up() -> None:
    floor = part(kind="floor", size_m=[2, 3], center_m=[1, 0, 0.5])
    mesh = build_mesh("floor", floor)
    assert mesh.bounds == pytest.approx(np.array([[0.0, -1.5, 0.5], [2.0, 1.5, 0.5]]))
    assert mesh.face_normals == pytest.approx(np.tile([0.0, 0.0, 1.0], (2, 1)))
    assert container("floor", floor) is None


def test_an_open_bottom_lacks_the_lower_lid_alone_and_faces_the_grains() -> None:
    shape = {"kind": "revolution", "profile_m": [[0.1, 0.0], [0.2, 0.3]], "segments": 24}
    closed, opened = (build_mesh("hopper", part(**shape, open_bottom=o)) for o in (False, True))
    lid = closed.area_faces[(closed.triangles[:, :, 2] == 0).all(axis=1)].sum()
    assert lid > 0
    assert opened.area == pytest.approx(closed.area - lid)
    assert not opened.is_watertight
    within = opened.triangles_center + 1e-4 * opened.face_normals
    assert inside(closed, within).all()
    assert same_mesh({"vertices": closed.vertices, "triangles": closed.faces}, container("hopper", part(**shape)))
    assert container("hopper", part(**shape, open_bottom=True)).volume == pytest.approx(closed.volume)


@pytest.mark.parametrize("closed", [True, False])
def test_a_file_of_mixed_winding_is_refused(tmp_path, closed) -> None:
    box = trimesh.creation.box([1.0, 1.0, 1.0])
    faces = np.array(box.faces)
    faces[5] = faces[5, ::-1]
    trimesh.Trimesh(box.vertices, faces if closed else faces[:8], process=False).export(tmp_path / "box.stl")
    with pytest.raises(GeometryError, match=r"box\.stl\n[\s\S]*opposite ways"):
        build_mesh("box", part(kind="file", path=str(tmp_path / "box.stl")))


def test_an_open_surface_has_no_inside_and_the_error_counts_its_open_edges(tmp_path) -> None:
    box = trimesh.creation.box([1.0, 1.0, 1.0])
    box.update_faces(np.arange(len(box.faces)) > 0)
    box.export(tmp_path / "open.stl")
    mesh = build_mesh("box", part(kind="file", path=str(tmp_path / "open.stl")))
    with pytest.raises(GeometryError, match=r"3 open edges[\s\S]*close the holes"):
        inside(mesh, np.zeros((1, 3)))
    with pytest.raises(GeometryError, match=r"^scene\.boundary\.box\n[\s\S]*open\.stl: 3 open edges"):
        container("box", part(kind="file", path=str(tmp_path / "open.stl")))


@pytest.mark.parametrize(
    ("shape", "key"),
    [
        ({}, "shape.kind"),
        ({"kind": "sphere"}, "shape.kind"),
        ({"kind": ["box"]}, "shape.kind"),
        ({"kind": "cylinder", "radius_m": 1.0}, "shape.length_m"),
        ({"kind": "cylinder", "radius_m": 1.0, "length_m": 1.0, "radios_m": 2.0}, "shape.radios_m"),
        ({"kind": "cylinder", "radius_m": -1.0, "length_m": 1.0}, "shape.radius_m"),
        ({"kind": "cylinder", "radius_m": np.inf, "length_m": 1.0}, "shape.radius_m"),
        ({"kind": "cylinder", "radius_m": 1.0, "length_m": np.nan}, "shape.length_m"),
        ({"kind": "cylinder", "radius_m": 1.0, "length_m": 0}, "shape.length_m"),
        ({"kind": "cylinder", "radius_m": 1.0, "length_m": 1.0, "axis": [1, 0, np.nan]}, "shape.axis"),
        ({"kind": "cylinder", "radius_m": 1.0, "length_m": "long"}, "shape.length_m"),
        ({"kind": "cylinder", "radius_m": 1.0, "length_m": 1.0, "axis": [0, 0, 0]}, "shape.axis"),
        ({"kind": "revolution", "profile_m": [[1.0, 0.0]]}, "shape.profile_m"),
        ({"kind": "revolution", "profile_m": [[1.0, 0.0], [-1.0, 1.0]]}, "shape.profile_m"),
        ({"kind": "revolution", "profile_m": [[1.0, 0.0], [np.inf, 1.0]]}, "shape.profile_m"),
        ({"kind": "revolution", "profile_m": [[1.0, 0.0], ["a", 1.0]]}, "shape.profile_m"),
        ({"kind": "revolution", "profile_m": [[1.0, 0.0], 1.0]}, "shape.profile_m"),
        ({"kind": "revolution", "profile_m": [[1.0, 0.0], "12"]}, "shape.profile_m"),
        ({"kind": "revolution", "profile_m": [[0, 0], [0, 1]]}, "shape.profile_m"),
        ({"kind": "revolution", "profile_m": [[1, 0], [2, 0]]}, "shape.profile_m"),
        ({"kind": "revolution", "profile_m": PROFILE, "segments": 2}, "shape.segments"),
        ({"kind": "box", "size_m": [1.0, 1.0]}, "shape.size_m"),
        ({"kind": "box", "size_m": [1.0, 1.0, np.inf]}, "shape.size_m"),
        ({"kind": "box", "size_m": [1.0, 1.0, 0.0]}, "shape.size_m"),
        ({"kind": "box", "size_m": [1.0, 1.0, 1.0], "center_m": [0, 0, np.nan]}, "shape.center_m"),
        ({"kind": "floor", "size_m": [1.0]}, "shape.size_m"),
        ({"kind": "floor", "size_m": [1.0, 0.0]}, "shape.size_m"),
        ({"kind": "floor", "size_m": [1.0, 1.0], "center_m": [0.0, 0.0]}, "shape.center_m"),
        ({"kind": "file", "path": __file__, "scale": np.inf}, "shape.scale"),
        ({"kind": "file", "path": "nowhere/drum.stl"}, "shape.path"),
    ],
)
def test_a_wrong_shape_is_named_by_its_key(shape, key) -> None:
    with pytest.raises(ConfigError, match=f"scene.boundary.drum.{key}"):
        build_mesh("drum", part(**shape))


def test_a_file_that_is_no_mesh_is_refused(tmp_path) -> None:
    (tmp_path / "drum.stl").write_text("solid nothing\nendsolid nothing\n")
    with pytest.raises(GeometryError, match=r"drum\.stl"):
        build_mesh("drum", part(kind="file", path=str(tmp_path / "drum.stl")))


def test_a_part_as_large_as_nothing_on_earth_is_refused() -> None:
    """Squares of such lengths are no numbers any more."""
    with pytest.raises(ConfigError, match=r"scene\.boundary\.walls\.shape"):
        build_mesh("walls", part(kind="box", size_m=[1e200, 1.0, 1.0]))
