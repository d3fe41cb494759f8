"""Backward Euler diffusion of a face component: (D - a N) x = b with D = 1 + a couplings + e drag, in Numba.

N sums over those of the six neighbours that are unknowns too. Jacobi steps D^-1 (b + a N x) have a spectrum within
[-rho, rho] around the solution, rho = the largest a couplings / D, so Chebyshev semi-iteration (Golub and Varga 1961)
needs no sums, and its sweeps can follow each other through the planes of the grid, one plane apart: what a sweep reads
is in cache from the one before. How many sweeps are needed follows from rho and the first residual.

Inside, the bounding box [a,b,c] of the unknowns lies in a padded array [a+2, b+1, c+1] (a plane before and behind, an
entry after each row and a row after each plane), zero wherever there is no unknown: neighbours are read without asking
whether they exist, and a sweep passes over whole planes, in vector registers.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fluidlift.physics.rollout_kernels import FAST, U

SWEEPS_PER_WAVE = 8
"""sweeps that follow each other through the planes while these are in cache"""
MOST_SWEEPS = 2000
"""enough for a = 6000 in single and 900 in double precision; beyond, the bound on the residual that `diffuse` returns
exceeds the tolerance"""


@njit(cache=True, nogil=True)
def _box_of(runs):
    """First i, j, k of the runs, planes of their bounding box, padded lengths of its rows and planes."""
    i0, j0, k0 = np.int64(runs[0, 0]), np.int64(runs[0, 1]), np.int64(runs[0, 2])
    j1, k1 = j0, k0
    for r in range(len(runs)):
        j0, j1 = min(j0, np.int64(runs[r, 1])), max(j1, np.int64(runs[r, 1]))
        k0, k1 = min(k0, np.int64(runs[r, 2])), max(k1, np.int64(runs[r, 2] + runs[r, 3]))
    row = k1 - k0 + 1
    return i0, j0, k0, np.int64(runs[len(runs) - 1, 0]) - i0 + 1, row, (j1 - j0 + 2) * row


@njit(cache=True, nogil=True, forceinline=True)
def _places(r, component, runs, box):
    """Where run r begins in the flat vector and in the padded arrays."""
    start, shape = component
    i, j, k = np.int64(runs[r, 0]), np.int64(runs[r, 1]), np.int64(runs[r, 2])
    inside = (i - box[0] + 1) * box[5] + (j - box[1]) * box[4] + k - box[2]
    return U(start + (i * shape[1] + j) * shape[2] + k), U(inside)


@njit(cache=True, nogil=True, fastmath=FAST)
def _load(b, component, runs, box, layout, rates, wide):
    """Fills the padded arrays; returns the bound of the spectrum and the sums of squares of b, both weighted.

    wide = (x, other, scaled, weight): x = b, scaled = b / D, weight = a / D with D = 1 + a couplings + e drag.
    """
    couplings, drag = layout
    a, e = rates
    x, _other, scaled, weight = wide
    one = x.dtype.type(1)
    largest, total = 0.0, 0.0
    for r in range(len(runs)):
        f, o = _places(r, component, runs, box)
        most, part = x.dtype.type(0), x.dtype.type(0)
        for t in range(U(runs[r, 3])):
            coupled = a * couplings[f + t]
            inverse = one / (one + coupled + e * drag[f + t])
            x[o + t] = b[f + t]
            scaled[o + t] = inverse * b[f + t]
            weight[o + t] = a * inverse
            most = max(most, coupled * inverse)
            part += inverse * b[f + t] * b[f + t]
        largest, total = max(largest, np.float64(most)), total + part
    return largest, total


@njit(cache=True, nogil=True, fastmath=FAST)
def _first_residual(component, runs, box, wide):
    """Sum of the squared residual of x = b over a D."""
    x, _other, scaled, weight = wide
    row, plane = box[4], box[5]
    total = 0.0
    for r in range(len(runs)):
        _, o = _places(r, component, runs, box)
        part = x.dtype.type(0)
        for t in range(U(runs[r, 3])):
            c = o + t
            around = x[c - U(plane)] + x[c + U(plane)] + x[c - U(row)] + x[c + U(row)] + x[c - U(1)] + x[c + U(1)]
            change = scaled[c] + weight[c] * around - x[c]
            part += change * change / weight[c]  # the residual is D change, and D = a / weight
        total += part
    return total


@njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _sweep_plane(p, box, omega, x, target, coefficients):
    """target += omega (Jacobi step of x - target) over plane p; where there is no unknown, all stay 0."""
    scaled, weight = coefficients
    row, plane = U(box[4]), U(box[5])
    o = U(p + 1) * plane
    b, f, d, u, l, h = o - plane, o + plane, o - row, o + row, o - U(1), o + U(1)
    for t in range(plane):
        around = (x[b + t] + x[f + t]) + (x[d + t] + x[u + t]) + (x[l + t] + x[h + t])
        before = target[o + t]
        target[o + t] = before + omega * (scaled[o + t] + weight[o + t] * around - before)


@njit(cache=True, nogil=True)
def _chebyshev(box, rho, sweeps, wide):
    """Chebyshev semi-iteration on Jacobi steps; returns whether the result lies in the second array.

    Sweeps follow each other through the planes one plane apart, so that a plane is read once for many.
    """
    x, other, coefficients = wide[0], wide[1], (wide[2], wide[3])
    omega = np.ones(sweeps, x.dtype)
    value = 2.0
    for s in range(1, sweeps):
        value = 1.0 / (1.0 - 0.25 * rho * rho * value)
        omega[s] = value
    for begin in range(0, sweeps, SWEEPS_PER_WAVE):
        n = min(SWEEPS_PER_WAVE, sweeps - begin)
        for front in range(box[3] + n - 1):
            for s in range(max(front - box[3] + 1, 0), min(n, front + 1)):
                before, after = (x, other) if (begin + s) % 2 == 0 else (other, x)
                _sweep_plane(front - s, box, omega[begin + s], before, after, coefficients)
    return sweeps % 2 == 1


def padded_size(shape: tuple[int, int, int]) -> int:
    """Of the work arrays of a component."""
    return (shape[0] + 2) * (shape[1] + 1) * (shape[2] + 1) + 1


@njit(cache=True, nogil=True)
def _solve_padded(b, component, runs, box, layout, rates, tolerance, wide):
    """Whether the solution lies in the second of the padded arrays, the sweeps, and what bounds the residual."""
    for array in wide:
        array[: (box[3] + 2) * box[5] + 1] = 0
    rho, total = _load(b, component, runs, box, layout, rates, wide)
    sweeps, bound = 0, 0.0
    if rates[0] > 0 and total > 0:
        ratio = np.sqrt(_first_residual(component, runs, box, wide) * rates[0] / total)
        bound = ratio
        if ratio > tolerance:
            # T(1 / rho) of this degree is the least that the residual falls by; rho may round to 1
            per_sweep = np.arccosh(max(1.0 / rho, 1.0 + 1e-12)) if rho > 0 else np.inf
            sweeps = int(min(max(np.ceil(np.arccosh(ratio / tolerance) / per_sweep), 1.0), MOST_SWEEPS))
            bound = ratio / np.cosh(sweeps * per_sweep)
    return _chebyshev(box, rho, sweeps, wide), sweeps, bound


@njit(cache=True, nogil=True)
def diffuse(v, component, runs, layout, rates, tolerance, wide):
    """Solves (D - a N) x = v over runs in place.

    Returns the number of sweeps, and what bounds the relative residual (in the norm of D^-1, rounding aside).

    N sums over the neighbours in the runs, D = 1 + a couplings + e drag: rates = (a, e), layout = (couplings, drag).
    wide: four work arrays of `padded_size`.
    """
    if len(runs) == 0:
        return 0, 0.0
    box = _box_of(runs)
    second, sweeps, bound = _solve_padded(v, component, runs, box, layout, rates, tolerance, wide)
    if sweeps > 0:
        _store(v, component, runs, box, wide[1] if second else wide[0])
    return sweeps, bound


@njit(cache=True, nogil=True)
def _store(v, component, runs, box, x):
    for r in range(len(runs)):
        f, o = _places(r, component, runs, box)
        for t in range(U(runs[r, 3])):
            v[f + t] = x[o + t]


@njit(cache=True, nogil=True, fastmath=FAST)
def diffuse_adjoint(g, x, component, runs, layout, rates, tolerance, wide):
    """g becomes l of (D - a N) l = g; returns l . (N - couplings) x and -l . drag x, for the gradients of a and e."""
    if len(runs) == 0:
        return 0.0, 0.0
    couplings, drag = layout
    box = _box_of(runs)
    second, sweeps, _ = _solve_padded(g, component, runs, box, layout, rates, tolerance, wide)
    if sweeps > 0:
        _store(g, component, runs, box, wide[1] if second else wide[0])
    free, row, plane = wide[0] if second else wide[1], box[4], box[5]
    for r in range(len(runs)):
        f, o = _places(r, component, runs, box)
        for t in range(U(runs[r, 3])):
            free[o + t] = x[f + t]
    to_a, to_e = 0.0, 0.0
    for r in range(len(runs)):
        f, o = _places(r, component, runs, box)
        part_a, part_e = x.dtype.type(0), x.dtype.type(0)
        for t in range(U(runs[r, 3])):
            c = o + t
            around = (free[c - U(plane)] + free[c + U(plane)]) + (free[c - U(row)] + free[c + U(row)])
            around += free[c - U(1)] + free[c + U(1)]
            part_a += g[f + t] * (around - couplings[f + t] * x[f + t])
            part_e -= g[f + t] * drag[f + t] * x[f + t]
        to_a, to_e = to_a + part_a, to_e + part_e
    return to_a, to_e


@njit(cache=True, nogil=True)
def add_boundary(b, v, rows, cols, rate):
    """b[rows] += rate v[cols]."""
    for n in range(len(rows)):
        b[rows[n]] += rate * v[cols[n]]


@njit(cache=True, nogil=True)
def dot_boundary(g, x, rows, cols):
    """Sum of g[rows] x[cols]."""
    total = 0.0
    for n in range(len(rows)):
        total += np.float64(g[rows[n]]) * x[cols[n]]
    return total
