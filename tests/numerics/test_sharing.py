"""Parallel loops dealt out in pieces."""

import numba
import numpy as np

from fluidlift.numerics.sharing import in_pieces


@numba.njit(parallel=True)
def squares(out):
    for i in numba.prange(len(out)):
        out[i] = i * i


def test_every_thing_is_done_once_and_the_setting_ends_with_the_block():
    before = numba.get_parallel_chunksize()
    for count in (0, 1, 7, 1000):
        out = np.zeros(count, np.int64)
        with in_pieces(count):
            assert numba.get_parallel_chunksize() >= 1
            squares(out)
        np.testing.assert_array_equal(out, np.arange(count) ** 2)
        assert numba.get_parallel_chunksize() == before
