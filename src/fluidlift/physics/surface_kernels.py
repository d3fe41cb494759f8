"""The kernels behind `physics.free_surface`, in cells; their plain twins are there."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fluidlift.numerics.bspline import quadratic_weights
from fluidlift.numerics.sharing import shared
from fluidlift.numerics.signed_distance import distance_and_gradient
from fluidlift.physics.liquid_fractions import cut_share

SLAB = 4
"""cells along x that one thread scatters from; slabs of two colours, so no two threads ever touch one cell at once"""
VARIANCE = 0.75
"""cells^2, of the blur that makes the fill: 1/4 of the quadratic spline and 1/2 of the binomial filter"""
DEPTH = 2.0
"""cells: beyond it the fill says nothing about the distance of the surface"""
LEAST_FILL = 0.5 * math.erfc(DEPTH / math.sqrt(2.0 * VARIANCE))
LARGEST_CURVATURE = 1.0
"""1 / cells: a drop of four cells across, the smallest that the fill shows well"""
RELAXATION = 1.5
"""of the virtual liquid: its fixed point is approached from one side, and slowly"""
SOLID_DEPTH = 0.7
"""cells: from the centre of an almost open cell to the middle of its solid part"""


@shared(lambda nodes, low, h, out: (0, out.shape[0]))
def open_volumes(begin, end, nodes, low, h, out):
    """Open share of each cell, from its octants, each cut by the plane that fits the signed distance at its centre."""
    _, ny, nz = out.shape
    inverse = 1.0 / h
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                x, y, z = low[0] + (i + 0.5) * h, low[1] + (j + 0.5) * h, low[2] + (k + 0.5) * h
                value, gx, gy, gz = distance_and_gradient(nodes, low, inverse, x, y, z)
                if abs(value) > 1.5 * h:
                    out[i, j, k] = 1.0 if value > 0.0 else 0.0
                    continue
                total = 0.0
                for a in range(2):
                    for b in range(2):
                        for c in range(2):
                            value, gx, gy, gz = distance_and_gradient(
                                nodes, low, inverse, x + (0.5 * a - 0.25) * h, y + (0.5 * b - 0.25) * h,
                                z + (0.5 * c - 0.25) * h,
                            )  # fmt: skip
                            total += 1.0 - cut_share(value, 0.5 * h * gx, 0.5 * h * gy, 0.5 * h * gz)
                out[i, j, k] = 0.125 * total


@shared(lambda field, *_: (0, field.shape[0]))
def three_point(begin, end, field, side, out):
    """Weights side, 1 - 2 side, side along each axis; the outermost cells are repeated (a mirror)."""
    nx, ny, nz = field.shape
    middle = np.float32(1.0 - 2.0 * side)
    outer = np.float32(side)
    for i in range(begin, end):
        a, b = max(i - 1, 0), min(i + 1, nx - 1)
        plane = np.empty((ny, nz), np.float32)
        for j in range(ny):
            for k in range(nz):
                plane[j, k] = outer * (field[a, j, k] + field[b, j, k]) + middle * field[i, j, k]
        for j in range(ny):
            c, d = max(j - 1, 0), min(j + 1, ny - 1)
            before = outer * (plane[c, 0] + plane[d, 0]) + middle * plane[j, 0]
            here = before
            for k in range(nz):
                e = min(k + 1, nz - 1)
                after = outer * (plane[c, e] + plane[d, e]) + middle * plane[j, e]
                out[i, j, k] = outer * (before + after) + middle * here
                before, here = here, after


def deposit(positions, amounts, order, slab_start, low, h, out):
    """Amounts shared among 27 cells by quadratic splines; beyond the sides of the box they are mirrored."""
    for color in range(2):  # of slabs; those of one colour share no cell
        _deposit(positions, amounts, order, slab_start, color, low, h, out)


@shared(lambda positions, amounts, order, slab_start, color, *_: (0, (len(slab_start) - color) // 2))
def _deposit(begin, end, positions, amounts, order, slab_start, color, low, h, out):
    nx, ny, nz = out.shape
    inverse = np.float32(1.0 / h)
    half = np.float32(0.5)
    x0, y0, z0 = np.float32(low[0]), np.float32(low[1]), np.float32(low[2])
    for m in range(begin, end):
        s = 2 * m + color
        for n in range(slab_start[s], slab_start[s + 1]):
            p = order[n]
            i, wx0, wx1, wx2 = quadratic_weights((positions[p, 0] - x0) * inverse - half)
            j, wy0, wy1, wy2 = quadratic_weights((positions[p, 1] - y0) * inverse - half)
            k, wz0, wz1, wz2 = quadratic_weights((positions[p, 2] - z0) * inverse - half)
            k0, k1, k2 = min(max(k, 0), nz - 1), min(max(k + 1, 0), nz - 1), min(max(k + 2, 0), nz - 1)
            for a in range(3):
                ii = min(max(i + a, 0), nx - 1)
                wa = amounts[p] * (wx0 if a == 0 else (wx1 if a == 1 else wx2))
                for b in range(3):
                    jj = min(max(j + b, 0), ny - 1)
                    w = wa * (wy0 if b == 0 else (wy1 if b == 1 else wy2))
                    out[ii, jj, k0] += w * wz0
                    out[ii, jj, k1] += w * wz1
                    out[ii, jj, k2] += w * wz2


@njit(cache=True)
def inverse_error_function(x):
    """Giles 2012, "Approximating the erfinv function": relative error 3e-7."""
    w = -np.log((1.0 - x) * (1.0 + x))
    if w < 5.0:
        w -= 2.5
        p = 2.81022636e-08
        p = 3.43273939e-07 + p * w
        p = -3.5233877e-06 + p * w
        p = -4.39150654e-06 + p * w
        p = 0.00021858087 + p * w
        p = -0.00125372503 + p * w
        p = -0.00417768164 + p * w
        p = 0.246640727 + p * w
        return (1.50140941 + p * w) * x
    w = np.sqrt(w) - 3.0
    p = -0.000200214257
    p = 0.000100950558 + p * w
    p = 0.00134934322 + p * w
    p = -0.00367342844 + p * w
    p = 0.00573950773 + p * w
    p = -0.0076224613 + p * w
    p = 0.00943887047 + p * w
    p = 1.00167406 + p * w
    return (2.83297682 + p * w) * x


@njit(cache=True)
def flat_distance(fill):
    """Distance of the surface, were it flat; within `DEPTH`."""
    if fill <= LEAST_FILL:
        return DEPTH
    if fill >= 1.0 - LEAST_FILL:
        return -DEPTH
    return -np.sqrt(2.0 * VARIANCE) * inverse_error_function(2.0 * fill - 1.0)


@njit(cache=True)
def _slopes(field, i, j, k):
    """Central differences, mirrored at the border."""
    nx, ny, nz = field.shape
    x = 0.5 * (field[min(i + 1, nx - 1), j, k] - field[max(i - 1, 0), j, k])
    y = 0.5 * (field[i, min(j + 1, ny - 1), k] - field[i, max(j - 1, 0), k])
    z = 0.5 * (field[i, j, min(k + 1, nz - 1)] - field[i, j, max(k - 1, 0)])
    return x, y, z


@njit(cache=True)
def _outward(fill, i, j, k):
    """Normal out of the liquid, of length 1; shorter where the fill hardly changes."""
    x, y, z = _slopes(fill, i, j, k)
    scale = -1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-3)
    return scale * x, scale * y, scale * z


@shared(lambda layer, want, open_share, fill, *_: (0, fill.shape[0]))
def continue_into_solid(begin, end, layer, want, open_share, fill, distance, normal):
    """Distance and normal in the cells of one layer, by linear extrapolation from the layers before it."""
    nx, ny, nz = fill.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                if layer[i, j, k] != want:
                    continue
                if want == 1:
                    distance[i, j, k] = flat_distance(fill[i, j, k])
                    x, y, z = _outward(fill, i, j, k)
                    normal[i, j, k, 0], normal[i, j, k, 1], normal[i, j, k, 2] = x, y, z
                    continue
                total, weights, sx, sy, sz = 0.0, 0.0, 0.0, 0.0, 0.0
                for a in range(max(i - 1, 0), min(i + 2, nx)):
                    for b in range(max(j - 1, 0), min(j + 2, ny)):
                        for c in range(max(k - 1, 0), min(k + 2, nz)):
                            if layer[a, b, c] >= want:
                                continue
                            if layer[a, b, c] == 0:
                                d = flat_distance(fill[a, b, c])
                                x, y, z = _outward(fill, a, b, c)
                            else:
                                d = np.float64(distance[a, b, c])
                                x, y, z = normal[a, b, c, 0], normal[a, b, c, 1], normal[a, b, c, 2]
                            weight = open_share[a, b, c] ** 2 if want == 2 else 1.0
                            weight /= 1.0 + (a - i) ** 2 + (b - j) ** 2 + (c - k) ** 2
                            total += weight * (d + x * (i - a) + y * (j - b) + z * (k - c))
                            sx += weight * x
                            sy += weight * y
                            sz += weight * z
                            weights += weight
                if weights > 0.0:
                    distance[i, j, k] = total / weights
                    normal[i, j, k, 0] = sx / weights
                    normal[i, j, k, 1] = sy / weights
                    normal[i, j, k, 2] = sz / weights


@shared(lambda layer, deepest, open_share, distance, normal, virtual: (0, virtual.shape[0]))
def fill_solid(begin, end, layer, deepest, open_share, distance, normal, virtual):
    """Virtual liquid: the share of each cell's solid part that lies below the continued surface."""
    _, ny, nz = virtual.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                if layer[i, j, k] == 0 or layer[i, j, k] > deepest:
                    continue
                # the more of the cell is open, the farther from its centre is the middle of its solid part
                x, y, z = _slopes(open_share, i, j, k)
                reach = SOLID_DEPTH * open_share[i, j, k] / max(np.sqrt(x * x + y * y + z * z), 1e-3)
                d = distance[i, j, k] - reach * (
                    normal[i, j, k, 0] * x + normal[i, j, k, 1] * y + normal[i, j, k, 2] * z
                )
                share = 0.5 * math.erfc(d / math.sqrt(0.5))  # blurred by the spline
                old = virtual[i, j, k]
                virtual[i, j, k] = min(max(old + RELAXATION * (share - old), 0.0), 1.0)


@njit(cache=True)
def _curvature_at(f, i, j, k):
    """div(n) with n = -grad f / |grad f|, central differences."""
    nx, ny, nz = f.shape
    a, b = max(i - 1, 0), min(i + 1, nx - 1)
    c, d = max(j - 1, 0), min(j + 1, ny - 1)
    e, g = max(k - 1, 0), min(k + 1, nz - 1)
    x, y, z = _slopes(f, i, j, k)
    squared = x * x + y * y + z * z
    if squared < 1e-6:
        return 0.0
    xx = f[b, j, k] - 2.0 * f[i, j, k] + f[a, j, k]
    yy = f[i, d, k] - 2.0 * f[i, j, k] + f[i, c, k]
    zz = f[i, j, g] - 2.0 * f[i, j, k] + f[i, j, e]
    xy = 0.25 * (f[b, d, k] - f[b, c, k] - f[a, d, k] + f[a, c, k])
    xz = 0.25 * (f[b, j, g] - f[b, j, e] - f[a, j, g] + f[a, j, e])
    yz = 0.25 * (f[i, d, g] - f[i, d, e] - f[i, c, g] + f[i, c, e])
    total = (yy + zz) * x * x + (xx + zz) * y * y + (xx + yy) * z * z
    total -= 2.0 * (x * y * xy + x * z * xz + y * z * yz)
    return -total / squared**1.5


@shared(lambda smooth, fill, *_: (0, fill.shape[0]))
def curvature(begin, end, smooth, fill, out):
    """Of the surfaces of equal `smooth`, within `DEPTH` of the surface of `fill`; else 0."""
    _, ny, nz = fill.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                out[i, j, k] = 0.0
                if LEAST_FILL < fill[i, j, k] < 1.0 - LEAST_FILL:
                    bend = _curvature_at(smooth, i, j, k)
                    out[i, j, k] = min(max(bend, -LARGEST_CURVATURE), LARGEST_CURVATURE)


@shared(lambda fill, *_: (0, fill.shape[0]))
def distance(begin, end, fill, bend, band, out):
    """Distance with the shift by the blur taken back, at most `band`."""
    _, ny, nz = fill.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                d = flat_distance(fill[i, j, k]) - 0.5 * VARIANCE * bend[i, j, k]
                out[i, j, k] = min(max(d, -band), band)


@njit(cache=True)
def _change_beside(new, old, sure, i, j, k):
    """Mean of new - old over the sure neighbours, 0 without one."""
    nx, ny, nz = new.shape
    total, count = np.float32(0.0), 0
    for axis in range(3):
        for side in (-1, 1):
            a = i + side if axis == 0 else i
            b = j + side if axis == 1 else j
            c = k + side if axis == 2 else k
            if 0 <= a < nx and 0 <= b < ny and 0 <= c < nz and sure[a, b, c]:
                total += new[a, b, c] - old[a, b, c]
                count += 1
    return total / np.float32(max(count, 1))


@shared(lambda new, *_: (0, new.shape[0]))
def carry(begin, end, new, old, mass, wet, beside_skin, opening, valid, out, known):
    """One component of the velocity on wet faces and on faces of the skin: see `free_surface.continue_velocity`."""
    _, ny, nz = new.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                out[i, j, k] = new[i, j, k]
                known[i, j, k] = wet[i, j, k]
                if beside_skin[i, j, k] and not wet[i, j, k] and opening[i, j, k] > 0 and mass[i, j, k] > 0:
                    out[i, j, k] = old[i, j, k] + _change_beside(new, old, valid, i, j, k)
                    known[i, j, k] = True
