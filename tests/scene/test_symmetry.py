"""The symmetry of scenes whose symmetry is known."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from hydra import compose, initialize_config_dir

import gns_pyg
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene
from gns_pyg.scene.symmetry import symmetry
from tests import scenes

CONF = Path(gns_pyg.__file__).parent / "conf"
DOWN = [0.0, 0.0, -9.81]
CYLINDER = {"kind": "cylinder", "radius_m": 0.1, "length_m": 0.2, "segments": 24}
DRUM = CYLINDER | {"axis": [1.0, 0.0, 0.0]}
FLOOR = {"kind": "floor", "size_m": [0.4, 0.4], "center_m": [0.3, 0.1, 0.0]}
BOX = {"kind": "box", "size_m": [0.3, 0.2, 0.1]}
INLET = {"count": 1, "rate_per_s": 1.0, "center_m": [0.3, 0.1, 0.5], "size_m": [0.1, 0.1], "velocity_m_s": [0, 0, -1]}


def shipped(name):
    with initialize_config_dir(str(CONF), version_base=None):
        return Scene.from_config(compose(overrides=[f"+scene={name}"]).scene)


def of(*shapes: Any, motion: Any = None, gravity: Any = DOWN, **changes: Any):
    parts = {
        f"part_{n}": {"shape": shape, "points": 10, "friction_angle_rad": 0.5, "motion": motion or {}}
        for n, shape in enumerate(shapes)
    }
    return symmetry(scenes.scene(5, 11, boundary=parts, gravity_m_s2=gravity, **changes))


def rotation(axis, **changes):
    return {"kind": "rotation", "axis": axis, "rate_rad_s": 3.0} | changes


def region(low, high):
    return {"arrangement": "random", "speed_max_m_s": 0.0, "region_m": [low, high]}


def group(found):
    return found.fold, found.mirror is not None


def test_shipped_scenes():
    hopper, drum = symmetry(shipped("hopper_small")), symmetry(shipped("drum_small"))
    assert group(hopper) == (4, True)  # of 32 segments; its damping acts by axis
    assert hopper.describe() == "rotation about the vertical by multiples of 90 degrees, reflection"
    assert group(drum) == (1, True)
    np.testing.assert_allclose(np.abs(drum.mirror), [1, 0, 0], atol=1e-12)
    assert drum.describe() == "reflection along (1, 0, 0)"


def test_nothing_but_grains():
    assert group(of()) == (0, True)
    assert group(of(gravity=[0.0, 0.0, 0.0])) == (0, True)
    assert group(of(initial=region([0, 0, 0], [1, 1, 2]))) == (4, True)
    assert group(of(initial=region([0, 0, 0], [1, 2, 2]))) == (2, True)
    assert of().describe() == "rotation about the vertical by any angle, reflection"


def test_shapes():
    assert group(of(CYLINDER)) == (24, True)
    assert group(of(DRUM)) == (2, True)
    assert group(of(BOX)) == (2, True)
    assert group(of(FLOOR)) == (4, True)
    assert of(FLOOR).center_m == pytest.approx([0.3, 0.1, 0.0])


def test_everything_must_stay():
    assert group(of(FLOOR, initial=region([0.2, 0.0, 0.0], [0.4, 0.2, 1.0]))) == (4, True)
    assert group(of(FLOOR, initial=region([0.25, 0.0, 0.0], [0.35, 0.2, 1.0]))) == (2, True)
    assert group(of(FLOOR, initial=region([0.25, 0.05, 0.0], [0.4, 0.2, 1.0]))) == (1, True)  # a diagonal
    assert group(of(FLOOR, CYLINDER)) == (1, False)
    assert group(of(BOX, CYLINDER)) == (2, True)
    assert group(of(FLOOR, inlet=INLET)) == (1, False)  # grains enter at fixed places
    assert group(of(BOX, outlet={"point_m": [0, 0, -1], "normal": [0, 0, -1]})) == (2, True)
    assert group(of(BOX, outlet={"point_m": [1, 0, 0], "normal": [1, 0, 0]})) == (1, True)


def test_damping_acts_by_axis():
    assert group(of(CYLINDER, damping=0.1)) == (4, True)
    assert group(of(CYLINDER, vary={"damping": [0.0, 0.2]})) == (4, True)
    assert group(of(damping=0.1)) == (4, True)
    assert group(of(CYLINDER | {"axis": [1.0, 0.0, 1.0]}, damping=0.1)) == (1, True)
    assert group(of(CYLINDER | {"axis": [1.0, 0.3, 1.0]}, damping=0.1)) == (1, False)


def test_tilted_gravity_leaves_less():
    assert group(of(CYLINDER, gravity=[1.0, 0.0, -9.0])) == (1, True)
    assert group(of(CYLINDER, gravity=[1.0, 0.3, -9.0])) == (1, False)
    assert group(of(CYLINDER, gravity=[0.0, 0.0, 9.81])) == (24, True)
    assert of(CYLINDER, gravity=[1.0, 0.3, -9.0]).describe() == "none"


@pytest.mark.parametrize(
    ("shape", "motion", "expected"),
    [
        (DRUM, rotation([1, 0, 0]), (1, True)),
        (DRUM, rotation([1, 0, 0], rate_rad_s=0.0), (2, True)),
        (DRUM, rotation([1, 0, 0], rate_rad_s=0.0, function="0.2 * t**2"), (1, True)),
        (DRUM | {"axis": [1, 0, 0.1]}, rotation([1, 0, 0.1]), (1, False)),
        (CYLINDER, rotation([0, 0, 1]), (24, False)),  # a reflection turns it the other way
        (CYLINDER, rotation([0, 0, 1], origin_m=[0.01, 0, 0]), (1, False)),
        (CYLINDER, rotation([0, 1, 0]), (1, True)),
        (CYLINDER, {"kind": "translation", "axis": [0, 0, 1], "speed_m_s": 0.1}, (24, True)),
        (BOX, {"kind": "oscillation", "axis": [0, 1, 0], "amplitude_m": 0.1, "frequency_hz": 2.0}, (1, True)),
        (BOX, {"kind": "oscillation", "axis": [1, 1, 0], "amplitude_m": 0.1, "frequency_hz": 2.0}, (1, False)),
    ],
)
def test_motion(shape, motion, expected):
    assert group(of(shape, motion=motion)) == expected


def test_an_open_plate_keeps_its_side(tmp_path):
    """Turned by half a turn, or reflected in itself, a plate is where it was and the grains are behind it."""
    trimesh.Trimesh([[0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1]], [[0, 1, 2], [0, 2, 3]]).export(tmp_path / "p.stl")
    found = of({"kind": "file", "path": str(tmp_path / "p.stl")})
    assert group(found) == (1, True)
    np.testing.assert_allclose(np.abs(found.mirror), [0, 1, 0], atol=1e-12)


def test_a_mirror_at_any_angle_is_found(tmp_path):
    mesh = build_mesh("box", scenes.scene(5, 11).boundary["walls"]).apply_scale([1.0, 0.5, 0.2])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.4321, [0, 0, 1])).export(tmp_path / "box.ply")
    assert group(of({"kind": "file", "path": str(tmp_path / "box.ply")})) == (2, True)


def test_drawn_elements_are_of_the_group():
    found, random = of(CYLINDER), torch.Generator().manual_seed(0)
    drawn = found.draw(200, random)
    assert drawn.dtype == torch.float64
    torch.testing.assert_close(drawn @ drawn.mT, torch.eye(3, dtype=torch.float64).expand(200, 3, 3))
    up = torch.tensor(found.axis, dtype=torch.float64)
    torch.testing.assert_close(drawn @ up, up.expand(200, 3))
    assert 60 < int((torch.linalg.det(drawn) < 0).sum()) < 140
    assert len(np.unique(drawn.numpy().round(6) + 0.0, axis=0)) > 40  # of 48
    corners = torch.tensor(
        np.array(build_mesh("c", replace(scenes.scene(5, 11).boundary["walls"], shape=CYLINDER)).vertices)
    )
    images = torch.einsum("nij,vj->nvi", drawn, corners)
    assert torch.cdist(images, corners.expand(200, -1, -1)).min(2).values.max() < 1e-7


def test_nothing_is_drawn_from_nothing():
    drawn = of(FLOOR, CYLINDER).draw(3, torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn, torch.eye(3, dtype=torch.float64).expand(3, 3, 3))
