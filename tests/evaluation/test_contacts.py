"""Overlap and coordination number of arrangements whose answer is known."""

import numpy as np
import pytest

from gns_pyg.evaluation.contacts import contacts_per_grain, coordination_number, mean_overlap_ratio, overlap_ratios


def test_overlap_of_two_spheres():
    radius = np.array([0.01, 0.01, 0.01])
    pos = np.array([[[0.0, 0, 0], [0.019, 0, 0], [1.0, 0, 0]], [[0.0, 0, 0], [0.021, 0, 0], [1.0, 0, 0]]])
    np.testing.assert_allclose(mean_overlap_ratio(pos, radius), [0.05, 0.0])


def test_overlap_of_unequal_spheres():
    pos = np.array([[[0.0, 0, 0], [0.027, 0, 0]]])
    np.testing.assert_allclose(mean_overlap_ratio(pos, np.array([0.01, 0.02])), [0.1])


def test_overlap_of_every_pair():
    pos = np.array([[[0.0, 0, 0], [0.019, 0, 0], [0.0375, 0, 0], [1.0, 0, 0]]])
    np.testing.assert_allclose(np.sort(overlap_ratios(pos, np.full(4, 0.01))[0]), [0.05, 0.075])


@pytest.mark.parametrize("spacing", [0.0199, 0.0201])
def test_grains_of_a_cubic_lattice_have_six_neighbours(spacing):
    """8 corners have 3, 12 edges 4, 6 faces 5 and the middle 6: 108 / 27 in all; none just out of touch."""
    lattice = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), axis=-1).reshape(1, -1, 3) * spacing
    absent = np.full((1, 1, 3), np.nan)
    pos = np.concatenate([lattice, absent], axis=1)
    found = coordination_number(overlap_ratios(pos, np.full(28, 0.01)), pos)
    np.testing.assert_allclose(found, [4.0 if spacing < 0.02 else 0.0])
    assert np.isnan(coordination_number(overlap_ratios(absent, np.full(1, 0.01)), absent)).all()


def test_contacts_are_counted_on_both_grains_of_a_pair():
    pos = np.array([[[0.0, 0, 0], [0.019, 0, 0], [np.nan] * 3, [0.0375, 0, 0], [1.0, 0, 0]]])
    np.testing.assert_array_equal(contacts_per_grain(pos, np.full(5, 0.01)), [[1, 2, np.nan, 1, 0]])
