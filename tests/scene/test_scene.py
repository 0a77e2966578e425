"""Scenes: every value out of range is refused by its key, every scene of the package is accepted."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir

import gns_pyg
from gns_pyg.config import plain
from gns_pyg.errors import ConfigError
from gns_pyg.scene.inlet import entries
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene
from tests import scenes

CONF = Path(gns_pyg.__file__).parent / "conf"
ROOT = Path(__file__).parents[2]
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


SIZES = GOOD["grains"] | {"radius_m": [0.01, 0.02]}
INLET = {"count": 2, "rate_per_s": 10, "center_m": [0, 0, 1], "size_m": [0.1, 0.1], "velocity_m_s": [0, 0, -1]}


@pytest.mark.parametrize(
    ("key", "value", "where", "told"),
    [
        ("grains", SIZES | {"share": [0.5, 0.6]}, "grains.share", "1 in all"),
        ("grains", SIZES | {"share": [1.0]}, "grains.share", "each of the 2 radii"),
        ("grains", SIZES | {"share": [1.5, -0.5]}, "grains.share", "above 0"),
        ("grains", SIZES | {"radius_m": [0.01, 0.01]}, "grains.radius_m", "share"),
        ("grains", SIZES | {"radius_m": []}, "grains.radius_m", "above 0"),
        ("grains", SIZES | {"radius_m": [0.01, "big"]}, "grains.radius_m", "above 0"),
        ("grains.shape", "clump", "grains.shape", r"sphere[\s\S]*orientation and inertia[\s\S]*use spheres"),
        ("boundary.drum.motion", {"kind": "rotation", "rate_rad_s": 3}, "boundary.drum.motion.axis", "direction"),
        ("boundary.drum.motion.speed_m_s", 1, "boundary.drum.motion.speed_m_s", "kind=translation"),
        ("inlet", {k: v for k, v in INLET.items() if k != "rate_per_s"}, "inlet.rate_per_s", "grains per second"),
        ("inlet", INLET | {"rate_per_s": 0}, "inlet.rate_per_s", "grains per second"),
        ("inlet", INLET | {"rate_per_s": np.nan}, "inlet.rate_per_s", "grains per second"),
        ("inlet", INLET | {"count": 6}, "inlet.count", "at most scene.grains.count = 5"),
        ("inlet", INLET | {"count": 0}, "inlet.count", "at least 1"),
        ("inlet", INLET | {"size_m": [0.1]}, "inlet.size_m", "2 finite numbers"),
        ("inlet", INLET | {"size_m": [0.1, 0]}, "inlet.size_m", "above 0"),
        ("outlet", {"point_m": [0, 0, 0]}, "outlet.normal", "three finite numbers"),
        ("outlet", {"point_m": [0, 0, 0], "normal": [0, 0, 0]}, "outlet.normal", "not all 0"),
        ("outlet", {"normal": [0, 0, -1]}, "outlet.point_m", "three finite numbers"),
        ("vary", {"colour": [1]}, "vary.colour", "friction_angle_rad or damping"),
        ("vary", {"damping": []}, "vary.damping", "a list of finite numbers"),
        ("vary", {"damping": 0.2}, "vary.damping", "a list of finite numbers"),
        ("vary", {"damping": [0.2, "none"]}, "vary.damping", "a list of finite numbers"),
        ("vary", {"damping": [0.1, 1.0]}, "vary.damping", "below 1"),
        ("vary", {"friction_angle_rad": [0.1, 30]}, "grains.material.friction_angle_rad", "below pi/2"),
        ("initial.region_m", [[0, 0, 1], [1, 1, 0]], "initial.region_m", "the lower and the upper corner"),
        ("initial.region_m", [[0, 0, 1]], "initial.region_m", "the lower and the upper corner"),
        ("initial.region_m", [[0, 0], [1, 1]], "initial.region_m", "the lower and the upper corner"),
        ("initial.region_m", [0, 1], "initial.region_m", "the lower and the upper corner"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_key_with_a_remedy(key, value, where, told) -> None:
    with pytest.raises(ConfigError, match=rf"^scene\.{where}\n[\s\S]*{told}"):
        Scene.from_config(changed(key, value))


@pytest.mark.parametrize("key", ["outlet", "inlet"])
def test_a_misspelt_key_is_refused_with_the_known_ones(key) -> None:
    with pytest.raises(ConfigError, match=rf"^scene\.{key}\.colour\n"):
        Scene.from_config(changed(key, {"colour": 1}))


def test_every_case_has_its_own_value_of_what_varies() -> None:
    scene = Scene.from_config(changed("vary", {"friction_angle_rad": [0.1, 0.2, 0.3], "damping": [0, 0.4]}))
    assert [scene.of_case(case).grains.material.friction_angle_rad for case in range(4)] == [0.1, 0.2, 0.3, 0.1]
    assert [scene.of_case(case).damping for case in range(4)] == [0.0, 0.4, 0.0, 0.4]
    assert scene.of_case(1).parameters == scene.parameters | {"friction_angle_rad": 0.2, "damping": 0.4}
    again = Scene.from_config(asdict(scene.of_case(1)))
    assert again == scene.of_case(1)


@pytest.mark.parametrize("share", [[], [0.5, 0.5], [0.9, 0.1], [1 / 3, 2 / 3]])
@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_the_counts_of_all_radii_add_up(share, count) -> None:
    grains = Scene.from_config(changed("grains", SIZES | {"share": share, "count": count})).grains
    assert sum(n for _, n in grains.counts) == count
    for (radius, n), part in zip(grains.counts, share or [0.5, 0.5], strict=True):
        assert radius in grains.radii_m
        assert abs(n - part * count) <= 1


def examples() -> list[str]:
    """YAML of docs/scenes.md: whole blocks, or one line each where a block holds alternatives."""
    blocks = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs" / "scenes.md").read_text(), re.DOTALL)
    alternatives = ("shape:", "motion:")
    return [text for block in blocks for text in (block.splitlines() if block.startswith(alternatives) else [block])]


@pytest.mark.parametrize("text", examples())
def test_the_examples_of_the_documentation_are_true(text, monkeypatch) -> None:
    monkeypatch.chdir(CONF / "scene")  # where silo.stl lies
    ((key, value),) = yaml.safe_load(text).items()
    if key in ("shape", "motion"):
        key = f"boundary.drum.{key}"
    elif isinstance(GOOD[key], dict) and key != "boundary":
        value = GOOD[key] | value
    scene = Scene.from_config(changed("grains.count", 100) | {key: value} if "." not in key else changed(key, value))
    entries(scene)
    for name, part in scene.boundary.items():
        build_mesh(name, part)


def test_grains_cannot_enter_beyond_the_outlet() -> None:
    outlet = {"point_m": [0, 0, 2], "normal": [0, 0, -1]}
    with pytest.raises(ConfigError, match="not beyond the outlet"):
        scenes.scene(5, 5, inlet=INLET, outlet=outlet)


@pytest.mark.parametrize("told", ["steep", "${oc.env:HOME}"])
def test_a_word_for_a_record_is_refused(told) -> None:
    """The second becomes a word only when the record is made, behind the back of whoever checks types."""
    with pytest.raises(ConfigError, match="scene"):
        Scene.from_config(plain(scenes.scene(2, 5)) | {"angle_of_repose": told})
