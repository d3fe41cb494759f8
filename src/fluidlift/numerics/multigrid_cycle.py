"""The V-cycle and the conjugate gradients of the multigrid solver (memory: `multigrid_kernels`).

A level of many cells is cut into parts of planes, one per thread. First the threads run their waves at the same time,
each half sweep one plane further from the borders of the part than the one before; then they fill in what is left
around the borders. Red and black cells do not see their own colour, so the result is that of plain half sweeps, to the
last bit. The levels below are visited by one thread, in one go.

What is inlined is compiled once, with what calls it, instead of once for itself and once more for each that calls it.
The functions of one plane are not: with them, Numba would take longer to find all types.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from fluidlift.numerics.multigrid_kernels import (
    BLACK,
    HALF,
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
from fluidlift.numerics.sharing import in_order, shared

NONE, FIRST = np.int64(0), np.int64(1)
"""of one type with computed numbers, as `multigrid_kernels.RED`"""
LEAST_PLANES = 12
"""planes per part: the borders of a part must not meet"""
COARSEST_SWEEPS = 8
"""sweeps forth, and as many back, on the coarsest grid"""
RESTARTS = 3
"""times that conjugate gradients begin again where rounding has parted their residual from the true one"""


@dataclass(frozen=True)
class Hierarchy:
    """The operator, in units of 1 / spacing^2, on ever coarser grids; memory as in `multigrid_kernels`."""

    geometry: np.ndarray
    common: np.ndarray
    """float32 [levels,3]"""
    corner: np.ndarray
    """indices of the first cell of the finest level in the arrays of the whole grid"""
    work: tuple[np.ndarray, np.ndarray, np.ndarray]
    """x, rhs, inverse"""
    operator: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    """air, cx, cy, cz"""
    rows: tuple[np.ndarray, np.ndarray, np.ndarray]
    segments: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    beside_known: np.ndarray
    """bool, in the arrays of the whole grid: unknown cells with an open face to a known cell, or an added diagonal"""

    @property
    def size(self) -> int:
        """Length of the arrays of the finest level."""
        return int(2 * self.geometry[0, HALF] * self.geometry[0, PLANES])

    @property
    def fine(self) -> tuple[np.ndarray, np.ndarray]:
        """Line of the finest level and its corner."""
        return self.geometry[0], self.corner

    @property
    def cells(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What tells the unknown cells: inverse, and the first and last of each row."""
        return self.work[2], self.rows[0], self.rows[1]


@njit(cache=True)
def _part(c, border, g):
    """Planes a to b - 1 of part c, and by how much these ends move per half sweep; or those around its upper border."""
    parts = g[PARTS]
    a, b = 1 + c * (g[PLANES] - 2) // parts, 1 + (c + 1) * (g[PLANES] - 2) // parts
    return (b, b, -1, 1) if border else (a, b, int(c > 0), -int(c < parts - 1))


@njit(cache=True)
def _all_planes(g):
    """As `_part` of a level that is not cut."""
    return FIRST, g[PLANES] - 1, NONE, NONE


@shared(lambda border, levels, *_: (0, levels[0][PARTS] - border), least=1)
def _down(begin, end, border, levels, work, operator, rows, segments):
    fine, coarse, _ = levels
    for part in range(begin, end):
        reach = _part(part, border, fine)
        a, b, da, db = reach
        # coarse planes whose fine planes and the neighbours of these are done
        first = (b - 3) // 2 if border else ((a + 6) // 2 if da else 1)
        last = (b + 6) // 2 if border else ((b - 3) // 2 if db else coarse[PLANES] - 1)
        wave_down(reach, (first, last), levels, work, operator, rows, segments)


@shared(lambda border, levels, *_: (0, levels[0][PARTS] - border), least=1)
def _up(begin, end, border, levels, work, operator, rows, segments, sums):
    fine, _, _ = levels
    for part in range(begin, end):
        wave_up(_part(part, border, fine), levels, work, operator, rows, segments, sums)


@shared(lambda border, g, *_: (0, g[PARTS] - border), least=1)
def _turn(begin, end, border, g, vectors, factor, operator, segments, sums):
    for part in range(begin, end):
        wave_turn(_part(part, border, g), g, vectors, factor, operator, segments, sums)


@shared(lambda g, *_: (0, g[PARTS]), least=1)
def _residual(begin, end, g, vectors, operator, segments, sums):
    """q = A p, r = b - q, where vectors = (p, b, q, r)."""
    p, b, q, r = vectors
    for part in range(begin, end):
        first, last, _, _ = _part(part, NONE, g)
        for i in range(first, last):
            apply_plane(i, g, p, q, operator, segments)
            sums[i] = residual_plane(i, g, b, q, r, segments)


@shared(lambda g, *_: (0, g[PARTS]), least=1)
def _descend(begin, end, g, vectors, step, scale, segments, sums):
    for part in range(begin, end):
        first, last, _, _ = _part(part, NONE, g)
        for i in range(first, last):
            sums[i] = descend_plane(i, g, vectors, step, scale, segments)


@njit(cache=True, inline="always")
def _sweep_coarsest(g, common, work, operator, segments, sums):
    """Many sweeps, forth and back."""
    half_sweeps = 4 * COARSEST_SWEEPS
    for k in range(half_sweeps):
        color = (RED + k) & 1 if k < half_sweeps // 2 else (BLACK + k) & 1
        for i in range(1, g[PLANES] - 1):
            if k == 0:
                divide_plane(i, color, g, work, segments)
            else:
                relax_plane(i, color, g, common, work, operator, segments)
    for i in range(1, g[PLANES] - 1):
        sums[i] = dot_plane(i, g, work, segments)


@njit(cache=True, inline="always")
def _cycle_alone(geometry, common, work, operator, rows, segments, sums):
    """A V-cycle by one thread. sums gets x . rhs of each plane of its finest level."""
    coarsest = len(geometry) - 1
    for l in range(coarsest):
        levels = (geometry[l], geometry[l + 1], common[l])
        coarse_planes = (FIRST, geometry[l + 1, PLANES] - 1)
        wave_down(_all_planes(geometry[l]), coarse_planes, levels, work, operator, rows, segments)
    _sweep_coarsest(geometry[coarsest], common[coarsest], work, operator, segments, sums)
    for l in range(coarsest - 1, -1, -1):
        levels = (geometry[l], geometry[l + 1], common[l])
        wave_up(_all_planes(geometry[l]), levels, work, operator, rows, segments, sums)


def cycle(h: Hierarchy, sums: np.ndarray) -> float:
    """One V-cycle on rhs of the finest level from x = 0: linear, symmetric, positive. Returns x . rhs.

    Two sweeps before each coarse correction (red, black, red, black), two after it in the opposite order.
    """
    shared = int(np.argmax(np.append(h.geometry[:, PARTS], 1) == 1))  # levels that threads share
    pairs = [(h.geometry[l], h.geometry[l + 1], h.common[l]) for l in range(shared)]
    arrays = (h.work, h.operator, h.rows, h.segments)
    for pair in pairs:
        for border in (0, 1):
            _down(border, pair, *arrays)
    _cycle_alone(h.geometry[shared:], h.common[shared:], *arrays, sums)
    for pair in pairs[::-1]:
        for border in (0, 1):
            _up(border, pair, *arrays, sums)
    return in_order(sums)


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


def conjugate_gradients(
    h: Hierarchy, p: np.ndarray, b: np.ndarray, goal: float, max_iterations: int, low_rank: tuple[np.ndarray, ...]
) -> tuple[int, float]:
    """Solve A p = b in place, preconditioned by V-cycles; returns the number of iterations and |b - A p|.

    Residual and solution are kept in double precision. Directions are single: what is subtracted from the residual is
    A times the very direction that is added to the solution, so that both stay together.

    Args:
        p: float64, first guess, 0 outside the unknown cells.
        b: float64, right side, 0 outside the unknown cells.
        goal: for |b - A p|.
        low_rank: places, values, starts and inverse masses for `add_low_rank`.
    """
    g = h.geometry[0]
    if g[PARTS] == 1 and len(low_rank[0]) == 0:
        levels = (h.geometry, h.common, h.work, h.operator, h.rows, h.segments)
        vectors = (np.zeros_like(b), np.zeros_like(b), np.zeros(len(b), np.float32))
        return conjugate_gradients_alone(levels, p, b, goal, max_iterations, vectors)
    sums = np.zeros(g[PLANES])
    q, r, direction = np.zeros_like(b), np.zeros_like(b), np.zeros(len(b), np.float32)

    x, rhs, _ = h.work
    turned, moved = (direction, x, q), (p, r, direction, q, rhs)
    with_terms = len(low_rank[0]) > 0

    def true_residual() -> float:
        _residual(g, (p, b, q, r), h.operator, h.segments, sums)
        if not with_terms:
            return in_order(sums)
        add_low_rank(p, q, *low_rank)
        np.subtract(b, q, out=r)
        return float(np.square(r).sum())

    squared, iterations = true_residual(), 0
    for _ in range(RESTARTS):
        if iterations == max_iterations or not squared > goal**2:
            break
        before, rz, fresh = squared, 1.0, True
        # near one: single precision neither over- nor underflows
        scale = 1.0 / np.sqrt(squared)
        _descend(g, moved, 0.0, scale, h.segments, sums)
        while iterations < max_iterations and squared > goal**2:
            previous, rz = rz, cycle(h, sums)
            if not rz > 0:
                break
            factor = np.float32(0.0 if fresh else rz / previous)
            for border in range(min(g[PARTS], 2)):
                _turn(border, g, turned, factor, h.operator, h.segments, sums)
            curvature = in_order(sums) + (add_low_rank(direction, q, *low_rank) if with_terms else 0.0)
            if not curvature > 0:
                break
            # rz and the direction belong to the scaled residual
            _descend(g, moved, rz / (scale * curvature), scale, h.segments, sums)
            squared, fresh = in_order(sums), False
            iterations += 1
        squared = true_residual()
        if not squared < 0.25 * before:
            break
    return iterations, float(np.sqrt(squared))


@njit(cache=True, inline="always")
def _true_residual(g, vectors, operator, segments):
    p, b, q, r = vectors
    total = 0.0
    for i in range(1, g[PLANES] - 1):
        apply_plane(i, g, p, q, operator, segments)
        total += residual_plane(i, g, b, q, r, segments)
    return total


@njit(cache=True, nogil=True)
def conjugate_gradients_alone(level_arrays, p, b, goal, max_iterations, vectors):
    """`conjugate_gradients` without low-rank terms on one thread and without the interpreter's lock: the same bits.

    level_arrays = (geometry, common, work, operator, rows, segments) of a `Hierarchy`; vectors = (q, r, direction) as
    there, of which direction must be 0.
    """
    geometry, common, work, operator, rows, segments = level_arrays
    g = geometry[0]
    q, r, direction = vectors
    x, rhs, _ = work
    sums = np.zeros(g[PLANES])
    whole = _all_planes(g)
    moved = (p, r, direction, q, rhs)
    squared, iterations = _true_residual(g, (p, b, q, r), operator, segments), 0
    for _ in range(RESTARTS):
        if iterations == max_iterations or not squared > goal**2:
            break
        before, rz, fresh = squared, 1.0, True
        scale = 1.0 / np.sqrt(squared)
        for i in range(1, g[PLANES] - 1):
            descend_plane(i, g, moved, 0.0, scale, segments)
        while iterations < max_iterations and squared > goal**2:
            _cycle_alone(geometry, common, work, operator, rows, segments, sums)
            previous, rz = rz, in_order(sums)
            if not rz > 0:
                break
            factor = np.float32(0.0 if fresh else rz / previous)
            wave_turn(whole, g, (direction, x, q), factor, operator, segments, sums)
            curvature = in_order(sums)
            if not curvature > 0:
                break
            for i in range(1, g[PLANES] - 1):
                sums[i] = descend_plane(i, g, moved, rz / (scale * curvature), scale, segments)
            squared, fresh = in_order(sums), False
            iterations += 1
        squared = _true_residual(g, (p, b, q, r), operator, segments)
        if not squared < 0.25 * before:
            break
    return iterations, np.sqrt(squared)
