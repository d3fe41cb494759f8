"""MacCormack advection of a staggered velocity by itself (Selle et al. 2008), compiled.

A component is traced back to where the flow came from, from there forth again, and what it comes back with tells the
error of the first trace: half of it is taken off, within the range of the eight values that the back-trace used.

How far the flow goes is split into whole cells and a fraction before the face's own place is added: so single precision
keeps all its digits in the weights.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fluidlift.numerics.sharing import shared
from fluidlift.types import FaceVelocity, Grid


@njit(cache=True)
def _four(field, shape, axis, other, i, j, k):
    """Component `other` at a face across `axis`: mean of the four nearest faces; beyond the array its last ones."""
    row, plane = shape[2], shape[1] * shape[2]
    i0, j0, k0 = i - (axis == 0), j - (axis == 1), k - (axis == 2)
    i1, j1, k1 = i + (other == 0), j + (other == 1), k + (other == 2)
    i0, j0, k0 = max(i0, 0), max(j0, 0), max(k0, 0)
    i1, j1, k1 = min(i1, shape[0] - 1), min(j1, shape[1] - 1), min(k1, shape[2] - 1)
    i, j, k = min(i, shape[0] - 1), min(j, shape[1] - 1), min(k, shape[2] - 1)
    # the two faces on the near and on the far side of `other`, each beside the face and before it
    low = field[i * plane + j * row + k]
    high = field[i1 * plane + j1 * row + k1]
    if axis == 0:
        low += field[i0 * plane + j * row + k]
        high += field[i0 * plane + j1 * row + k1]
    elif axis == 1:
        low += field[i * plane + j0 * row + k]
        high += field[i1 * plane + j0 * row + k1]
    else:
        low += field[i * plane + j * row + k0]
        high += field[i1 * plane + j1 * row + k0]
    return np.float32(0.25) * (low + high)


@njit(cache=True)
def _split(way, place, last):
    """Whole cells and fraction of a displacement from a place, clamped to 0 to `last`; the cell and the next one, or
    twice the same where there is but one, are there."""
    clamped = min(max(way, np.float32(-place)), np.float32(last - place))
    whole = min(np.int64(np.floor(clamped)), max(last - 1, 0) - place)
    return place + whole, clamped - np.float32(whole)


@njit(cache=True)
def _corners(q, row, plane, step, a, b, c):
    """The eight values from a cell on; `step`: to the next one along each axis, 0 where there is none."""
    at = a * plane + b * row + c
    x, y, z = step
    return (q[at], q[at + z], q[at + y], q[at + y + z], q[at + x], q[at + x + z], q[at + x + y], q[at + x + y + z])


@njit(cache=True)
def _blended(corners, fx, fy, fz):
    """Trilinear."""
    q0, q1, q2, q3, q4, q5, q6, q7 = corners
    q0, q2, q4, q6 = q0 + fz * (q1 - q0), q2 + fz * (q3 - q2), q4 + fz * (q5 - q4), q6 + fz * (q7 - q6)
    q0, q4 = q0 + fy * (q2 - q0), q4 + fy * (q6 - q4)
    return q0 + fx * (q4 - q0)


@njit(cache=True)
def _steps(shape):
    row, plane = shape[2], shape[1] * shape[2]
    return plane * (shape[0] > 1), row * (shape[1] > 1), np.int64(shape[2] > 1)


@shared(lambda q, *_: (0, q.shape[0]))
def _trace_back(begin, end, q, u, v, w, axis, cells, moves, out, low, high):
    """out = q where the flow came from, `cells` = dt / h; low and high are the range of the eight values used, `moves`
    how far the flow goes, in cells."""
    nx, ny, nz = q.shape
    row, plane, step = nz, ny * nz, _steps(q.shape)
    flat, flat_u, flat_v, flat_w = q.reshape(-1), u.reshape(-1), v.reshape(-1), w.reshape(-1)
    factor = np.float32(cells)
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                own = q[i, j, k]
                x = factor * (own if axis == 0 else _four(flat_u, u.shape, axis, 0, i, j, k))
                y = factor * (own if axis == 1 else _four(flat_v, v.shape, axis, 1, i, j, k))
                z = factor * (own if axis == 2 else _four(flat_w, w.shape, axis, 2, i, j, k))
                moves[i, j, k, 0], moves[i, j, k, 1], moves[i, j, k, 2] = x, y, z
                a, fx = _split(-x, i, nx - 1)
                b, fy = _split(-y, j, ny - 1)
                c, fz = _split(-z, k, nz - 1)
                corners = _corners(flat, row, plane, step, a, b, c)
                q0, q1, q2, q3, q4, q5, q6, q7 = corners
                out[i, j, k] = _blended(corners, fx, fy, fz)
                low[i, j, k] = min(min(min(q0, q1), min(q2, q3)), min(min(q4, q5), min(q6, q7)))
                high[i, j, k] = max(max(max(q0, q1), max(q2, q3)), max(max(q4, q5), max(q6, q7)))


@shared(lambda q, *_: (0, q.shape[0]))
def _corrected(begin, end, q, once, moves, low, high, out):
    """out = once + (q - once traced forth) / 2, between low and high."""
    nx, ny, nz = q.shape
    row, plane, step, flat = nz, ny * nz, _steps(q.shape), once.reshape(-1)
    half = np.float32(0.5)
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                a, fx = _split(moves[i, j, k, 0], i, nx - 1)
                b, fy = _split(moves[i, j, k, 1], j, ny - 1)
                c, fz = _split(moves[i, j, k, 2], k, nz - 1)
                again = _blended(_corners(flat, row, plane, step, a, b, c), fx, fy, fz)
                value = once[i, j, k] + half * (q[i, j, k] - again)
                out[i, j, k] = min(max(value, low[i, j, k]), high[i, j, k])


def advect_maccormack(velocity: FaceVelocity, grid: Grid, dt: float) -> FaceVelocity:
    """MacCormack advection of the velocity by itself for dt (s): back-trace, estimate of its error by tracing
    forth, correction, limited to the range of the values that the back-trace interpolates."""
    u, v, w = (np.ascontiguousarray(c, np.float32) for c in velocity.components)
    cells = dt / grid.spacing
    out = []
    for axis, q in enumerate((u, v, w)):
        once, low, high, result = (np.empty_like(q) for _ in range(4))
        moves = np.empty((*q.shape, 3), np.float32)
        _trace_back(q, u, v, w, axis, cells, moves, once, low, high)
        _corrected(q, once, moves, low, high, result)
        out.append(result)
    return FaceVelocity(*out)
