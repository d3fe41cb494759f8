"""A system prepared for many solves answers as one that is assembled anew."""

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest

from fluidlift.numerics.poisson import PoissonSystem, solve


def pool_with_lid(shape, closed, seed=0):
    """A box of cells with random open faces; `closed` leaves no way to p = 0."""
    rng = np.random.default_rng(seed)
    unknown = np.ones(shape, bool)
    unknown[shape[0] // 2, : shape[1] // 2] = False
    weights = []
    for axis in range(3):
        w = rng.uniform(0.3, 1.0, tuple(n + (a == axis) for a, n in enumerate(shape))).astype(np.float32)
        ends = [slice(None)] * 3
        for end in (0, -1):
            ends[axis] = end
            if closed or axis < 2:
                w[tuple(ends)] = 0
        weights.append(w)
    if closed:
        cell = np.pad(unknown, 1)
        for axis, w in enumerate(weights):
            cut = [slice(1, -1)] * 3
            cut[axis] = slice(None)
            inside = np.moveaxis(cell[tuple(cut)], axis, 0)
            w *= np.moveaxis(inside[1:] & inside[:-1], 0, axis)
    return PoissonSystem(unknown, *weights, 0.1)


@pytest.mark.parametrize("closed", [False, True])
def test_a_prepared_system_gives_the_same_pressure_solve_after_solve(closed):
    system = pool_with_lid((13, 9, 11), closed)
    prepared = system.prepared()
    rng = np.random.default_rng(1)
    for dtype in (np.float64, np.float32, np.float64):
        rhs = rng.standard_normal(system.unknown.shape).astype(dtype)
        guess = rng.standard_normal(system.unknown.shape).astype(dtype)
        for initial in (None, guess):
            p, report = solve(system, rhs, tolerance=1e-6, initial=initial)
            again, also = solve(prepared, rhs, tolerance=1e-6, initial=initial)
            # the same operations in the same order
            np.testing.assert_array_equal(again, p)
            assert also.iterations == report.iterations
            assert also.residual == pytest.approx(report.residual, rel=1e-12)
            assert also.advice == report.advice
            assert report.converged


def test_a_right_side_that_is_not_finite_leaves_no_trace_in_the_next_solve():
    system = pool_with_lid((8, 9, 7), False)
    prepared = system.prepared()
    rhs = np.random.default_rng(2).standard_normal(system.unknown.shape)
    before, _ = solve(prepared, rhs)
    _, report = solve(prepared, np.where(system.unknown, np.nan, 0.0))
    assert not report.converged
    np.testing.assert_array_equal(solve(prepared, rhs)[0], before)


def test_threads_do_not_change_a_bit_within_a_solve_nor_side_by_side():
    system = pool_with_lid((48, 42, 40), False).prepared()
    rng = np.random.default_rng(3)
    sides = [rng.standard_normal(system.unknown.shape).astype(np.float32) for _ in range(4)]
    before = numba.get_num_threads()

    def pressure(rhs, threads=1):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        return solve(system, rhs)[0]

    try:
        alone = [pressure(b) for b in sides]
        shared = [pressure(b, 2) for b in sides]
        with ThreadPoolExecutor(2) as pool:
            together = list(pool.map(pressure, sides))
    finally:
        numba.set_num_threads(before)
    for a, b, c in zip(alone, shared, together):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_a_system_without_unknown_cells_has_no_pressure():
    shape = (4, 4, 4)
    weights = [np.ones(tuple(n + (a == axis) for a, n in enumerate(shape)), np.float32) for axis in range(3)]
    p, report = solve(PoissonSystem(np.zeros(shape, bool), *weights, 1.0).prepared(), np.ones(shape))
    assert not p.any()
    assert report.converged
