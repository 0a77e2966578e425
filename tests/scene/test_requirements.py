"""What a scene requires follows from the scene; forcing off what it has is refused."""

import pytest

from gns_pyg.errors import ConfigError
from gns_pyg.scene.requirements import LOST, STATES, Requires, check_covers, resolve
from tests import scenes

BOX = {"shape": scenes.BOX, "points": 200, "friction_angle_rad": 0.5}
TURNING = BOX | {"motion": {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 3.0}}
GRAINS = {
    "count": 10,
    "radius_m": [0.008, 0.012],
    "material": {
        "density_kg_m3": 1000.0,
        "young_modulus_pa": 1e6,
        "poisson_ratio": 0.25,
        "friction_angle_rad": 0.5,
    },
}
OUTLET = {"point_m": [0.0, 0.0, -1.0], "normal": [0.0, 0.0, -1.0]}


def required(parameters=None, forced=None, **changes):
    return resolve(scenes.scene(10, 5, **changes), parameters or {}, Requires(**(forced or {})))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {"wall_network": True, "wall_velocity": False, "static_walls": True, "wall_friction": False}),
        ({"boundary": {}}, {"wall_network": False, "wall_velocity": False}),
        ({"boundary": {"still": BOX, "drum": TURNING}}, {"wall_network": True, "wall_velocity": True}),
        ({"boundary": {"a": BOX, "b": BOX | {"friction_angle_rad": 0.2}}}, {"wall_friction": True}),
        ({}, {"radius_features": False, "material_features": [], "active_mask": False, "free_grains": True}),
        ({"grains": GRAINS}, {"radius_features": True}),
        ({"outlet": OUTLET}, {"active_mask": True}),
        ({"state": "velocity"}, {"state": "velocity"}),
        ({"boundary": {"drum": TURNING}}, {"symmetry": True}),  # reflection along the drum's axis
        ({"gravity_m_s2": [1.0, 2.0, -9.0]}, {"symmetry": False}),
    ],
)
def test_rows_follow_from_the_scene(changes, expected):
    found = required(**changes)
    assert {row: getattr(found, row) for row in expected} == expected


def test_varying_parameters_condition_the_model():
    values = {"friction_angle_rad": [0.3, 0.5], "damping": [0.2], "density_kg_m3": [900.0, 1000.0]}
    assert required(values).material_features == ["density_kg_m3", "friction_angle_rad"]


@pytest.mark.parametrize("row", [row for row in Requires.__dataclass_fields__ if row != "state"])
def test_every_row_can_be_forced(row):
    has_all = {"outlet": OUTLET, "grains": GRAINS, "boundary": {"a": BOX, "b": TURNING | {"friction_angle_rad": 0.2}}}
    plain = {"boundary": {}, "gravity_m_s2": [0.0, 0.0, -9.81]}
    if row == "symmetry":
        has_all = {}
    walled = row in ("wall_velocity", "wall_friction", "static_walls", "reachable_points", "nearest_points")
    assert getattr(required(forced={row: True} | ({"wall_network": True} if walled else {}), **plain), row)
    if walled:
        with pytest.raises(ConfigError, match="a wall network to carry it"):
            required(forced={row: True}, **plain)
    if row in LOST:
        with pytest.raises(ConfigError, match=LOST[row]):
            required(forced={row: False}, **has_all)
        return
    assert not getattr(required({"damping": [0.1, 0.2]}, {row: False}, **has_all), row)


@pytest.mark.parametrize("state", STATES)
def test_state_can_be_forced(state):
    assert required(forced={"state": state}).state == state


@pytest.mark.parametrize(
    ("forced", "message"),
    [
        ({"wall_network": "maybe"}, "requires.wall_network"),
        ({"state": "momentum"}, "requires.state"),
        ({"free_flight": False, "free_grains": True}, "requires.free_grains"),
        ({"free_grains": False, "touching_pairs": True}, "requires.touching_pairs"),
    ],
)
def test_bad_forcing(forced, message):
    with pytest.raises(ConfigError, match=message):
        required(forced=forced)


def test_a_symmetry_that_is_not_there_cannot_be_forced():
    with pytest.raises(ConfigError, match="requires.symmetry"):
        required(forced={"symmetry": True}, gravity_m_s2=[1.0, 2.0, -9.0])


def test_the_record_says_why():
    text = str(required())
    assert "no moving part: boundary placed and its search built once" in text
    assert "one radius: no radius feature" in text
    assert "forced" in str(required(forced={"wall_velocity": True}))


def test_a_model_must_cover_the_scene_it_is_taken_to():
    still = required()
    check_covers(still, scenes.scene(10, 5, gravity_m_s2=[1.0, 0.0, -9.0]))
    with pytest.raises(ConfigError, match="wall_velocity"):
        check_covers(still, scenes.scene(10, 5, boundary={"drum": TURNING}))
    check_covers(still, scenes.scene(10, 5, outlet=OUTLET))  # who is there is no matter of weights
