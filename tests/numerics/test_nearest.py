"""Neighbours that are looked for in cells are those of a search among all."""

import numpy as np
import pytest

from fluidlift.numerics.cell_list import CellList, cells_kernel
from fluidlift.numerics.nearest import FEW, nearest, nearest_of_crowd, nearest_of_few


def crowd() -> np.ndarray:
    """Eight particles to a cell of 0.1 m in a slab, a shaken lattice; two strays far away."""
    rng = np.random.default_rng(5)
    at = (np.stack(np.meshgrid(*map(np.arange, (24, 20, 8)), indexing="ij"), -1).reshape(-1, 3) + 0.5) * 0.05
    at = at + rng.normal(scale=0.015, size=at.shape)
    return np.concatenate([at, [[80.0, -3.0, 2.0], [1.0, 0.5, 3.0]]]).astype(np.float32)


@pytest.mark.parametrize("width", [0.05, 0.1, 0.4])
def test_the_nearest_in_cells_are_those_of_a_tree(width):
    points = crowd()
    places = np.concatenate([points[::3], points[-2:], np.float32([[1.1, 0.4, 0.7]])])
    for count in (1, 7, 13):
        distance, index = nearest_of_crowd(points, places, count, width)
        wanted = np.reshape(nearest(points, places, count)[0], distance.shape)
        np.testing.assert_allclose(distance, wanted, rtol=1e-5, atol=1e-6)
        named = np.linalg.norm(points[index].astype(float) - places[:, None], axis=2)
        np.testing.assert_allclose(named, wanted, rtol=1e-5, atol=1e-6)
        assert all(len(set(row)) == count for row in index)


def test_more_neighbours_than_points_are_refused():
    with pytest.raises(ValueError, match="4 neighbours among 3 points"):
        nearest_of_crowd(crowd()[:3], crowd()[:3], 4, 0.1)


def test_points_lie_in_the_order_of_their_cells_and_within_one_in_their_own():
    points = crowd()
    found = CellList.of(points, 0.1)
    cells = np.empty(len(points), np.int64)
    cells_kernel(points, found.low, found.width, found.shape, cells)
    np.testing.assert_array_equal(found.order, np.argsort(cells, kind="stable"))
    np.testing.assert_array_equal(np.diff(found.starts), np.bincount(cells, minlength=int(found.shape.prod())))
    assert found.starts[0] == 0


def test_cells_repeat_in_space_for_points_far_away_and_before_the_first_one():
    points = np.concatenate([crowd(), [[500.0, -3.0, 40.0], [-7.0, 2.0, 1e4]]]).astype(np.float32)
    low, width, shape = np.array([0.3, 0.2, 0.4]), 0.1, np.array([7, 5, 9])
    cells = np.empty(len(points), np.int64)
    cells_kernel(points, low, width, shape, cells)
    at = np.floor((points - low) / width).astype(np.int64) % shape
    np.testing.assert_array_equal(cells, np.ravel_multi_index(tuple(at.T), tuple(shape)))


def test_no_places_have_no_neighbours():
    away, index = nearest_of_crowd(crowd(), crowd()[:0], 3, 0.1)
    assert away.shape == index.shape == (0, 3) and index.dtype == np.int64


@pytest.mark.parametrize("points", [1, 5, 40, FEW + 1, 5000])
@pytest.mark.parametrize("within", [0.2, np.inf])
def test_few_points_are_found_as_by_the_tree(points, within):
    rng = np.random.default_rng(points)
    some, places = rng.uniform(0.0, 1.0, (points, 2)), rng.uniform(-0.2, 1.2, (FEW if points == 5000 else 300, 2))
    count = min(4, points)
    away, index = nearest_of_few(some, places, count, within=within)
    wanted, which = nearest(some, places, np.arange(1, count + 1), within=within)
    np.testing.assert_array_equal(index, which)
    np.testing.assert_allclose(away, wanted, rtol=1e-12)  # rounding of a sum of two squares
