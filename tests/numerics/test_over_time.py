"""Orders and medians over time are NumPy's."""

import numpy as np
import pytest

from fluidlift.numerics.over_time import MOST, median_over_time, network, sorted_over_time


@pytest.mark.parametrize("count", [*range(1, 20), 24, 31, 32, 33, 100, MOST + 1])
@pytest.mark.parametrize("kind", [np.float32, np.uint8, np.float64])
def test_they_are_numpys(count, kind):
    rng = np.random.default_rng(count)
    shape = (count, 7, 13, 3) if count % 2 else (count, 150)
    pictures = (60.0 * rng.normal(size=shape)).clip(-100, 155).astype(kind) if kind != np.uint8 else rng.integers(
        0, 256, shape, np.uint8
    )  # fmt: skip
    median = median_over_time(pictures)
    assert median.dtype == np.median(pictures, axis=0).dtype
    np.testing.assert_array_equal(median, np.median(pictures, axis=0))
    ordered = sorted_over_time(pictures)
    assert ordered.dtype == kind
    np.testing.assert_array_equal(ordered, np.sort(pictures, axis=0))


def test_numbers_of_all_sizes_are_put_in_order():
    numbers = np.array([0.0, 1e-40, -1e-40, 3e38, -3e38, np.inf, -np.inf, 1.5, -1.5, 2.0, -7.0], np.float32)
    rng = np.random.default_rng(1)
    pictures = np.stack([rng.permutation(numbers) for _ in range(200)], axis=1)
    np.testing.assert_array_equal(sorted_over_time(pictures), np.sort(pictures, axis=0))


def test_operands_are_left_alone_and_may_lie_anyhow():
    pictures = np.random.default_rng(2).normal(size=(9, 40, 30)).astype(np.float32)
    before = pictures.copy()
    np.testing.assert_array_equal(median_over_time(pictures[:, ::2, ::3]), np.median(before[:, ::2, ::3], axis=0))
    np.testing.assert_array_equal(pictures, before)
    assert median_over_time(pictures[:, :0]).shape == (0, 30)


@pytest.mark.parametrize("count", range(1, 13))
def test_the_network_sorts_every_sequence_of_zeros_and_ones(count):
    """Then it sorts all (Knuth, The Art of Computer Programming 3, 5.3.4, the 0-1 principle)."""
    rows = (np.arange(2**count)[None] >> np.arange(count)[:, None]) & 1
    for low, high in network(count):
        assert low < high
        rows[low], rows[high] = np.minimum(rows[low], rows[high]), np.maximum(rows[low], rows[high])
    assert (np.diff(rows, axis=0) >= 0).all()


def test_no_pictures_have_no_median():
    with pytest.raises(ValueError, match="no pictures"):
        median_over_time(np.zeros((0, 3), np.float32))
