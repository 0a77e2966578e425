"""Who has left the boundary: in the frame of walls that move, above an open bottom, where nothing encloses."""

import numpy as np
import pytest
import torch
import trimesh

from gns_pyg.errors import GeometryError
from gns_pyg.scene.containment import outside
from gns_pyg.scene.motion import to_world
from gns_pyg.scene.scene import Scene
from tests import scenes

BOX = {"kind": "box", "size_m": [0.4, 0.2, 0.1]}
AXIS = {"axis": [1.0, 2.0, 3.0]}


def scene(shape: dict, motion: dict | None = None) -> Scene:
    part = {"shape": shape, "points": 10, "friction_angle_rad": 0.5}
    return scenes.scene(2, 11, boundary={"box": part | ({"motion": motion | AXIS} if motion else {})})


@pytest.mark.parametrize(
    "motion",
    [
        None,
        {"kind": "rotation", "rate_rad_s": 30.0, "origin_m": [1.0, 0.0, 0.0]},
        {"kind": "rotation", "function": "20 * t**2"},
        {"kind": "translation", "speed_m_s": 5.0},
        {"kind": "translation", "function": "exp(10 * t) - 1"},
        {"kind": "oscillation", "amplitude_m": 0.5, "frequency_hz": 20.0},
    ],
)
def test_what_moves_with_the_wall_stays_where_it_is(motion) -> None:
    moving, times_s = scene(BOX, motion), 0.01 * np.arange(11)
    body = np.random.default_rng(0).uniform([-0.3, -0.15, -0.08], [0.3, 0.15, 0.08], (200, 3))
    beyond = (np.abs(body) > np.array(BOX["size_m"]) / 2).any(axis=1)
    pos = [
        to_world(moving.boundary["box"].motion, torch.from_numpy(body), torch.full((200,), t, dtype=torch.float64))[0]
        for t in times_s
    ]
    assert (outside(np.stack(pos), times_s, moving) == beyond).all()


def test_nothing_is_outside_where_nothing_encloses() -> None:
    pos = np.random.default_rng(0).uniform(-1, 1, (3, 50, 3))
    assert not outside(pos, np.zeros(3), scene({"kind": "floor", "size_m": [0.1, 0.1]})).any()
    assert not outside(pos, np.zeros(3), scenes.scene(50, 3, boundary={})).any()


def test_below_an_open_bottom_is_not_outside_but_beside_it_is() -> None:
    shape = {"kind": "revolution", "profile_m": [[0.1, 0.0], [0.1, 0.3]]}
    pos = np.array([[[0.0, 0.0, 0.1], [0.0, 0.0, -0.1], [0.2, 0.0, 0.1], [0.0, 0.0, 0.4]]])
    assert outside(pos, np.zeros(1), scene(shape | {"open_bottom": True}))[0].tolist() == [False, False, True, True]
    assert outside(pos, np.zeros(1), scene(shape))[0].tolist() == [False, True, True, True]


def test_a_mesh_file_with_a_hole_has_no_outside(tmp_path) -> None:
    box = trimesh.creation.box([1.0, 1.0, 1.0])
    box.update_faces(np.arange(len(box.faces)) > 0)
    box.export(tmp_path / "open.stl")
    with pytest.raises(GeometryError, match=r"^scene\.boundary\.box\n[\s\S]*3 open edges"):
        outside(np.zeros((1, 1, 3)), np.zeros(1), scene({"kind": "file", "path": str(tmp_path / "open.stl")}))
