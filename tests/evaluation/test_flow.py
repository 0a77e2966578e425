"""Discharge, velocity profile and mixing of flows whose answer is known."""

import numpy as np
import pytest

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import ConfigError
from gns_pyg.evaluation.flow import discharge_rate, discharged, emptying_time, mixing_index, velocity_profile
from tests import scenes

MASS = np.full(100, 0.5)
TIMES = 0.01 * np.arange(121)


def stream(mouth_height_m=0.2):
    """A grain of 0.5 kg passes a mouth at 0.2 m every 0.01 s, from 0.1 s on; 0.2 m below they leave the scene."""
    height = 0.2 + 0.1005 + 0.01 * np.arange(100) - TIMES[:, None]
    pos = np.stack([np.zeros_like(height), np.zeros_like(height), height], axis=2)
    pos[height < 0.0] = np.nan
    return pos, scenes.scene(100, 121, mouth_height_m=mouth_height_m)


def test_discharge_of_a_steady_stream():
    pos, scene = stream()
    part = discharged(pos, MASS, scene)
    assert discharge_rate(part, MASS, TIMES) == pytest.approx(50.0)
    assert emptying_time(part, TIMES) == pytest.approx(1.09)
    assert part[[0, 60, -1]] == pytest.approx([0.0, 0.5, 1.0])


def test_a_hopper_that_does_not_empty_has_no_emptying_time_and_a_blocked_one_no_rate():
    pos, scene = stream()
    assert np.isnan(emptying_time(discharged(pos[:100], MASS, scene), TIMES[:100]))
    assert np.isnan(discharge_rate(discharged(pos[:5], MASS, scene), MASS, TIMES[:5]))


def test_discharge_of_a_scene_without_a_mouth_is_refused():
    pos, scene = stream(mouth_height_m=None)
    with pytest.raises(ConfigError, match=r"scene\.mouth_height_m"):
        discharged(pos, MASS, scene)


@pytest.fixture(params=[25.0, -25.0])
def bed(request, tmp_path):
    scene = scenes.heap_case(tmp_path / "heap.h5", "plane", angle_deg=request.param)
    return Trajectory(tmp_path / "heap.h5").read("position")[0], scene, np.radians(request.param)


def test_a_layer_that_shears_linearly_shows_a_linear_profile(bed):
    pos, scene, angle = bed
    normal = np.array([0.0, -np.sin(angle), np.cos(angle)])
    down = -np.sign(angle) * np.array([0.0, np.cos(angle), np.sin(angle)])
    depth = (pos @ normal).max() - pos @ normal
    moved = pos + 0.01 * np.maximum(0.5 - 5.0 * depth, 0.0)[:, None] * down
    depths, velocity = velocity_profile(np.stack([pos, moved]), np.array([0.0, 0.01]), scene)
    seen = np.isfinite(velocity)
    assert seen[:2].all()
    np.testing.assert_allclose(velocity[seen], 0.5 - 5.0 * depths[seen], atol=5.0 * 0.01)


def test_halves_that_are_apart_and_halves_that_are_mixed():
    lattice = np.stack(np.meshgrid(*[0.02 * np.arange(-12, 12) + 0.01] * 3), axis=-1).reshape(-1, 3)
    scene = scenes.scene(len(lattice), 2, angle_of_repose={"kind": "plane", "from_s": 0.0})
    shuffled = np.random.default_rng(0).permutation(lattice)
    apart, mixed = mixing_index(np.stack([lattice, shuffled]), scene)
    assert apart == pytest.approx(0.0, abs=1e-9)
    assert mixed == pytest.approx(1.0, abs=0.02)
    assert np.isnan(mixing_index(np.zeros((1, 2, 3)), scene)).all()
