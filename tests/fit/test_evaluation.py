"""What a fit may spend."""

import time

import numba

from fluidlift.fit.evaluation import Budget


def test_the_clock_stands_while_kernels_are_compiled():
    kernel = numba.njit(lambda a: a.sum())
    began = time.monotonic()
    budget = Budget()
    with budget.counted():
        kernel.compile((numba.float32[:],))
    took = time.monotonic() - began
    budget.deadline = time.monotonic() - 0.5 * took  # it would be over, had it gone on
    assert not budget.spent
    budget.deadline -= took
    assert budget.spent and budget.ended_by.startswith("the clock")
