"""Sub-steps of the recurrent stencil over a padded box, compiled (plain twin: `recurrent_stencil.recurrent_layers`).

Scaled unknowns x with (S A S) x = b: `diagonal` of S A S, `couplings` [3,a,b,c] minus its entries towards the next
cell along x, y, z. All are zero in the outermost layer of the box and off the unknown cells. One thread each, without
Python's lock: windows of a fit run side by side.
"""

from __future__ import annotations

import numpy as np
from numba import njit

FAST = {"contract", "nsz", "reassoc"}
"""sums may be reordered for vector registers; not-a-number stays what it is"""


@njit(nogil=True, fastmath=FAST, inline="always")
def _residual_row(n, b, d, x, out, c_right, right, c_left, left, c_front, front, c_back, back, c_up):
    """out = b - S A S x along cells 1 to n - 1 of a row. Few arrays per loop, else the compiler gives up on vectors."""
    for k in range(1, n):
        out[k] = b[k] - d[k] * x[k]
    for k in range(1, n):
        out[k] += c_right[k] * right[k] + c_left[k] * left[k]
    for k in range(1, n):
        out[k] += c_front[k] * front[k] + c_back[k] * back[k]
    for k in range(1, n):
        out[k] += c_up[k] * x[k + 1] + c_up[k - 1] * x[k - 1]


@njit(cache=True, nogil=True, fastmath=FAST)
def diagonal_sub_steps(b, diagonal, couplings, relaxation, momentum):
    """x after the sub-steps from zero, K = 1."""
    nx, ny, nz = b.shape
    x, other, p = np.zeros_like(b), np.zeros_like(b), np.zeros_like(b)
    row = np.zeros(nz, b.dtype)
    cx, cy, cz = couplings[0], couplings[1], couplings[2]
    n = nz - 1
    for step in range(len(relaxation)):
        w, m = relaxation[step], momentum[step]
        for i in range(1, nx - 1):
            for j in range(1, ny - 1):
                _residual_row(
                    n, b[i, j], diagonal[i, j], x[i, j], row, cx[i, j], x[i + 1, j], cx[i - 1, j], x[i - 1, j],
                    cy[i, j], x[i, j + 1], cy[i, j - 1], x[i, j - 1], cz[i, j],
                )  # fmt: skip
                change = p[i, j]
                before = x[i, j]
                after = other[i, j]
                for k in range(1, n):
                    change[k] = m * change[k] + w * row[k]
                for k in range(1, n):
                    after[k] = before[k] + change[k]
        x, other = other, x
    return x


@njit(cache=True, nogil=True, fastmath=FAST)
def convolved_sub_steps(b, diagonal, couplings, inside, weights, relaxation, momentum):
    """x after the sub-steps from zero; `weights` [7] of K across faces x, y, z, edges xy, xz, yz and corners; `inside`
    is 1 at unknown cells, else 0."""
    nx, ny, nz = b.shape
    cx, cy, cz = couplings[0], couplings[1], couplings[2]
    x, p, r = np.zeros_like(b), np.zeros_like(b), np.zeros_like(b)
    kx, ky, kz, kxy, kxz, kyz, kxyz = weights
    n = nz - 1
    for step in range(len(relaxation)):
        w, m = relaxation[step], momentum[step]
        for i in range(1, nx - 1):
            for j in range(1, ny - 1):
                _residual_row(
                    n, b[i, j], diagonal[i, j], x[i, j], r[i, j], cx[i, j], x[i + 1, j], cx[i - 1, j], x[i - 1, j],
                    cy[i, j], x[i, j + 1], cy[i, j - 1], x[i, j - 1], cz[i, j],
                )  # fmt: skip
        for i in range(1, nx - 1):
            for j in range(1, ny - 1):
                for k in range(1, n):
                    total = r[i, j, k] + kz * (r[i, j, k - 1] + r[i, j, k + 1])
                    total += kx * (r[i - 1, j, k] + r[i + 1, j, k]) + ky * (r[i, j - 1, k] + r[i, j + 1, k])
                    total += kxy * (r[i - 1, j - 1, k] + r[i - 1, j + 1, k] + r[i + 1, j - 1, k] + r[i + 1, j + 1, k])
                    for d in (-1, 1):
                        total += kxz * (r[i - 1, j, k + d] + r[i + 1, j, k + d])
                        total += kyz * (r[i, j - 1, k + d] + r[i, j + 1, k + d])
                        low = r[i - 1, j - 1, k + d] + r[i - 1, j + 1, k + d]
                        total += kxyz * (low + r[i + 1, j - 1, k + d] + r[i + 1, j + 1, k + d])
                    p[i, j, k] = m * p[i, j, k] + w * inside[i, j, k] * total
                    x[i, j, k] += p[i, j, k]
    return x


@njit(cache=True, nogil=True)
def residual_squares(b, scale, weights, q):
    """Sums of b^2 and of (b - A q)^2 over the cells with scale > 0, in double precision."""
    nx, ny, nz = b.shape
    total, left = 0.0, 0.0
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                if scale[i, j, k] > 0:
                    r = b[i, j, k] - q[i, j, k] / scale[i, j, k] ** 2
                    r += weights[0, i, j, k] * q[i + 1, j, k] + weights[0, i - 1, j, k] * q[i - 1, j, k]
                    r += weights[1, i, j, k] * q[i, j + 1, k] + weights[1, i, j - 1, k] * q[i, j - 1, k]
                    r += weights[2, i, j, k] * q[i, j, k + 1] + weights[2, i, j, k - 1] * q[i, j, k - 1]
                    total += b[i, j, k] ** 2
                    left += r**2
    return total, left
