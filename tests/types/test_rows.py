"""Rows are those that NumPy gathers, for every index that it takes."""

import numpy as np
import pytest

from fluidlift.types.rows import rows


@pytest.mark.parametrize("shape", [(50, 3), (50,), (50, 4, 3), (50, 3, 3)])
@pytest.mark.parametrize("kind", [np.float32, np.int64, bool])
def test_rows_are_those_of_numpy(shape, kind):
    rng = np.random.default_rng(0)
    array = rng.normal(size=shape).astype(kind)
    indices = [rng.permutation(50), rng.integers(-50, 50, 70), rng.random(50) < 0.3, slice(3, 40, 2), np.zeros(0, int),
               [1, 4], np.zeros(50, bool), np.array([[1, 2], [3, 4]]), []]  # fmt: skip
    for index in indices:
        for given in (array, np.repeat(array, 2, axis=0)[::2]):
            found = rows(given, index)
            assert found.dtype == array.dtype
            np.testing.assert_array_equal(found, given[index])


@pytest.mark.parametrize("index", [np.array([50]), np.array([-51]), np.ones(49, bool), np.ones(51, bool)])
def test_an_index_that_does_not_fit_is_refused_as_by_numpy(index):
    with pytest.raises(IndexError):
        np.zeros((50, 3))[index]
    with pytest.raises(IndexError):
        rows(np.zeros((50, 3)), index)
