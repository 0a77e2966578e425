import numpy as np
import pytest

from gns_pyg.data.coverage import WALLS, coverage, outside_coverage, values
from gns_pyg.data.trajectory import Trajectory
from tests import scenes

TURNING = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 3.0}


def case(path, speed=1.0, friction=0.5, motion=None):
    part = {"shape": scenes.BOX, "points": 200, "friction_angle_rad": 0.5, "motion": motion or {"kind": "none"}}
    material = {"density_kg_m3": 1000.0, "young_modulus_pa": 1e6, "poisson_ratio": 0.25, "friction_angle_rad": friction}
    grains = {"count": 3, "radius_m": scenes.RADIUS_M, "material": material}
    scene = scenes.scene(3, 5, boundary={"walls": part}, grains=grains)
    vel = np.zeros((5, 3, 3))
    vel[2, 1, 0] = speed
    scenes.write_case(path, scene, np.broadcast_to([[0.0], [0.1], [0.2]], vel.shape), vel)
    return scene, Trajectory(path)


def test_values_and_ranges(tmp_path):
    scene, smooth = case(tmp_path / "a.h5", 1.0, 0.3)
    _, rough = case(tmp_path / "b.h5", 2.0, 0.7)
    assert values([smooth, rough])["friction_angle_rad"] == [0.3, 0.7]
    found = coverage(scene, [smooth, rough])
    assert found["friction_angle_rad"] == [0.3, 0.7]
    assert found["grain speed, m/s"] == pytest.approx([0.0, 2.0])
    assert coverage(scene, [rough], slice(0, 1))["grain speed, m/s"] == [0.0, 0.0]
    assert found["wall speed, m/s"] == [0.0, 0.0]


def test_outside_is_named_and_inside_is_not(tmp_path):
    scene, known = case(tmp_path / "a.h5", 1.0, 0.5)
    trained = coverage(scene, [known])
    assert outside_coverage(trained, trained) == []
    other_scene, other = case(tmp_path / "b.h5", 1.5, 0.6, TURNING)
    texts = outside_coverage(trained, coverage(other_scene, [other]))
    assert [text.split(":")[0] for text in texts] == ["friction_angle_rad", "grain speed, m/s", "wall speed, m/s"]
    assert "0.6; the model has seen 0.5" in texts[0]
    _, slower = case(tmp_path / "c.h5", 0.1, 0.5)
    assert outside_coverage(trained, coverage(scene, [slower])) == []
    (text,) = outside_coverage(coverage(other_scene, [other]), coverage(other_scene, [other]) | {WALLS: [0.0, 0.0]})
    assert text.startswith("wall speed, m/s: 0; the model has seen")
