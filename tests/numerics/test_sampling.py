"""Trilinear interpolation reproduces linear fields exactly."""

import numpy as np
import pytest

from fluidlift.numerics.sampling import (
    gradient_nodes,
    interpolate,
    interpolate_plain,
    sample_centers,
    sample_faces,
    sample_nodes,
)
from fluidlift.types import FaceVelocity, Grid

GRID = Grid((5, 4, 6), 0.5, (1.0, -2.0, 0.3))
SLOPE = np.array([1.5, -2.0, 0.7])


def inner_points(n=50):
    rng = np.random.default_rng(0)
    return rng.uniform(GRID.low + 0.5 * GRID.spacing, GRID.high - 0.5 * GRID.spacing, (n, 3))


def test_a_linear_field_is_interpolated_exactly_from_nodes_and_centers():
    points = inner_points()
    truth = points @ SLOPE
    # rounding of doubles only
    np.testing.assert_allclose(sample_nodes(GRID.nodes() @ SLOPE, GRID, points), truth, atol=1e-12)
    np.testing.assert_allclose(sample_centers(GRID.centers() @ SLOPE, GRID, points), truth, atol=1e-12)


def test_vector_fields_are_interpolated_component_by_component():
    points = inner_points()
    np.testing.assert_allclose(sample_centers(GRID.centers(), GRID, points), points, atol=1e-12)


def test_a_linear_velocity_is_interpolated_exactly_from_faces():
    points = inner_points()
    matrix = np.random.default_rng(1).normal(size=(3, 3))
    velocity = FaceVelocity(*(GRID.faces(a) @ matrix[a] for a in range(3)))
    np.testing.assert_allclose(sample_faces(velocity, GRID, points), points @ matrix.T, atol=1e-12)


def test_the_gradient_is_that_of_the_interpolant():
    rng = np.random.default_rng(2)
    field = rng.normal(size=tuple(n + 1 for n in GRID.shape))
    points = inner_points()
    step = 1e-5
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        slope = (sample_nodes(field, GRID, points + shift) - sample_nodes(field, GRID, points - shift)) / (2 * step)
        # the interpolant is linear along each axis inside a cell, so central differences only round: 1e-16 / 1e-5
        np.testing.assert_allclose(gradient_nodes(field, GRID, points)[:, axis], slope, atol=1e-9)


def test_the_nearest_sample_continues_outside():
    field = GRID.nodes() @ SLOPE
    far = np.array([[-100.0, -100.0, -100.0], [100.0, 100.0, 100.0]])
    assert sample_nodes(field, GRID, far) == pytest.approx([field[0, 0, 0], field[-1, -1, -1]])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(5, 6, 7), (1, 4, 2), (5, 6, 7, 3), (3, 1, 1, 2, 2)])
def test_the_compiled_loop_gives_the_bits_of_the_plain_one(kind, shape):
    rng = np.random.default_rng(3)
    field, first = rng.normal(size=shape).astype(kind), rng.normal(size=3)
    # a third of the points lie outside
    points = first + rng.uniform(-0.3, 1.0, (400, 3))
    for places in (points, points.astype(np.float32)):
        found, plain = interpolate(field, first, 0.13, places), interpolate_plain(field, first, 0.13, places)
        assert found.dtype == plain.dtype
        np.testing.assert_array_equal(found, plain)


def test_half_precision_is_interpolated_in_single():
    field = np.zeros((2, 2, 2), np.float16)
    field[1] = 1.0
    found = interpolate(field, np.zeros(3), 1.0, np.array([[0.25, 0.0, 0.0]]))
    assert found.dtype == np.float32
    assert found == pytest.approx([0.25])
