"""Loops that threads share."""

import threading

import numba
import numpy as np
import pytest

from fluidlift.numerics import sharing
from fluidlift.numerics.sharing import SMALL, in_order, shared


@shared(lambda out, *_: (0, len(out)))
def count_steps(begin, end, out, fails_at):
    """Adds one to each; not a number (an error) is raised at one of them."""
    for i in range(begin, end):
        out[i] += 1
        if i == fails_at:
            raise ValueError("told to")


@shared(lambda first, *_: first, least=1, pieces=sharing.PIECES)
def mark(begin, end, first, out):
    """Writes the beginning of the piece that each belongs to."""
    for i in range(begin, end):
        out[i] = begin


@pytest.fixture
def two_threads():
    before = numba.get_num_threads()
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one processor")
    numba.set_num_threads(2)
    yield
    numba.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 7, 1000, SMALL, SMALL + 1, 3 * SMALL])
def test_every_step_is_done_once(count, two_threads):
    out = np.zeros(count, np.int64)
    count_steps(out, -1)
    np.testing.assert_array_equal(out, 1)


def test_only_the_extent_is_visited_in_pieces_of_one_size(two_threads):
    out = np.full(2 * SMALL, -1)
    mark((100, SMALL), out)
    assert (out[:100] == -1).all() and (out[SMALL:] == -1).all()
    begins, sizes = np.unique(out[100:SMALL], return_counts=True)
    assert begins[0] == 100 and len(begins) == 2 * sharing.PIECES
    assert sizes.max() - sizes.min() <= 1


def test_one_thread_and_small_arrays_are_not_cut():
    out = np.full(2 * SMALL, -1)
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        mark((0, 2 * SMALL), out)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(out, 0)
    mark((0, 100), out[:100])
    np.testing.assert_array_equal(out[:100], 0)


@pytest.mark.parametrize("where", [0, 3 * SMALL - 1])
def test_an_error_in_a_thread_reaches_the_caller(where, two_threads):
    with pytest.raises(ValueError, match="told to"):
        count_steps(np.zeros(3 * SMALL, np.int64), where)


def test_callers_in_several_threads_do_not_wait_for_each_other(two_threads):
    outs = [np.zeros(3 * SMALL, np.int64) for _ in range(4)]
    callers = [threading.Thread(target=count_steps, args=(out, -1)) for out in outs]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(60)
    for out in outs:
        np.testing.assert_array_equal(out, 1)


def test_sums_are_taken_one_after_the_other():
    values = np.array([1.0, 2.0**-53, 2.0**-53])
    assert in_order(values) == 1.0 != in_order(values[::-1].copy())
