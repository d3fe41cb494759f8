"""Kernels of the multigrid solver: half sweeps, transfers between grids, and the vectors of conjugate gradients.

Memory. A level is cut into planes along x. A plane is read row by row, rows along z and cells along y (water lies in
sheets: its cells are long runs of y), with a ring of ghost cells and an odd row length. The cell at place m of its
plane (m = row * row length + cell) lies in half m & 1 of the plane at t = m >> 1, so at

    base + (2 plane + (m & 1)) * half plane + t.

With odd rows all six neighbours of a cell have the other colour, (plane + m) & 1, and cells of one colour side by side
have neighbours side by side: half sweeps of red-black Gauss-Seidel read and write contiguous memory, in vector
registers. `segments` are the runs of t in which a plane has unknown cells; other cells keep their zeros, and so do the
couplings to them.

Each sum over cells is kept per plane and the planes are added in order: the result is the same for any number of
threads. Indices are unsigned, since signed ones cost a test each against counting from the end.

Arrays are one-dimensional, with the levels in a row, and come in tuples:
work = (x, rhs, inverse), float32; inverse is 1 / diagonal, 0 outside the unknown cells.
operator = (air, cx, cy, cz): couplings with the neighbour on the low side along x, y, z, float32; and what the diagonal
holds beyond them, float64: it sums weights, and residuals must see these in full.
rows = (first, last, same): the cells of each row from first to last - 1. segments = (offset, start, stop, same). `same`
marks where all couplings between unknown cells have the values `common` (along x, y, z), which is nearly everywhere:
neighbours that are not unknown hold x = 0, so there the couplings need not be read.
"""

from __future__ import annotations

import numpy as np
from numba import njit

FAST = {"contract", "nsz", "reassoc"}
"""sums may be reordered for vector registers; not-a-number stays what it is"""
PLANES, ROWS, LENGTH, HALF, BASE, ROW_BASE, SEGMENT_BASE, CELLS, PARTS = range(9)
"""columns of `geometry`, which has a line g per level: planes, rows and cells per row with ghosts, size of half a
plane, where the level starts in the arrays of cells, rows and segment offsets, cells in segments, parts for threads"""
RED, BLACK = np.int64(0), np.int64(1)
"""of one type with computed ones: a function that is given a literal number is compiled once more for it"""

U = np.uint64


@njit(cache=True, forceinline=True)
def place(g, i, j, k):
    """Index of the cell at plane i, row j, cell k of a level, ghosts counted."""
    m = j * g[LENGTH] + k
    return g[BASE] + (2 * i + (m & 1)) * g[HALF] + (m >> 1)


@njit(cache=True, forceinline=True)
def neighbour_starts(g, i, s):
    """Index at t = 0 of half s of plane i, and of its neighbours at row - 1, row + 1, cell - 1, cell + 1."""
    own = g[BASE] + (2 * i + s) * g[HALF]
    other = own + (1 - 2 * s) * g[HALF]
    reach = g[LENGTH] // 2
    return own, other - reach - 1 + s, other + reach + s, other - 1 + s, other + s


@njit(cache=True, fastmath=FAST, forceinline=True)
def divide_plane(i, color, g, work, segments):
    """One half sweep from x = 0."""
    x, rhs, inverse = work
    offset, start, stop, _ = segments
    own = g[BASE] + (2 * i + ((i + color) & 1)) * g[HALF]
    for n in range(offset[g[SEGMENT_BASE] + i], offset[g[SEGMENT_BASE] + i + 1]):
        o = U(own + start[n])
        for t in range(U(stop[n] - start[n])):
            x[o + t] = rhs[o + t] * inverse[o + t]


@njit(cache=True, fastmath=FAST, forceinline=True)
def relax_plane(i, color, g, common, work, operator, segments):
    """One half sweep of Gauss-Seidel over the cells of one colour."""
    x, rhs, inverse = work
    _, cx, cy, cz = operator
    offset, start, stop, same = segments
    wx, wy, wz = common[0], common[1], common[2]
    own, low, high, left, right = neighbour_starts(g, i, (i + color) & 1)
    for n in range(offset[g[SEGMENT_BASE] + i], offset[g[SEGMENT_BASE] + i + 1]):
        a = np.int64(start[n])
        o, b, f = U(own + a), U(own - 2 * g[HALF] + a), U(own + 2 * g[HALF] + a)
        d, u, l, r = U(low + a), U(high + a), U(left + a), U(right + a)
        if same[n]:
            for t in range(U(stop[n] - start[n])):
                x[o + t] = inverse[o + t] * (
                    rhs[o + t] + wx * (x[b + t] + x[f + t]) + wz * (x[d + t] + x[u + t]) + wy * (x[l + t] + x[r + t])
                )
            continue
        for t in range(U(stop[n] - start[n])):
            x[o + t] = inverse[o + t] * (
                rhs[o + t]
                + cx[o + t] * x[b + t]
                + cx[f + t] * x[f + t]
                + cz[o + t] * x[d + t]
                + cz[u + t] * x[u + t]
                + cy[o + t] * x[l + t]
                + cy[r + t] * x[r + t]
            )


@njit(cache=True, fastmath=FAST, forceinline=True, error_model="numpy")
def restrict_plane(i, levels, work, operator, rows):
    """rhs of coarse plane i: the sum of the fine residuals in each cell. Black cells, relaxed last, have none."""
    fine, coarse, common = levels
    x, rhs, inverse = work
    air, cx, cy, cz = operator
    first, last, same = rows
    wx, wy, wz = common[0], common[1], common[2]
    total = np.zeros(coarse[ROWS] * coarse[LENGTH], np.float32)
    for fi in range(2 * i - 1, min(2 * i + 1, fine[PLANES] - 1)):
        s = (fi + RED) & 1
        own, low, high, left, right = neighbour_starts(fine, fi, s)
        for fj in range(1, fine[ROWS] - 1):
            j = (fj + 1) // 2
            row = coarse[ROW_BASE] + i * coarse[ROWS] + j
            k = np.int64(first[row])
            m = fj * fine[LENGTH] + 2 * k - 1
            a = (m + ((m ^ s) & 1)) >> 1  # the red one of the two cells of each pair
            c, o, b, f = U(j * coarse[LENGTH] + k), U(own + a), U(own - 2 * fine[HALF] + a), U(own + 2 * fine[HALF] + a)
            d, u, l, r = U(low + a), U(high + a), U(left + a), U(right + a)
            count = U(max(last[row] - first[row], 0))
            if same[fine[ROW_BASE] + fi * fine[ROWS] + fj]:
                for t in range(count):
                    residual = (
                        rhs[o + t]
                        - x[o + t] / inverse[o + t]
                        + wx * (x[b + t] + x[f + t])
                        + wz * (x[d + t] + x[u + t])
                        + wy * (x[l + t] + x[r + t])
                    )
                    total[c + t] += residual if inverse[o + t] > 0 else np.float32(0.0)
                continue
            for t in range(count):
                here = x[o + t]
                total[c + t] += (
                    rhs[o + t]
                    - np.float32(air[o + t]) * here
                    + cx[o + t] * (x[b + t] - here)
                    + cx[f + t] * (x[f + t] - here)
                    + cz[o + t] * (x[d + t] - here)
                    + cz[u + t] * (x[u + t] - here)
                    + cy[o + t] * (x[l + t] - here)
                    + cy[r + t] * (x[r + t] - here)
                )
    for j in range(1, coarse[ROWS] - 1):
        row = coarse[ROW_BASE] + i * coarse[ROWS] + j
        for s in range(2):
            k = np.int64(first[row]) + s
            o, c = U(place(coarse, i, j, k)), U(j * coarse[LENGTH] + k)
            for t in range(U(max(last[row] - k + 1, 0) // 2)):
                rhs[o + t] = total[c + U(2) * t]


@njit(cache=True, fastmath=FAST, forceinline=True)
def prolong_plane(i, levels, work, rows):
    """x += the coarse correction, constant over each coarse cell; red cells only: the black ones follow from them."""
    fine, coarse, _ = levels
    x, _, inverse = work
    first, last, _ = rows
    value = np.empty(coarse[LENGTH], np.float32)
    ci, half = (i + 1) // 2, (i + RED) & 1
    for j in range(1, coarse[ROWS] - 1):
        row = coarse[ROW_BASE] + ci * coarse[ROWS] + j
        if last[row] <= first[row]:
            continue
        for s in range(2):
            k = np.int64(first[row]) + s
            o = U(place(coarse, ci, j, k))
            for t in range(U(max(last[row] - k + 1, 0) // 2)):
                value[U(2) * t + U(s)] = x[o + t]
        for fj in range(2 * j - 1, min(2 * j + 1, fine[ROWS] - 1)):
            m = fj * fine[LENGTH] + 2 * np.int64(first[row]) - 1
            o = U(fine[BASE] + (2 * i + half) * fine[HALF] + ((m + ((m ^ half) & 1)) >> 1))
            for t in range(U(last[row] - first[row])):
                x[o + t] += value[t] if inverse[o + t] > 0 else np.float32(0.0)


@njit(cache=True, fastmath=FAST, forceinline=True)
def dot_plane(i, g, work, segments):
    """x . rhs."""
    x, rhs, _ = work
    offset, start, stop, _ = segments
    total = 0.0
    for s in range(2):
        own = g[BASE] + (2 * i + s) * g[HALF]
        for n in range(offset[g[SEGMENT_BASE] + i], offset[g[SEGMENT_BASE] + i + 1]):
            o = U(own + start[n])
            for t in range(U(stop[n] - start[n])):
                total += np.float64(x[o + t]) * np.float64(rhs[o + t])
    return total


@njit(cache=True, fastmath=FAST, forceinline=True)
def turn_plane(i, g, direction, z, factor, segments):
    """direction = z + factor direction."""
    offset, start, stop, _ = segments
    for s in range(2):
        own = g[BASE] + (2 * i + s) * g[HALF]
        for n in range(offset[g[SEGMENT_BASE] + i], offset[g[SEGMENT_BASE] + i + 1]):
            o = U(own + start[n])
            for t in range(U(stop[n] - start[n])):
                direction[o + t] = z[o + t] + factor * direction[o + t]


@njit(cache=True, fastmath=FAST, forceinline=True)
def apply_plane(i, g, p, out, operator, segments):
    """out = A p in double precision, by differences: a constant leaves no rounding. Returns p . out."""
    air, cx, cy, cz = operator
    offset, start, stop, _ = segments
    dot = 0.0
    for s in range(2):
        own, low, high, left, right = neighbour_starts(g, i, s)
        for n in range(offset[g[SEGMENT_BASE] + i], offset[g[SEGMENT_BASE] + i + 1]):
            a = np.int64(start[n])
            o, b, f = U(own + a), U(own - 2 * g[HALF] + a), U(own + 2 * g[HALF] + a)
            d, u, l, r = U(low + a), U(high + a), U(left + a), U(right + a)
            for t in range(U(stop[n] - start[n])):
                here = np.float64(p[o + t])
                value = (
                    air[o + t] * here
                    + np.float64(cx[o + t]) * (here - np.float64(p[b + t]))
                    + np.float64(cx[f + t]) * (here - np.float64(p[f + t]))
                    + np.float64(cz[o + t]) * (here - np.float64(p[d + t]))
                    + np.float64(cz[u + t]) * (here - np.float64(p[u + t]))
                    + np.float64(cy[o + t]) * (here - np.float64(p[l + t]))
                    + np.float64(cy[r + t]) * (here - np.float64(p[r + t]))
                )
                out[o + t] = value
                dot += here * value
    return dot


@njit(cache=True, fastmath=FAST, forceinline=True)
def residual_plane(i, g, b, q, r, segments):
    """r = b - q. Returns r . r."""
    offset, start, stop, _ = segments
    dot = 0.0
    for s in range(2):
        own = g[BASE] + (2 * i + s) * g[HALF]
        for n in range(offset[g[SEGMENT_BASE] + i], offset[g[SEGMENT_BASE] + i + 1]):
            o = U(own + start[n])
            for t in range(U(stop[n] - start[n])):
                value = b[o + t] - q[o + t]
                r[o + t] = value
                dot += value * value
    return dot


@njit(cache=True, fastmath=FAST, forceinline=True)
def descend_plane(i, g, vectors, step, scale, segments):
    """p += step direction, r -= step q, rhs = scale r. Returns r . r. vectors = (p, r, direction, q, rhs)."""
    p, r, direction, q, rhs = vectors
    offset, start, stop, _ = segments
    dot = 0.0
    for s in range(2):
        own = g[BASE] + (2 * i + s) * g[HALF]
        for n in range(offset[g[SEGMENT_BASE] + i], offset[g[SEGMENT_BASE] + i + 1]):
            o = U(own + start[n])
            for t in range(U(stop[n] - start[n])):
                p[o + t] += step * np.float64(direction[o + t])
                value = r[o + t] - step * q[o + t]
                r[o + t] = value
                rhs[o + t] = np.float32(scale * value)
                dot += value * value
    return dot


@njit(cache=True, inline="always")
def wave_down(reach, coarse_planes, levels, work, operator, rows, segments):
    """Four half sweeps from x = 0, then the residual on the coarse planes from the first to the last - 1.

    reach = (a, b, da, db): half sweep k visits the planes a + k da to b + k db - 1, one plane behind half sweep k - 1.
    The wave keeps a plane in cache until all is done with it.
    """
    a, b, da, db = reach
    c, last = coarse_planes
    fine, _, common = levels
    for front in range(min(a, a + 3 * da), max(b, b + 3 * db) + 3):
        for k in range(4):
            i = front - k
            if a + k * da <= i < b + k * db:
                if k == 0:
                    divide_plane(i, RED, fine, work, segments)
                else:
                    relax_plane(i, k & 1, fine, common, work, operator, segments)
        while c < last and 2 * c + 1 <= front - 3:
            restrict_plane(c, levels, work, operator, rows)
            c += 1
    while c < last:
        restrict_plane(c, levels, work, operator, rows)
        c += 1


@njit(cache=True, inline="always")
def wave_up(reach, levels, work, operator, rows, segments, sums):
    """The coarse correction and four half sweeps, in a wave as `wave_down`; sums gets x . rhs of each plane."""
    a, b, da, db = reach
    fine, _, common = levels
    for front in range(min(a, a + 4 * da), max(b, b + 4 * db) + 4):
        for k in range(5):
            i = front - k
            if a + k * da <= i < b + k * db:
                if k == 0:
                    prolong_plane(i, levels, work, rows)
                else:
                    relax_plane(i, k & 1, fine, common, work, operator, segments)
                if k == 4:
                    sums[i] = dot_plane(i, fine, work, segments)


@njit(cache=True, inline="always")
def wave_turn(reach, g, vectors, factor, operator, segments, sums):
    """direction = z + factor direction and q = A direction, in a wave; sums gets direction . q of each plane.

    vectors = (direction, z, q).
    """
    a, b, da, db = reach
    direction, z, q = vectors
    for front in range(min(a, a + da), max(b, b + db) + 1):
        if a <= front < b:
            turn_plane(front, g, direction, z, factor, segments)
        if a + da <= front - 1 < b + db:
            sums[front - 1] = apply_plane(front - 1, g, direction, q, operator, segments)
