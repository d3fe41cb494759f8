"""Conjugate gradients preconditioned by a geometric multigrid V-cycle, for the cell Poisson equation.

After McAdams, Sifakis, Teran 2010, "A parallel multigrid Poisson solver for fluids simulation on large grids". The
coarse operator is the Galerkin product with piecewise constant transfer, times one half: piecewise constant
interpolation overestimates the energy of smooth corrections by two, and the scaling mends it (Braess 1995).
The Krylov space is kept in double precision, the V-cycle in single.

Arrays of a level carry a ring of ghost cells, and `coupling_x[i]` joins the cells i-1 and i. Only the range of
unknown cells of each vertical column is visited (`first`, `last`): a river fills a small part of its box.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit, prange

SWEEPS = 2
"""red-black Gauss-Seidel sweeps before and after each coarse correction"""
COARSEST_SWEEPS = 12
COARSEST_CELLS = 4
"""coarsening stops when the longest side has this many cells"""


@dataclass(frozen=True)
class Level:
    """The operator on one grid and its work space, all padded by one ghost cell."""

    diagonal: np.ndarray
    inverse: np.ndarray
    """1 / diagonal, 0 outside the unknown cells"""
    couplings: tuple[np.ndarray, np.ndarray, np.ndarray]
    """weight / h^2 between neighbouring unknown cells"""
    first: np.ndarray
    last: np.ndarray
    """int32 per column: the unknown cells lie in first <= k < last"""
    x: np.ndarray
    rhs: np.ndarray


@njit(parallel=True, cache=True)
def _smooth(x, rhs, inverse, cx, cy, cz, first, last, color):
    """One half sweep of Gauss-Seidel over the cells of one colour."""
    nx, ny, _ = x.shape
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        for j in range(1, ny - 1):
            start = np.int64(first[i, j])
            start += (i + j + start + color) & 1
            for k in range(start, np.int64(last[i, j]), 2):
                total = (
                    rhs[i, j, k]
                    + cx[i, j, k] * x[i - 1, j, k]
                    + cx[i + 1, j, k] * x[i + 1, j, k]
                    + cy[i, j, k] * x[i, j - 1, k]
                    + cy[i, j + 1, k] * x[i, j + 1, k]
                    + cz[i, j, k] * x[i, j, k - 1]
                    + cz[i, j, k + 1] * x[i, j, k + 1]
                )
                x[i, j, k] = total * inverse[i, j, k]


@njit(parallel=True, cache=True)
def _restrict_residual(x, rhs, diagonal, cx, cy, cz, first, last, coarse_rhs, coarse_x):
    """Sum of the fine residuals in each coarse cell; the coarse guess becomes 0."""
    nx, ny, nz = coarse_rhs.shape
    fx, fy, _ = x.shape
    for ci_ in prange(1, nx - 1):
        ci = np.int64(ci_)
        for cj in range(1, ny - 1):
            for ck in range(1, nz - 1):
                coarse_rhs[ci, cj, ck] = 0.0
                coarse_x[ci, cj, ck] = 0.0
            for i in range(2 * ci - 1, min(2 * ci + 1, fx - 1)):
                for j in range(2 * cj - 1, min(2 * cj + 1, fy - 1)):
                    for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                        if diagonal[i, j, k] > 0:
                            coarse_rhs[ci, cj, (k + 1) // 2] += (
                                rhs[i, j, k]
                                - diagonal[i, j, k] * x[i, j, k]
                                + cx[i, j, k] * x[i - 1, j, k]
                                + cx[i + 1, j, k] * x[i + 1, j, k]
                                + cy[i, j, k] * x[i, j - 1, k]
                                + cy[i, j + 1, k] * x[i, j + 1, k]
                                + cz[i, j, k] * x[i, j, k - 1]
                                + cz[i, j, k + 1] * x[i, j, k + 1]
                            )


@njit(parallel=True, cache=True)
def _add_coarse(x, diagonal, first, last, coarse_x):
    """x += the coarse correction, constant over each coarse cell."""
    nx, ny, _ = x.shape
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        for j in range(1, ny - 1):
            for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                if diagonal[i, j, k] > 0:
                    x[i, j, k] += coarse_x[(i + 1) // 2, (j + 1) // 2, (k + 1) // 2]


@njit(parallel=True, cache=True)
def _apply(p, out, diagonal, cx, cy, cz, first, last):
    """out = A p; returns p . out."""
    nx, ny, _ = p.shape
    rows = np.zeros(nx)
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        dot = 0.0
        for j in range(1, ny - 1):
            for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                total = (
                    diagonal[i, j, k] * p[i, j, k]
                    - cx[i, j, k] * p[i - 1, j, k]
                    - cx[i + 1, j, k] * p[i + 1, j, k]
                    - cy[i, j, k] * p[i, j - 1, k]
                    - cy[i, j + 1, k] * p[i, j + 1, k]
                    - cz[i, j, k] * p[i, j, k - 1]
                    - cz[i, j, k + 1] * p[i, j, k + 1]
                )
                out[i, j, k] = total
                dot += p[i, j, k] * total
        rows[i] = dot
    return rows.sum()


@njit(parallel=True, cache=True)
def _descend(p, r, direction, q, step, first, last):
    """p += step direction, r -= step q; returns r . r. (Kernels of our own: threaded BLAS stalls on busy machines.)"""
    nx, ny, _ = p.shape
    rows = np.zeros(nx)
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        dot = 0.0
        for j in range(1, ny - 1):
            for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                p[i, j, k] += step * direction[i, j, k]
                r[i, j, k] -= step * q[i, j, k]
                dot += r[i, j, k] * r[i, j, k]
        rows[i] = dot
    return rows.sum()


@njit(parallel=True, cache=True)
def _dot(r, z, first, last):
    """r . z over the columns."""
    nx, ny, _ = r.shape
    rows = np.zeros(nx)
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        dot = 0.0
        for j in range(1, ny - 1):
            for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                dot += r[i, j, k] * z[i, j, k]
        rows[i] = dot
    return rows.sum()


@njit(parallel=True, cache=True)
def _turn(direction, z, factor, first, last):
    """direction = z + factor direction."""
    nx, ny, _ = direction.shape
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        for j in range(1, ny - 1):
            for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                direction[i, j, k] = z[i, j, k] + factor * direction[i, j, k]


@njit(parallel=True, cache=True)
def _right_side(r, inverse, scale, cycles, rhs, x, first, last):
    """Prepare the preconditioner: rhs = scale r, x = 0; or x = r / diagonal where there are no cycles."""
    nx, ny, _ = r.shape
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        for j in range(1, ny - 1):
            for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                rhs[i, j, k] = scale * r[i, j, k]
                x[i, j, k] = 0.0 if cycles else scale * r[i, j, k] * inverse[i, j, k]


@njit(parallel=True, cache=True)
def _coarse_couplings(fine, axis, coarse):
    """Half the sum of the fine couplings across each coarse face."""
    nx, ny, nz = coarse.shape
    fx, fy, fz = fine.shape
    di = 1 if axis == 0 else 2
    dj = 1 if axis == 1 else 2
    dk = 1 if axis == 2 else 2
    for ci_ in prange(1, nx - 1):
        ci = np.int64(ci_)
        for cj in range(1, ny - 1):
            for ck in range(1, nz - 1):
                total = 0.0
                for i in range(2 * ci - 1, min(2 * ci - 1 + di, fx - 1)):
                    for j in range(2 * cj - 1, min(2 * cj - 1 + dj, fy - 1)):
                        for k in range(2 * ck - 1, min(2 * ck - 1 + dk, fz - 1)):
                            total += fine[i, j, k]
                coarse[ci, cj, ck] = 0.5 * total


@njit(parallel=True, cache=True)
def _coarse_diagonal(diagonal, cx, cy, cz, coarse):
    """Half of the sum of the fine diagonals less the couplings inside the coarse cell (each counts twice)."""
    nx, ny, nz = coarse.shape
    fx, fy, fz = diagonal.shape
    for ci_ in prange(1, nx - 1):
        ci = np.int64(ci_)
        for cj in range(1, ny - 1):
            for ck in range(1, nz - 1):
                total = 0.0
                for i in range(2 * ci - 1, min(2 * ci + 1, fx - 1)):
                    for j in range(2 * cj - 1, min(2 * cj + 1, fy - 1)):
                        for k in range(2 * ck - 1, min(2 * ck + 1, fz - 1)):
                            total += diagonal[i, j, k]
                            if i == 2 * ci:
                                total -= 2.0 * cx[i, j, k]
                            if j == 2 * cj:
                                total -= 2.0 * cy[i, j, k]
                            if k == 2 * ck:
                                total -= 2.0 * cz[i, j, k]
                coarse[ci, cj, ck] = 0.5 * total


def _column_ranges(unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    some = unknown.any(axis=2)
    first = np.where(some, unknown.argmax(axis=2), 1)
    last = np.where(some, unknown.shape[2] - unknown[:, :, ::-1].argmax(axis=2), 1)
    return first.astype(np.int32), last.astype(np.int32)


def _level(diagonal: np.ndarray, couplings: tuple[np.ndarray, ...]) -> Level:
    unknown = diagonal > 0
    inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=unknown)
    first, last = _column_ranges(unknown)
    x, y, z = couplings
    return Level(diagonal, inverse, (x, y, z), first, last, np.zeros_like(diagonal), np.zeros_like(diagonal))


def _finest(
    unknown: np.ndarray, weights: tuple[np.ndarray, ...], spacing: float, added_diagonal: np.ndarray | None
) -> Level:
    diagonal = np.zeros(tuple(n + 2 for n in unknown.shape), np.float32)
    inner = (slice(1, -1),) * 3
    couplings = []
    total = np.zeros(unknown.shape, np.float32)
    for axis, w in enumerate(weights):
        w = np.moveaxis(w, axis, 0)
        sum_here = np.moveaxis(total, axis, 0)
        sum_here += w[1:]
        sum_here += w[:-1]
        cell = np.moveaxis(unknown, axis, 0)
        coupling = np.zeros(diagonal.shape, np.float32)
        np.moveaxis(coupling[inner], axis, 0)[1:] = np.where(cell[1:] & cell[:-1], w[1:-1], 0) / spacing**2
        couplings.append(coupling)
    total /= spacing**2
    if added_diagonal is not None:
        # only faces between unknown cells carry weight here: what is known has been put into the added diagonal
        total += added_diagonal
    diagonal[inner] = np.where(unknown, total, 0)
    return _level(diagonal, tuple(couplings))


def _coarser(level: Level) -> Level:
    shape = tuple((n - 2 + 1) // 2 + 2 for n in level.diagonal.shape)
    couplings = []
    for axis in range(3):
        coarse = np.zeros(shape, np.float32)
        _coarse_couplings(level.couplings[axis], axis, coarse)
        couplings.append(coarse)
    diagonal = np.zeros(shape, np.float32)
    _coarse_diagonal(level.diagonal, *level.couplings, diagonal)
    # A coarse cell that holds all of a closed component keeps only the rounding of its couplings: nothing to solve.
    strength = np.zeros(shape, np.float32)
    for axis, c in enumerate(couplings):
        along = np.moveaxis(strength, axis, 0)
        along += np.moveaxis(c, axis, 0)
        along[:-1] += np.moveaxis(c, axis, 0)[1:]
    largest = float(level.diagonal.max(initial=0.0))
    np.maximum(diagonal, strength, out=diagonal)
    diagonal[diagonal < 1e-5 * largest] = 0.0
    return _level(diagonal, tuple(couplings))


def build_levels(
    unknown: np.ndarray,
    weights: tuple[np.ndarray, ...],
    spacing: float,
    *,
    added_diagonal: np.ndarray | None = None,
    coarsen: bool = True,
) -> list[Level]:
    """The operator on ever coarser grids, finest first; only the finest without `coarsen`."""
    levels = [_finest(unknown, weights, spacing, added_diagonal)]
    while coarsen and max(levels[-1].diagonal.shape) - 2 > COARSEST_CELLS:
        levels.append(_coarser(levels[-1]))
    return levels


def _sweeps(level: Level, colors: tuple[int, ...], count: int) -> None:
    for _ in range(count):
        for color in colors:
            _smooth(level.x, level.rhs, level.inverse, *level.couplings, level.first, level.last, color)


def v_cycle(levels: list[Level]) -> None:
    """levels[0].x, 0 before, becomes an approximate solution for levels[0].rhs: linear, symmetric, positive."""
    for fine, coarse in pairwise(levels):
        _sweeps(fine, (0, 1), SWEEPS)
        _restrict_residual(
            fine.x, fine.rhs, fine.diagonal, *fine.couplings, fine.first, fine.last, coarse.rhs, coarse.x
        )
    _sweeps(levels[-1], (0, 1), COARSEST_SWEEPS)
    _sweeps(levels[-1], (1, 0), COARSEST_SWEEPS)
    for fine, coarse in zip(levels[-2::-1], levels[:0:-1]):
        _add_coarse(fine.x, fine.diagonal, fine.first, fine.last, coarse.x)
        _sweeps(fine, (1, 0), SWEEPS)


def _bounding_box(mask: np.ndarray) -> tuple[slice, ...] | None:
    box = []
    for axis in range(3):
        hit = np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis)))
        if len(hit) == 0:
            return None
        box.append(slice(int(hit[0]), int(hit[-1]) + 1))
    return tuple(box)


def solve(
    unknown: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray, np.ndarray],
    spacing: float,
    rhs: np.ndarray,
    *,
    tolerance: float,
    max_iterations: int,
    initial: np.ndarray,
    added_diagonal: np.ndarray | None = None,
    cycles: bool = True,
) -> tuple[np.ndarray, int, float]:
    """p (float64) with |rhs - A p| <= tolerance |rhs|, the number of iterations, and the true relative residual.

    Args:
        unknown: bool [nx,ny,nz].
        weights: face fractions across x, y, z.
        spacing: cell width, m.
        rhs: float64 [nx,ny,nz], of zero mean over closed components.
        tolerance: relative residual in the 2-norm.
        max_iterations: of the conjugate gradients.
        initial: float64 first guess.
        added_diagonal: float32 [nx,ny,nz] added to the operator (the unit matrix of implicit diffusion).
        cycles: precondition with V-cycles; False: with the diagonal, enough where the added diagonal dominates.
    """
    box = _bounding_box(unknown)
    if box is None:
        return np.zeros_like(rhs), 0, 0.0
    cropped = []
    for axis, w in enumerate(weights):
        cut = list(box)
        cut[axis] = slice(box[axis].start, box[axis].stop + 1)
        cropped.append(w[tuple(cut)])
    added = None if added_diagonal is None else added_diagonal[box]
    levels = build_levels(unknown[box], tuple(cropped), spacing, added_diagonal=added, coarsen=cycles)
    fine = levels[0]
    inner = (slice(1, -1),) * 3
    columns = (fine.first, fine.last)

    def precondition() -> None:
        _right_side(r, fine.inverse, scale, cycles, fine.rhs, fine.x, *columns)
        if cycles:
            v_cycle(levels)

    p, r, q, direction = (np.zeros(fine.diagonal.shape) for _ in range(4))
    p[inner] = initial[box]
    p[fine.diagonal <= 0] = 0.0
    r[inner] = np.where(unknown[box], rhs[box], 0.0)
    size = float(np.sqrt(np.square(r).sum()))
    goal = tolerance * size
    scale = 1.0 / max(float(np.abs(r).max()), 1e-300)  # near one: single precision neither over- nor underflows
    _apply(p, q, fine.diagonal, *fine.couplings, *columns)
    squared = _descend(p, r, direction, q, 1.0, *columns)
    iterations, rz = 0, 1.0
    while iterations < max_iterations and squared > goal * goal:
        precondition()
        rz, previous = _dot(r, fine.x, *columns), rz
        if not rz > 0:
            break
        _turn(direction, fine.x, rz / previous if iterations else 0.0, *columns)
        curvature = _apply(direction, q, fine.diagonal, *fine.couplings, *columns)
        if not curvature > 0:
            break
        squared = _descend(p, r, direction, q, rz / curvature, *columns)
        iterations += 1
    _apply(p, q, fine.diagonal, *fine.couplings, *columns)
    r[inner] = np.where(unknown[box], rhs[box], 0.0)
    residual = float(np.sqrt(np.square(r - q).sum())) / size if size > 0 else 0.0
    out = np.zeros_like(rhs)
    out[box] = p[inner]
    return out, iterations, residual
