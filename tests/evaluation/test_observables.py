"""Observables against arrangements whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import ConfigError
from gns_pyg.evaluation.errors import position_error
from gns_pyg.evaluation.observables import (
    angle_of_repose,
    center_of_mass,
    escaped_grains,
    granular_temperature,
    mean_angle_of_repose,
    mean_speed,
    time_mean,
)
from tests import scenes


def test_position_error_is_the_mean_distance():
    pos = np.zeros((2, 2, 3))
    other = pos.copy()
    other[1, 0] = [3.0, 4.0, 0.0]
    np.testing.assert_allclose(position_error(pos, other), [0.0, 2.5])


def test_center_of_mass_weighs_by_mass():
    pos = np.array([[[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]])
    np.testing.assert_allclose(center_of_mass(pos, np.array([1.0, 3.0])), [[0.75, 1.5, 2.25]])


@pytest.mark.parametrize("kind", ["plane", "radial"])
@pytest.mark.parametrize("n_in_flight", [0, 4])
def test_angle_of_repose_of_a_known_slope(tmp_path, kind, n_in_flight):
    scene = scenes.heap_case(tmp_path / "heap.h5", kind, angle_deg=25.0, n_in_flight=n_in_flight)
    case = Trajectory(tmp_path / "heap.h5")
    mean, standard_error = mean_angle_of_repose(case.read("position"), case.times_s, scene)
    assert mean == pytest.approx(25.0, abs=0.5)
    assert standard_error == pytest.approx(0.0, abs=1e-9)


def test_angle_of_repose_follows_gravity(tmp_path):
    """The whole scene turned by 90 degrees about x reads the same angle."""
    scene = scenes.heap_case(tmp_path / "heap.h5", "plane", angle_deg=25.0)
    pos = Trajectory(tmp_path / "heap.h5").read("position")[:1]
    turned = np.stack([pos[..., 0], -pos[..., 2], pos[..., 1]], axis=2)
    sideways = replace(scene, gravity_m_s2=[0.0, 9.81, 0.0])
    np.testing.assert_allclose(angle_of_repose(turned, sideways), angle_of_repose(pos, scene), atol=1e-6)


def test_a_crater_has_a_negative_radial_angle(tmp_path):
    scene = scenes.heap_case(tmp_path / "heap.h5", "radial", angle_deg=-20.0)
    pos = Trajectory(tmp_path / "heap.h5").read("position")[:1]
    assert angle_of_repose(pos, scene)[0] == pytest.approx(-20.0, abs=0.5)


def test_a_jet_that_falls_onto_a_heap_is_no_part_of_its_surface(tmp_path):
    scene = scenes.heap_case(tmp_path / "heap.h5", "radial", angle_deg=25.0)
    heap = Trajectory(tmp_path / "heap.h5").read("position")[:1]
    beside, up = np.meshgrid([-1.1, 0.0, 1.1], np.arange(1, 11) * 1.1)
    jet = 2 * scenes.RADIUS_M * np.stack([beside.ravel(), 0 * beside.ravel(), up.ravel()], axis=1)
    both = np.concatenate([heap, jet[None]], axis=1)
    np.testing.assert_allclose(angle_of_repose(both, scene), angle_of_repose(heap, scene), atol=1e-9)


def test_angle_of_repose_of_too_few_grains_is_nan(tmp_path):
    scene = scenes.heap_case(tmp_path / "heap.h5", "plane", angle_deg=25.0)
    assert np.isnan(angle_of_repose(np.zeros((1, 2, 3)), scene)[0])


def test_angle_of_repose_refuses_what_it_cannot_read(tmp_path):
    scene = scenes.heap_case(tmp_path / "heap.h5", "plane", angle_deg=25.0)
    pos = np.zeros((1, 2, 3))
    for definition in (
        None,
        replace(scene.angle_of_repose, kind="round"),
        replace(scene.angle_of_repose, axis=[0.0, 0.0, 1.0]),
    ):
        with pytest.raises(ConfigError, match="angle_of_repose"):
            angle_of_repose(pos, replace(scene, angle_of_repose=definition))


def test_standard_error_grows_with_correlation():
    rng = np.random.default_rng(0)
    independent = rng.normal(size=4096)
    mean, error = time_mean(independent)
    assert error == pytest.approx(1 / 64, rel=1.0)
    repeated = np.repeat(independent, 32)  # the same information, 32 times
    mean_repeated, error_repeated = time_mean(repeated)
    assert mean_repeated == pytest.approx(mean)
    assert error_repeated == pytest.approx(error, rel=0.5)
    assert repeated.std() / np.sqrt(len(repeated)) < 0.2 * error_repeated


def test_time_mean_leaves_missing_frames_out():
    assert time_mean(np.array([1.0, np.nan, 3.0]))[0] == 2.0
    assert np.isnan(time_mean(np.array([np.nan]))).all()


def test_escapes_are_counted_in_the_frame_of_the_turning_box(tmp_path):
    path = tmp_path / "turning.h5"
    scene = scenes.rotating_box_case(path, n_outside=3)
    case = Trajectory(path)
    np.testing.assert_array_equal(escaped_grains(case.read("position"), case.times_s, scene), 3)
    scene.boundary["drum"].motion.rate_rad_s = 0.0  # without the turn, corner grains would seem to be out
    assert escaped_grains(case.read("position"), case.times_s, scene).max() > 3


def test_a_grain_far_away_has_escaped_and_no_boundary_means_no_escape(tmp_path):
    scene = scenes.rotating_box_case(tmp_path / "turning.h5")
    pos = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, -50.0]]])
    np.testing.assert_array_equal(escaped_grains(pos, np.zeros(1), scene), [1])
    np.testing.assert_array_equal(escaped_grains(pos, np.zeros(1), replace(scene, boundary={})), [0])


def test_speed_and_temperature_of_a_moving_cloud():
    rng = np.random.default_rng(0)
    start = rng.uniform(0, 0.1, (50, 3))
    times = np.array([0.0, 0.01, 0.03])
    together = start + times[:, None, None] * np.array([3.0, 0.0, 4.0])
    np.testing.assert_allclose(mean_speed(together, times), 5.0)
    np.testing.assert_allclose(granular_temperature(together, times, np.full(50, 0.01)), 0.0, atol=1e-20)


def test_temperature_of_two_opposite_neighbours():
    pos = np.array([[[0.0, 0, 0], [0.025, 0, 0]], [[0.01, 0, 0], [0.015, 0, 0]]])
    np.testing.assert_allclose(granular_temperature(pos, np.array([0.0, 0.01]), np.full(2, 0.01)), [1 / 3])
