"""A bundle taken to a scene that it was not trained on."""

import json
import logging
import shutil

import h5py
import pytest

from gns_pyg import run
from gns_pyg.data.datamodule import EMBEDDED
from gns_pyg.errors import ConfigError, DataError
from tests.integration.runs import config

TILTED = "scene.gravity_m_s2=[1.7035,0.0,-9.661]"
ROUGH = "scene.grains.material.friction_angle_rad=0.9"


def changed_case(folder, change):
    """An embedded case that says it comes from another scene."""
    path = folder / "case_020.h5"
    shutil.copy(EMBEDDED / "hopper_small" / "case_007.h5", path)
    with h5py.File(path, "r+") as file:
        scene = json.loads(file["parameters"].attrs["scene"])
        change(scene)
        file["parameters"].attrs["scene"] = json.dumps(scene)
        file["particles/grains/position/value"][0, 0, 0] += 1e-5  # another run, so not one that was trained on
    return path


def evaluate(trained, tmp_path, *overrides):
    folder, _ = trained
    out = tmp_path / "out"
    overrides = [f"bundle={folder}/bundle", f"data.dir={tmp_path}", "start_s=1.15", *overrides]
    return run.evaluate(config(out, *overrides, name="evaluate"))


def tilt(scene):
    scene["gravity_m_s2"] = [1.7035, 0.0, -9.661]


def roughen(scene):
    scene["grains"]["material"]["friction_angle_rad"] = 0.9


def test_other_gravity(trained, tmp_path, caplog):
    changed_case(tmp_path, tilt)
    with pytest.raises(DataError, match="gravity_m_s2"):
        evaluate(trained, tmp_path)
    with caplog.at_level(logging.WARNING, "gns_pyg"):
        metrics = evaluate(trained, tmp_path, "scene=hopper_small", TILTED)
    assert metrics["test/one_step_error_m"] > 0
    (text,) = [text for text in caplog.messages if "outside what" in text]  # as strong as before
    assert "angle of gravity to -z, degrees: 10; the model has seen 0" in text


def test_what_was_not_trained_is_named(trained, tmp_path, caplog):
    path = changed_case(tmp_path, roughen)
    with caplog.at_level(logging.WARNING, "gns_pyg"):
        evaluate(trained, tmp_path, "scene=hopper_small", ROUGH)
    (text,) = [text for text in caplog.messages if "outside what" in text]
    assert "friction_angle_rad: 0.9; the model has seen 0.5" in text
    caplog.clear()
    overrides = [f"bundle={trained[0]}/bundle", f"trajectory={path}", "start_s=1.15", "scene=hopper_small", ROUGH]
    with caplog.at_level(logging.WARNING, "gns_pyg"):
        run.rollout(config(tmp_path / "rolled", *overrides, name="rollout"))
    assert "friction_angle_rad: 0.9" in caplog.text


def test_a_scene_that_needs_more_than_the_model_has(trained, tmp_path):
    changed_case(tmp_path, lambda scene: None)
    motion = "+scene.boundary.hopper.motion={kind:rotation,axis:[0,0,1],rate_rad_s:1.0}"
    with pytest.raises(ConfigError, match="wall_velocity"):
        evaluate(trained, tmp_path, "scene=hopper_small", motion)
