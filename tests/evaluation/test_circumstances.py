"""Circumstances of single grains, against places where they are known and against brute force."""

import numpy as np

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.evaluation.circumstances import touching, wall_gap
from gns_pyg.evaluation.contacts import coordination_number, overlap_ratios
from gns_pyg.evaluation.errors import positions
from tests import scenes


def test_touching_is_brute_force_s_and_its_mean_the_coordination_number():
    random = np.random.default_rng(0)
    pos, radius = random.uniform(0, 0.1, (3, 60, 3)), random.uniform(0.004, 0.012, 60)
    pos[1, 7] = np.nan
    counts = touching(pos, radius)
    near = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=-1) < radius[:, None] + radius
    expected = near.sum(axis=2) - 1.0
    expected[1, 7] = np.nan
    assert np.array_equal(counts, expected, equal_nan=True)
    assert np.allclose(np.nanmean(counts, axis=1), coordination_number(overlap_ratios(pos, radius), pos))
    assert np.isnan(touching(np.full((1, 2, 3), np.nan), radius[:2])).all()


def test_the_gap_to_a_turning_wall_stays_that_of_its_own_frame(tmp_path):
    """Grains turn rigidly with a box of 0.4 x 0.2 x 0.2 m, so that their gaps never change."""
    scene = scenes.rotating_box_case(tmp_path / "case.h5")
    case = Trajectory(tmp_path / "case.h5")
    pos = positions(case)
    gaps = wall_gap(pos, case.times_s, case.radius, scene)
    expected = (np.array([0.2, 0.1, 0.1]) - np.abs(pos[0])).min(axis=1) - case.radius
    assert np.allclose(gaps, expected, rtol=0, atol=1e-8)


def test_absent_grains_have_none_and_without_walls_it_is_infinite(tmp_path):
    scene = scenes.passing_case(tmp_path / "case.h5")
    case = Trajectory(tmp_path / "case.h5")
    gaps, there = wall_gap(positions(case), case.times_s, case.radius, scene), case.active()
    assert np.isnan(gaps[~there]).all()
    assert np.isposinf(gaps[there]).all()
