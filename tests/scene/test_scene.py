"""Scenes: every value out of range is refused by its key, every scene of the package is accepted."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_dir

import gns_pyg
from gns_pyg.errors import ConfigError
from gns_pyg.scene.scene import Scene
from tests import scenes

CONF = Path(gns_pyg.__file__).parent / "conf"
DRUM: dict[str, Any] = {
    "shape": {"kind": "cylinder", "radius_m": 1, "length_m": 1},
    "points": 10,
    "friction_angle_rad": 0.5,
    "motion": {"kind": "rotation", "axis": [1, 0, 0], "rate_rad_s": 3},
}
GOOD = asdict(scenes.scene(5, 11, boundary={"drum": DRUM}, angle_of_repose={"kind": "plane", "from_s": 0}))


def changed(key: str, value: Any) -> dict[str, Any]:
    def put(record: dict[str, Any], words: list[str]) -> dict[str, Any]:
        return record | {words[0]: value if len(words) == 1 else put(record[words[0]], words[1:])}

    return put(GOOD, key.split("."))


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONF / "scene").glob("*.yaml")))
def test_the_scenes_of_the_package_are_accepted(name) -> None:
    with initialize_config_dir(str(CONF), version_base=None):
        assert Scene.from_config(compose(overrides=[f"+scene={name}"]).scene).name == name


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("gravity_m_s2", [0, 0, 0]),
        ("seed", 0),
        ("cases", 1),
        ("duration_s", 0.01),
        ("initial.speed_max_m_s", 0),
        ("grains.material.friction_angle_rad", 0),
        ("boundary.drum.friction_angle_rad", 0),
        ("boundary.drum.points", 1),
        ("boundary.drum.motion.rate_rad_s", -3),
        ("boundary", {}),
        ("dem.verlet_distance_ratio", 0),
        ("dem.dt_s", 1e-5),
        ("dem.dt_s", "auto"),
        ("angle_of_repose", None),
        ("angle_of_repose.kind", "radial"),
    ],
)
def test_values_at_the_edge_are_accepted(key, value) -> None:
    Scene.from_config(changed(key, value))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("gravity_m_s2", [0, 0, np.nan]),
        ("gravity_m_s2", [0, -9.81]),
        ("seed", -1),
        ("cases", 0),
        ("duration_s", 0.005),
        ("duration_s", np.inf),
        ("frame_dt_s", 0),
        ("damping", np.nan),
        ("grains.material.poisson_ratio", 0),
        ("grains.material.poisson_ratio", np.inf),
        ("grains.material.friction_angle_rad", -0.1),
        ("grains.material.friction_angle_rad", np.pi / 2),
        ("grains.material.friction_angle_rad", np.nan),
        ("initial.speed_max_m_s", -0.5),
        ("initial.speed_max_m_s", np.nan),
        ("boundary.drum.points", 0),
        ("boundary.drum.friction_angle_rad", 30),
        ("boundary.drum.motion.kind", "spin"),
        ("boundary.drum.motion.axis", [0, 0, 0]),
        ("boundary.drum.motion.origin_m", [0, np.nan, 0]),
        ("boundary.drum.motion.rate_rad_s", np.inf),
        ("dem.verlet_distance_ratio", -0.1),
        ("dem.dt_s", 0),
        ("dem.dt_s", "soon"),
        ("angle_of_repose.kind", "steep"),
        ("angle_of_repose.axis", [0, 0, 0]),
        ("angle_of_repose.axis", [1, 0]),
        ("angle_of_repose.from_s", -1),
    ],
)
def test_a_value_out_of_range_is_refused_by_its_key(key, value) -> None:
    with pytest.raises(ConfigError, match=rf"^scene\.{key}\n"):
        Scene.from_config(changed(key, value))


@pytest.mark.parametrize("name", ["two words", "1st", "a/b", ""])
def test_a_part_needs_a_name_that_can_be_a_key(name) -> None:
    with pytest.raises(ConfigError, match="Python identifier"):
        Scene.from_config(changed("boundary", {name: DRUM}))
