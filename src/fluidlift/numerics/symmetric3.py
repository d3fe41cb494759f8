"""Axes of many symmetric 3x3 matrices at a time, for Numba kernels: cyclic Jacobi in lanes.

A rotation of Jacobi is a chain of divisions and roots, each of which waits for the one before. Side by side, as vector
instructions, matrices take a third of the time that they take one after the other, to the same bits.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fluidlift.numerics.sharing import apart

LANES = 16
"""matrices side by side: fewer leave units idle, more wait for the one that takes most sweeps"""
SWEEPS = 12
"""at most; four usually do"""
DIAGONAL = 1e-18
"""squares off the diagonal over those on it: angles to 1e-9, for results that are kept in single precision"""


@apart
def _rotate(going, pp, pq, pr, qp, qq, qr, rp, rq, xp, xq, yp, yq, zp, zq):
    """The rotation in the plane (p, q) after which nothing is left at (p, q), where `going`.

    All are arrays [LANES]: entries of the matrices by row and column, r the third axis; rows x, y, z of the vectors.
    """
    for n in range(LANES):
        off = pq[n]
        theta = (qq[n] - pp[n]) / (2.0 * off)
        t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
        t = -t if theta < 0 else t
        c = 1.0 / np.sqrt(t * t + 1.0)
        s = t * c
        if going[n] and off != 0.0:
            # columns, then rows
            pp[n], pq[n] = c * pp[n] - s * pq[n], s * pp[n] + c * pq[n]
            qp[n], qq[n] = c * qp[n] - s * qq[n], s * qp[n] + c * qq[n]
            rp[n], rq[n] = c * rp[n] - s * rq[n], s * rp[n] + c * rq[n]
            pp[n], qp[n] = c * pp[n] - s * qp[n], s * pp[n] + c * qp[n]
            pq[n], qq[n] = c * pq[n] - s * qq[n], s * pq[n] + c * qq[n]
            pr[n], qr[n] = c * pr[n] - s * qr[n], s * pr[n] + c * qr[n]
            xp[n], xq[n] = c * xp[n] - s * xq[n], s * xp[n] + c * xq[n]
            yp[n], yq[n] = c * yp[n] - s * yq[n], s * yp[n] + c * yq[n]
            zp[n], zq[n] = c * zp[n] - s * zq[n], s * zp[n] + c * zq[n]


@njit(cache=True)
def matrices():
    """Room for the entries of a matrix in each lane: nine arrays [LANES], row by row."""
    return (
        np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES),
        np.empty(LANES), np.empty(LANES), np.empty(LANES),
    )  # fmt: skip


@njit(cache=True)
def axes_of(a, v, going):
    """The symmetric matrices `a` become diagonal, the columns of `v` their eigenvectors (proper rotations).

    Args:
        a, v: see `matrices`.
        going: bool [LANES], for working in.
    """
    a00, a01, a02, a10, a11, a12, a20, a21, a22 = a
    v00, v01, v02, v10, v11, v12, v20, v21, v22 = v
    for n in range(LANES):
        v00[n] = v11[n] = v22[n] = 1.0
        v01[n] = v02[n] = v10[n] = v12[n] = v20[n] = v21[n] = 0.0
    for _ in range(SWEEPS):
        left = 0
        for n in range(LANES):
            off = a01[n] * a01[n] + a02[n] * a02[n] + a12[n] * a12[n]
            trace = a00[n] * a00[n] + a11[n] * a11[n] + a22[n] * a22[n]
            going[n] = not off <= DIAGONAL * trace
            left += going[n]
        if left == 0:
            break
        _rotate(going, a00, a01, a02, a10, a11, a12, a20, a21, v00, v01, v10, v11, v20, v21)
        _rotate(going, a00, a02, a01, a20, a22, a21, a10, a12, v00, v02, v10, v12, v20, v22)
        _rotate(going, a11, a12, a10, a21, a22, a20, a01, a02, v01, v02, v11, v12, v21, v22)
