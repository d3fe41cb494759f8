"""Sums and extremes over a short axis are NumPy's to the bit."""

import numpy as np
import pytest

from fluidlift.numerics.short_axis import every, highest, least, lengths, lowest, most, summed


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("shape", [(40, 30, 3), (7, 40, 30, 2), (0, 3)])
def test_sums_and_lengths_are_those_of_numpy(kind, shape):
    values = np.random.default_rng(3).normal(0.0, 50.0, shape).astype(kind)
    assert summed(values).dtype == kind
    if kind != np.float16:  # which NumPy adds up in single precision
        np.testing.assert_array_equal(summed(values), values.sum(axis=-1))
        np.testing.assert_array_equal(lengths(values), np.linalg.norm(values, axis=-1))
        np.testing.assert_array_equal(summed(values[::2]), values[::2].sum(axis=-1))


@pytest.mark.parametrize("kind", [np.uint8, np.int32, np.float32, np.float64])
def test_extremes_are_those_of_numpy(kind):
    values = np.random.default_rng(4).uniform(0.0, 255.0, (40, 30, 3)).astype(kind)
    assert least(values).dtype == most(values).dtype == kind
    np.testing.assert_array_equal(least(values[:, ::2]), values[:, ::2].min(axis=-1))
    np.testing.assert_array_equal(most(values), values.max(axis=-1))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(500, 3), (1, 3), (40, 2)])
def test_boxes_and_conditions_are_those_of_numpy(kind, shape):
    points = np.random.default_rng(5).normal(size=(2 * shape[0], shape[1])).astype(kind)[::2]
    assert lowest(points).dtype == highest(points).dtype == kind
    np.testing.assert_array_equal(lowest(points), points.min(axis=0))
    np.testing.assert_array_equal(highest(points), points.max(axis=0))
    np.testing.assert_array_equal(every(points > -0.5), (points > -0.5).all(axis=-1))
    assert every(points[:0] > 0).shape == (0,)
    with pytest.raises(ValueError, match="zero-size"):
        lowest(points[:0])
