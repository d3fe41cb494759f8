"""The V-cycle and the conjugate gradients of the multigrid solver, each compiled as a whole (see `multigrid_kernels`).

A level is cut into parts of planes, one per thread. The threads run their waves at the same time, each half sweep one
plane further from the borders of the part than the one before; then they fill in what is left around the borders. Red
and black cells do not see their own colour, so the result is that of plain half sweeps, to the last bit.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from fluidlift.numerics.multigrid_kernels import (
    BLACK,
    PARTS,
    PLANES,
    RED,
    apply_plane,
    descend_plane,
    divide_plane,
    dot_plane,
    relax_plane,
    residual_plane,
    wave_down,
    wave_turn,
    wave_up,
)

LEAST_PLANES = 12
"""planes per part: the borders of a part must not meet"""
COARSEST_SWEEPS = 8
"""sweeps forth, and as many back, on the coarsest grid"""
RESTARTS = 3
"""times that conjugate gradients begin again where rounding has parted their residual from the true one"""


@njit(cache=True)
def _cut(c, parts, g):
    """First plane of a part."""
    return 1 + c * (g[PLANES] - 2) // parts


@njit(parallel=True, cache=True)
def _down_in_parts(fine, coarse, common, x, rhs, inverse, air, cx, cy, cz, rows, segments):
    parts = fine[PARTS]
    for c_ in prange(parts):
        c = np.int64(c_)
        a, b = _cut(c, parts, fine), _cut(c + 1, parts, fine)
        wave_down(a, b, int(c > 0), -int(c < parts - 1), (a + 6) // 2 if c > 0 else 1,
                  (b - 3) // 2 if c < parts - 1 else coarse[PLANES] - 1,
                  fine, coarse, common, x, rhs, inverse, air, cx, cy, cz, rows, segments)  # fmt: skip
    for c_ in prange(1, parts):
        b = _cut(np.int64(c_), parts, fine)
        wave_down(b, b, -1, 1, (b - 3) // 2, (b + 6) // 2,
                  fine, coarse, common, x, rhs, inverse, air, cx, cy, cz, rows, segments)  # fmt: skip


@njit(parallel=True, cache=True)
def _up_in_parts(fine, coarse, common, x, rhs, inverse, cx, cy, cz, rows, segments, sums):
    parts = fine[PARTS]
    for c_ in prange(parts):
        c = np.int64(c_)
        a, b = _cut(c, parts, fine), _cut(c + 1, parts, fine)
        wave_up(a, b, int(c > 0), -int(c < parts - 1),
                fine, coarse, common, x, rhs, inverse, cx, cy, cz, rows, segments, sums)  # fmt: skip
    for c_ in prange(1, parts):
        b = _cut(np.int64(c_), parts, fine)
        wave_up(b, b, -1, 1, fine, coarse, common, x, rhs, inverse, cx, cy, cz, rows, segments, sums)


@njit(parallel=True, cache=True)
def _turn_in_parts(g, direction, z, factor, q, air, cx, cy, cz, segments, sums):
    parts = g[PARTS]
    for c_ in prange(parts):
        c = np.int64(c_)
        a, b = _cut(c, parts, g), _cut(c + 1, parts, g)
        wave_turn(a, b, int(c > 0), -int(c < parts - 1), g, direction, z, factor, q, air, cx, cy, cz, segments, sums)
    for c_ in prange(1, parts):
        b = _cut(np.int64(c_), parts, g)
        wave_turn(b, b, -1, 1, g, direction, z, factor, q, air, cx, cy, cz, segments, sums)


@njit(parallel=True, cache=True)
def _apply(g, p, q, air, cx, cy, cz, segments, sums):
    parts = g[PARTS]
    for c_ in prange(parts):
        c = np.int64(c_)
        for i in range(_cut(c, parts, g), _cut(c + 1, parts, g)):
            sums[i] = apply_plane(i, g, p, q, air, cx, cy, cz, *segments)


@njit(parallel=True, cache=True)
def _subtract(g, b, q, r, segments, sums):
    parts = g[PARTS]
    for c_ in prange(parts):
        c = np.int64(c_)
        for i in range(_cut(c, parts, g), _cut(c + 1, parts, g)):
            sums[i] = residual_plane(i, g, b, q, r, *segments)


@njit(parallel=True, cache=True)
def _descend(g, p, r, direction, q, step, scale, rhs, segments, sums):
    parts = g[PARTS]
    for c_ in prange(parts):
        c = np.int64(c_)
        for i in range(_cut(c, parts, g), _cut(c + 1, parts, g)):
            sums[i] = descend_plane(i, g, p, r, direction, q, step, scale, rhs, *segments)


@njit(cache=True)
def _sweep_coarsest(g, common, x, rhs, inverse, cx, cy, cz, segments, sums):
    """Many sweeps, forth and back."""
    half_sweeps = 4 * COARSEST_SWEEPS
    for k in range(half_sweeps):
        color = (RED + k) & 1 if k < half_sweeps // 2 else (BLACK + k) & 1
        for i in range(1, g[PLANES] - 1):
            if k == 0:
                divide_plane(i, color, g, x, rhs, inverse, *segments)
            else:
                relax_plane(i, color, g, common, x, rhs, inverse, cx, cy, cz, *segments)
    for i in range(1, g[PLANES] - 1):
        sums[i] = dot_plane(i, g, x, rhs, *segments)


@njit(cache=True)
def cycle(geometry, common, x, rhs, inverse, air, cx, cy, cz, rows, segments, sums):
    """One V-cycle on rhs of level 0 from x = 0: linear, symmetric, positive. sums gets x . rhs of each plane.

    Two sweeps before each coarse correction (red, black, red, black), two after it in the opposite order.
    """
    levels = len(geometry)
    for l in range(levels - 1):
        fine, coarse = geometry[l], geometry[l + 1]
        if fine[PARTS] == 1:
            wave_down(1, fine[PLANES] - 1, 0, 0, 1, coarse[PLANES] - 1,
                      fine, coarse, common[l], x, rhs, inverse, air, cx, cy, cz, rows, segments)  # fmt: skip
        else:
            _down_in_parts(fine, coarse, common[l], x, rhs, inverse, air, cx, cy, cz, rows, segments)
    _sweep_coarsest(geometry[levels - 1], common[levels - 1], x, rhs, inverse, cx, cy, cz, segments, sums)
    for l in range(levels - 2, -1, -1):
        fine, coarse = geometry[l], geometry[l + 1]
        if fine[PARTS] == 1:
            wave_up(1, fine[PLANES] - 1, 0, 0,
                    fine, coarse, common[l], x, rhs, inverse, cx, cy, cz, rows, segments, sums)  # fmt: skip
        else:
            _up_in_parts(fine, coarse, common[l], x, rhs, inverse, cx, cy, cz, rows, segments, sums)


@njit(cache=True)
def add_low_rank(p, q, places, values, starts, inverse_mass):
    """q += sum over terms of J^T M^-1 J p; returns what that adds to p . q (see `multigrid.LowRank`)."""
    dot = 0.0
    for b in range(len(starts) - 1):
        force = np.zeros(6)
        for n in range(starts[b], starts[b + 1]):
            here = np.float64(p[places[n]])
            for m in range(6):
                force[m] += values[n, m] * here
        velocity = np.zeros(6)
        for m in range(6):
            for l in range(6):
                velocity[m] += inverse_mass[b, m, l] * force[l]
            dot += velocity[m] * force[m]
        for n in range(starts[b], starts[b + 1]):
            total = 0.0
            for m in range(6):
                total += values[n, m] * velocity[m]
            q[places[n]] += total
    return dot


@njit(cache=True)
def _true_residual(g, p, b, q, r, air, cx, cy, cz, segments, low_rank, sums):
    """r = b - A p; returns r . r. q is scratch."""
    _apply(g, p, q, air, cx, cy, cz, segments, sums)
    add_low_rank(p, q, *low_rank)
    _subtract(g, b, q, r, segments, sums)
    return sums.sum()


@njit(cache=True)
def conjugate_gradients(
    geometry, common, p, b, goal, max_iterations, x, rhs, inverse, air, cx, cy, cz, rows, segments, low_rank
):
    """Solve A p = b in place, preconditioned by V-cycles; returns the number of iterations and |b - A p|.

    Residual and solution are kept in double precision. Directions are single: what is subtracted from the residual is
    A times the very direction that is added to the solution, so that both stay together.

    Args:
        p: float64, first guess, 0 outside the unknown cells.
        b: float64, right side, 0 outside the unknown cells.
        goal: for |b - A p|.
        low_rank: places, values, starts and inverse masses for `add_low_rank`.
    """
    g = geometry[0]
    sums = np.zeros(g[PLANES])
    q, r, direction = np.zeros_like(b), np.zeros_like(b), np.zeros(len(b), np.float32)
    squared = _true_residual(g, p, b, q, r, air, cx, cy, cz, segments, low_rank, sums)
    iterations = 0
    for _ in range(RESTARTS):
        if iterations == max_iterations or not squared > goal * goal:
            break
        before = squared
        # near one: single precision neither over- nor underflows
        scale = 1.0 / np.sqrt(squared)
        _descend(g, p, r, direction, q, 0.0, scale, rhs, segments, sums)
        rz, factor = 1.0, np.float32(0.0)
        while iterations < max_iterations and squared > goal * goal:
            cycle(geometry, common, x, rhs, inverse, air, cx, cy, cz, rows, segments, sums)
            previous, rz = rz, sums.sum()
            if not rz > 0:
                break
            _turn_in_parts(g, direction, x, factor * np.float32(rz / previous), q, air, cx, cy, cz, segments, sums)
            curvature = sums.sum() + add_low_rank(direction, q, *low_rank)
            if not curvature > 0:
                break
            # rz and the direction belong to the scaled residual
            _descend(g, p, r, direction, q, rz / (scale * curvature), scale, rhs, segments, sums)
            squared, factor = sums.sum(), np.float32(1.0)
            iterations += 1
        squared = _true_residual(g, p, b, q, r, air, cx, cy, cz, segments, low_rank, sums)
        if not squared < 0.25 * before:
            break
    return iterations, np.sqrt(squared)
