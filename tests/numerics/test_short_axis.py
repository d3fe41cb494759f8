"""Sums over a short axis are NumPy's to the bit."""

import numpy as np
import pytest

from fluidlift.numerics.short_axis import lengths, summed


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("shape", [(40, 30, 3), (7, 40, 30, 2), (0, 3)])
def test_sums_and_lengths_are_those_of_numpy(kind, shape):
    values = np.random.default_rng(3).normal(0.0, 50.0, shape).astype(kind)
    assert summed(values).dtype == kind
    if kind != np.float16:  # which NumPy adds up in single precision
        np.testing.assert_array_equal(summed(values), values.sum(axis=-1))
        np.testing.assert_array_equal(lengths(values), np.linalg.norm(values, axis=-1))
        np.testing.assert_array_equal(summed(values[::2]), values[::2].sum(axis=-1))
