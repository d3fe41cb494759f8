"""Vector numbers in kernels compute what the scalars would."""

import numpy as np
from numba import njit

from fluidlift.numerics.lanes import first_half, lane, load4, load8, store, twice, vector4, vector8


@njit
def _combined(values, factor, out):
    # rounding of 0.1 happens on the way into the vector
    rising = vector4(0.0, 1.0, 2.0, 0.1)
    store(out, 0, load4(values, 1) * rising + load4(values, 3))
    store(out, 4, twice(load4(values, 0)) * factor)
    store(out, 12, first_half(load8(values, 2)) + vector4(factor, factor, factor, factor))
    store(out, 16, vector8(0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0) * load8(values, 0))
    return lane(load4(values, 4), 0) + lane(load4(values, 4), 3)


def test_vectors_are_their_lanes():
    values = np.random.default_rng(0).normal(size=12).astype(np.float32)
    factor, out = np.float32(1.7), np.zeros(24, np.float32)
    total = _combined(values, factor, out)
    # a product and a sum may be rounded once instead of twice: one unit in the last place of numbers near 1
    rising = np.array([0, 1, 2, 0.1], np.float32)
    np.testing.assert_allclose(out[:4], values[1:5] * rising + values[3:7], rtol=0, atol=3e-7)
    np.testing.assert_array_equal(out[4:12], np.tile(values[:4] * factor, 2))
    np.testing.assert_array_equal(out[12:16], values[2:6] + factor)
    np.testing.assert_array_equal(out[16:], np.arange(8, dtype=np.float32) * values[:8])
    assert total == values[4] + values[7]


def test_nothing_beyond_the_vector_is_written():
    values, out = np.ones(12, np.float32), np.full(26, -1.0, np.float32)
    _combined(values, np.float32(2.0), out)
    assert (out[24:] == -1.0).all()
