"""Tracers that are too near to each other, and places that lack one, are those of a search among all."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fluidlift.look.tracer_spacing import bare_points, not_crowded


def tracers() -> tuple[np.ndarray, np.ndarray]:
    """A few thousand on 3 x 2 m, one far away, with ids in no order."""
    rng = np.random.default_rng(4)
    places = np.concatenate([rng.uniform(0, 1, (3000, 2)) * [3.0, 2.0], [[70.0, -4.0]]])
    return places, rng.permutation(len(places))


@pytest.mark.parametrize("apart", [0.01, 0.05, 0.2])
def test_of_each_close_pair_the_younger_goes(apart):
    places, ids = tracers()
    keep = np.ones(len(places), bool)
    for one, other in cKDTree(places).query_pairs(apart):
        keep[one if ids[one] > ids[other] else other] = False
    np.testing.assert_array_equal(not_crowded(places, ids, apart), keep)
    assert 0 < keep.sum() < len(places)


@pytest.mark.parametrize("within", [0.02, 0.0375, 0.2])
def test_bare_are_the_points_of_the_lattice_that_no_tracer_is_near(within):
    places, _ = tracers()
    spacing, first, shape = 0.05, np.array([-3.0, 5.0]), (70, 40)
    lattice = (first + np.moveaxis(np.indices(shape), 0, -1) + 0.5) * spacing
    wanted = cKDTree(places).query(lattice.reshape(-1, 2))[0].reshape(shape) >= within
    found = bare_points(places, first, spacing, shape, within)
    np.testing.assert_array_equal(found, wanted)
    assert 0 < found.sum() < found.size


def test_without_tracers_all_is_bare_and_none_is_crowded():
    none = np.zeros((0, 2))
    assert bare_points(none, np.zeros(2), 0.1, (4, 3), 0.1).all()
    assert len(not_crowded(none, np.zeros(0, np.int64), 0.1)) == 0


def test_a_distance_that_is_not_positive_is_refused():
    with pytest.raises(ValueError, match="positive metres"):
        bare_points(np.zeros((1, 2)), np.zeros(2), 0.1, (2, 2), 0.0)
