"""Levels of the multigrid solver: the operator on the finest grid and on coarser ones (memory: `multigrid_kernels`).

The coarse operator is the Galerkin product with piecewise constant transfer. Its couplings count half: piecewise
constant corrections overestimate the energy of smooth ones by two (Braess 1995, "Towards algebraic multigrid for
elliptic problems of second order"). The weights towards known cells and the added diagonal count `AIR_SHARE`: p = 0
stays where it is while the cells grow, so that it lies nearer in cells; a cell full of liquid below a row of air needs
2/3, one half full 1.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fluidlift.numerics.multigrid_kernels import (
    HALF,
    LENGTH,
    PLANES,
    ROW_BASE,
    ROWS,
    SEGMENT_BASE,
    U,
    neighbour_starts,
    place,
)
from fluidlift.numerics.sharing import in_order, shared

BLOCK = 8
"""t are visited in blocks of as many: a vector of single precision"""
SAME, MIXED = 1, 2
LEAST_SAME = 4
"""blocks for which leaving a run of mixed couplings pays"""
COARSEST_CELLS = 4
"""coarsening stops when the longest side has as many cells"""
AIR_SHARE = 0.8
AIR_LIMIT = 3.0
"""times the largest coupling of a fine cell: what lies nearer to p = 0 than that (ghost fluid) is 0 for the fine grid,
but the coarse cell around it reaches further"""


def bounds(unknown):
    """int64 [nx,4]: first j, last j + 1, first k, last k + 1 of the unknown cells of each plane; 0 where none is."""
    out = np.zeros((unknown.shape[0], 4), np.int64)
    _bounds(unknown, out)
    return out


@shared(lambda unknown, *_: (0, unknown.shape[0]))
def _bounds(begin, end, unknown, out):
    _, ny, nz = unknown.shape
    for i in range(begin, end):
        j0, j1, k0, k1 = ny, 0, nz, 0
        for j in range(ny):
            count = 0
            for k in range(nz):
                count += unknown[i, j, k]
            if count > 0:
                j0, j1 = min(j0, j), j + 1
                k = 0
                while not unknown[i, j, k]:
                    k += 1
                k0 = min(k0, k)
                k = nz
                while not unknown[i, j, k - 1]:
                    k -= 1
                k1 = max(k1, k)
        if j1 > 0:
            out[i, 0], out[i, 1], out[i, 2], out[i, 3] = j0, j1, k0, k1


def geometry_of(shape: tuple[int, ...]) -> np.ndarray:
    """int64 [levels,9], see `multigrid_kernels`; shape: cells along x, y, z of the finest level."""
    shapes = [shape]
    while max(shapes[-1]) > COARSEST_CELLS:
        shapes.append(tuple((n + 1) // 2 for n in shapes[-1]))
    lines, cells, rows, offsets = [], 0, 0, 0
    for nx, ny, nz in shapes:
        length = (ny + 2) | 1
        half = -(-((nz + 2) * length) // (2 * BLOCK)) * BLOCK
        lines.append([nx + 2, nz + 2, length, half, cells, rows, offsets, 0, 1])
        cells += 2 * half * (nx + 2)
        rows += (nx + 2) * (nz + 2)
        offsets += nx + 3
    return np.array(lines, np.int64)


@shared(lambda g, *_: (1, g[PLANES] - 1))
def assemble_finest(begin, end, g, corner, unknown, weights, added, operator, ranges, beside_known):
    """Couplings between unknown cells, weights towards known cells, the rows' ranges, and whether air is not 0.

    corner: indices of the first cell of the level in the arrays of the whole grid. added: of size 0 for none.
    """
    nx, ny, nz = unknown.shape
    wx, wy, wz = weights
    air, cx, cy, cz = operator
    first, last = ranges
    for i in range(begin, end):
        x = corner[0] + i - 1
        first_row = g[ROW_BASE] + i * g[ROWS]
        first[first_row : first_row + g[ROWS]] = g[LENGTH]
        for k in range(1, min(g[LENGTH] - 1, ny - corner[1] + 1)):
            y = corner[1] + k - 1
            for j in range(1, g[ROWS] - 1):
                z = corner[2] + j - 1
                if not unknown[x, y, z]:
                    continue
                o = place(g, i, j, k)
                first[first_row + j] = min(first[first_row + j], k)
                last[first_row + j] = k + 1
                total = np.float64(added[x, y, z]) if added.size > 0 else 0.0
                if x > 0 and unknown[x - 1, y, z]:
                    cx[o] = wx[x, y, z]
                else:
                    total += wx[x, y, z]
                if y > 0 and unknown[x, y - 1, z]:
                    cy[o] = wy[x, y, z]
                else:
                    total += wy[x, y, z]
                if z > 0 and unknown[x, y, z - 1]:
                    cz[o] = wz[x, y, z]
                else:
                    total += wz[x, y, z]
                if x == nx - 1 or not unknown[x + 1, y, z]:
                    total += wx[x + 1, y, z]
                if y == ny - 1 or not unknown[x, y + 1, z]:
                    total += wy[x, y + 1, z]
                if z == nz - 1 or not unknown[x, y, z + 1]:
                    total += wz[x, y, z + 1]
                if total > 0:
                    air[o] = total
                    beside_known[x, y, z] = True


@njit(cache=True)
def _range_of_coarse_row(fine, i, j, ranges):
    """The range of cells of a coarse row that hold the ranges of its four fine rows; (1, 1) where these are empty."""
    first, last = ranges
    low, high = fine[LENGTH], np.int64(0)
    for a in range(2 * i - 1, min(2 * i + 1, fine[PLANES] - 1)):
        for b in range(2 * j - 1, min(2 * j + 1, fine[ROWS] - 1)):
            row = fine[ROW_BASE] + a * fine[ROWS] + b
            if last[row] > first[row]:
                low, high = min(low, np.int64(first[row])), max(high, np.int64(last[row]))
    return ((low + 1) // 2, high // 2 + 1) if high > 0 else (np.int64(1), np.int64(1))


@shared(lambda fine, coarse, *_: (1, coarse[PLANES] - 1))
def assemble_coarse(begin, end, fine, coarse, inverse, operator, ranges):
    """Sums over the fine cells of each coarse cell: of the couplings across its low sides, and of air."""
    half = np.float32(0.5)
    air, cx, cy, cz = operator
    first, last = ranges
    for i in range(begin, end):
        for j in range(1, coarse[ROWS] - 1):
            row = coarse[ROW_BASE] + i * coarse[ROWS] + j
            low, high = _range_of_coarse_row(fine, i, j, ranges)
            first[row], last[row] = low, high
            for k in range(low, high):
                tx = ty = tz = np.float32(0.0)
                tair = 0.0
                for a in range(2 * i - 1, min(2 * i + 1, fine[PLANES] - 1)):
                    for b in range(2 * j - 1, min(2 * j + 1, fine[ROWS] - 1)):
                        for c in range(2 * k - 1, 2 * k + 1):
                            o = place(fine, a, b, c)
                            if inverse[o] == 0:
                                continue
                            if a == 2 * i - 1:
                                tx += cx[o]
                            if b == 2 * j - 1:
                                tz += cz[o]
                            if c == 2 * k - 1:
                                ty += cy[o]
                            if air[o] > 0:
                                largest = max(cx[o], cx[o + 2 * fine[HALF]], cy[o], cz[o])
                                largest = max(largest, cy[place(fine, a, b, c + 1)], cz[place(fine, a, b + 1, c)])
                                tair += min(air[o], AIR_LIMIT * largest) if largest > 0 else air[o]
                o = place(coarse, i, j, k)
                cx[o], cy[o], cz[o], air[o] = half * tx, half * ty, half * tz, AIR_SHARE * tair


@njit(cache=True)
def _span(g, i, ranges):
    """First t and last + 1 of plane i, in whole blocks, in rows with unknown cells; 0, 0 where there are none."""
    first, last = ranges
    begin, end = np.int64(0), np.int64(0)
    for j in range(1, g[ROWS] - 1):
        row = g[ROW_BASE] + i * g[ROWS] + j
        if last[row] > first[row]:
            if end == 0:
                begin = j * g[LENGTH] // (2 * BLOCK) * BLOCK
            end = ((j + 1) * g[LENGTH] // (2 * BLOCK) + 1) * BLOCK
    return begin, min(end, g[HALF])


def invert_diagonal(g, operator, ranges, inverse, common):
    """inverse = 1 / diagonal; common [3]: the largest couplings along x, y, z."""
    largest = np.zeros((g[PLANES], 3), np.float32)
    _invert_diagonal(g, operator, ranges, inverse, largest)
    common[:] = largest.max(axis=0)


@shared(lambda g, *_: (1, g[PLANES] - 1), error_model="numpy")
def _invert_diagonal(begin, end, g, operator, ranges, inverse, largest):
    air, cx, cy, cz = operator
    for i in range(begin, end):
        a, stop = _span(g, i, ranges)
        for s in range(2):
            own, _low, high, _left, right = neighbour_starts(g, i, s)
            o, f, u, r = U(own + a), U(own + 2 * g[HALF] + a), U(high + a), U(right + a)
            mx = my = mz = np.float32(0.0)
            for t in range(U(stop - a)):
                total = np.float32(air[o + t]) + cx[o + t] + cx[f + t] + cz[o + t] + cz[u + t] + cy[o + t] + cy[r + t]
                inverse[o + t] = np.float32(1.0) / total if total > 0 else np.float32(0.0)
                mx, my, mz = max(mx, cx[o + t]), max(my, cy[o + t]), max(mz, cz[o + t])
            largest[i, 0] = max(largest[i, 0], mx)
            largest[i, 1] = max(largest[i, 1], my)
            largest[i, 2] = max(largest[i, 2], mz)


@shared(lambda g, *_: (1, g[PLANES] - 1))
def classify(lead, stop, g, common, inverse, operator, ranges, same, blocks):
    """What each block of t holds: nothing, `SAME` or `MIXED` couplings; whether all blocks of a row are `SAME`.

    Only pairs of unknown cells count: a closed face between two makes their blocks `MIXED`.
    """
    _, cx, cy, cz = operator
    wx, wy, wz = common[0], common[1], common[2]
    for i in range(lead, stop):
        begin, end = _span(g, i, ranges)
        for s in range(2):
            own, low, high, left, right = neighbour_starts(g, i, s)
            for a in range(begin, end, BLOCK):
                o, b, f = U(own + a), U(own - 2 * g[HALF] + a), U(own + 2 * g[HALF] + a)
                d, u, l, r = U(low + a), U(high + a), U(left + a), U(right + a)
                cells = mixed = 0
                for t in range(U(BLOCK)):
                    cells += inverse[o + t] > 0
                    mixed += (inverse[o + t] > 0) & (
                        ((cx[o + t] != wx) & (inverse[b + t] > 0))
                        | ((cx[f + t] != wx) & (inverse[f + t] > 0))
                        | ((cz[o + t] != wz) & (inverse[d + t] > 0))
                        | ((cz[u + t] != wz) & (inverse[u + t] > 0))
                        | ((cy[o + t] != wy) & (inverse[l + t] > 0))
                        | ((cy[r + t] != wy) & (inverse[r + t] > 0))
                    )
                if cells > 0:
                    blocks[i, a // BLOCK] = max(blocks[i, a // BLOCK], MIXED if mixed > 0 else SAME)
        for j in range(1, g[ROWS] - 1):
            kind = 0
            for n in range((j * g[LENGTH] >> 1) // BLOCK, ((j + 1) * g[LENGTH] >> 1) // BLOCK + 1):
                kind = max(kind, blocks[i, n])
            same[g[ROW_BASE] + i * g[ROWS] + j] = kind < MIXED


@njit(cache=True)
def find_segments(g, blocks, offset, start, stop, same):
    """Runs of blocks, offset per plane, start and stop in t. Gaps of one block and short runs of `SAME` are closed.

    Returns how many cells lie in them.
    """
    begun = offset[g[SEGMENT_BASE] - 1] if g[SEGMENT_BASE] > 0 else np.int32(0)
    used = begun
    for i in range(g[PLANES]):
        offset[g[SEGMENT_BASE] + i] = used
        n = 0
        while n < blocks.shape[1]:
            if blocks[i, n] == 0:
                n += 1
                continue
            begin, last, kind = n, n, blocks[i, n]
            while n < blocks.shape[1] and (blocks[i, n] == kind or (blocks[i, n] == 0 and n - last < 2)):
                if blocks[i, n] == kind:
                    last = n
                n += 1
            n = last + 1
            joined = used > offset[g[SEGMENT_BASE] + i] and begin * BLOCK - stop[used - 1] <= BLOCK
            if joined and not same[used - 1] and (kind == MIXED or last + 1 - begin < LEAST_SAME):
                stop[used - 1] = (last + 1) * BLOCK
            else:
                start[used], stop[used], same[used] = begin * BLOCK, (last + 1) * BLOCK, kind == SAME
                used += 1
    offset[g[SEGMENT_BASE] + g[PLANES]] = used
    return 2 * (stop[begun:used] - start[begun:used]).sum()


def load(g, corner, values, factor, cells, out):
    """out = factor * values at the unknown cells. Returns the sum of squares; not finite where some value is not."""
    sums = np.zeros(g[PLANES])
    _load(g, corner, values, factor, cells, out, sums)
    return in_order(sums)


@shared(lambda g, *_: (1, g[PLANES] - 1))
def _load(begin, end, g, corner, values, factor, cells, out, sums):
    inverse, first, last = cells
    for i in range(begin, end):
        for j in range(1, g[ROWS] - 1):
            row = g[ROW_BASE] + i * g[ROWS] + j
            for k in range(first[row], last[row]):
                o = place(g, i, j, k)
                if inverse[o] > 0:
                    value = factor * values[corner[0] + i - 1, corner[1] + k - 1, corner[2] + j - 1]
                    out[o] = value
                    sums[i] += value * value


@shared(lambda g, *_: (1, g[PLANES] - 1))
def store(begin, end, g, corner, values, cells, out):
    """out at the unknown cells = values."""
    inverse, first, last = cells
    for i in range(begin, end):
        for j in range(1, g[ROWS] - 1):
            row = g[ROW_BASE] + i * g[ROWS] + j
            for k in range(first[row], last[row]):
                o = place(g, i, j, k)
                if inverse[o] > 0:
                    out[corner[0] + i - 1, corner[1] + k - 1, corner[2] + j - 1] = values[o]


@shared(lambda g, corner, runs, *_: (0, len(runs)))
def _sum_runs(begin, end, g, corner, runs, values, sums):
    for r in range(begin, end):
        i, k = runs[r, 0] - corner[0] + 1, runs[r, 1] - corner[1] + 1
        for z in range(runs[r, 2], runs[r, 3]):
            sums[r] += values[place(g, i, z - corner[2] + 1, k)]


@shared(lambda g, corner, runs, *_: (0, len(runs)))
def _shift_runs(begin, end, g, corner, runs, shift, values):
    for r in range(begin, end):
        i, k = runs[r, 0] - corner[0] + 1, runs[r, 1] - corner[1] + 1
        for z in range(runs[r, 2], runs[r, 3]):
            values[place(g, i, z - corner[2] + 1, k)] += shift[r]


def component_sums(
    g: np.ndarray, corner: np.ndarray, runs: np.ndarray, labels: np.ndarray, count: int, values: np.ndarray
) -> np.ndarray:
    """Sum of values over the cells of each component."""
    sums = np.zeros(len(runs))
    _sum_runs(g, corner, runs, values, sums)
    return np.bincount(labels, weights=sums, minlength=count)


def shift_components(
    g: np.ndarray, corner: np.ndarray, runs: np.ndarray, labels: np.ndarray, shift: np.ndarray, values: np.ndarray
) -> None:
    """Add shift [components] to the values of the cells of each component."""
    _shift_runs(g, corner, runs, shift[labels], values)
