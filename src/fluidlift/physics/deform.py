"""Deformation of particles and of the Gaussians they carry (paper: F <- (I + dt C) F, A = F A0 F^T)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numba import njit

from fluidlift.errors import require
from fluidlift.numerics.sharing import X, Y, Z, shared
from fluidlift.numerics.symmetric3 import LANES, axes_of, matrices
from fluidlift.types import Gaussians, Particles

CHUNK = 2048
"""particles that a thread takes at a time"""


@njit(cache=True)
def _eigen(a, v):
    """Cyclic Jacobi: the symmetric 3x3 `a` becomes diagonal, the columns of `v` its eigenvectors (proper rotation)."""
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):
        off = a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2]
        trace = a[0, 0] * a[0, 0] + a[1, 1] * a[1, 1] + a[2, 2] * a[2, 2]
        if off <= 1e-18 * trace:  # angles to 1e-9: the results are kept in single precision
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    x, y = a[k, p], a[k, q]
                    a[k, p] = c * x - s * y
                    a[k, q] = s * x + c * y
                for k in range(3):
                    x, y = a[p, k], a[q, k]
                    a[p, k] = c * x - s * y
                    a[q, k] = s * x + c * y
                for k in range(3):
                    x, y = v[k, p], v[k, q]
                    v[k, p] = c * x - s * y
                    v[k, q] = s * x + c * y


@njit(cache=True)
def _positive(a, sign, shift):
    """Whether sign a + shift (unit matrix) is positive definite: its leading minors are positive (Sylvester)."""
    xx, yy, zz = sign * a[0, 0] + shift, sign * a[1, 1] + shift, sign * a[2, 2] + shift
    xy, xz, yz = sign * a[0, 1], sign * a[0, 2], sign * a[1, 2]
    plane = xx * yy - xy * xy
    return xx > 0.0 and plane > 0.0 and zz * plane - xx * yz * yz - yy * xz * xz + 2.0 * xy * xz * yz > 0.0


@njit(cache=True)
def _limit_stretches(f, max_stretch, a, v, g):
    """Bring the singular values of `f` into [1/max_stretch, max_stretch], in place; a, v, g are work space."""
    for i in range(3):
        for j in range(3):
            a[i, j] = f[i, 0] * f[j, 0] + f[i, 1] * f[j, 1] + f[i, 2] * f[j, 2]
    least, most = 1.0 / (max_stretch * max_stretch), max_stretch * max_stretch
    if _positive(a, 1.0, -least) and _positive(a, -1.0, most):
        return  # nothing to limit, and no eigenvectors needed to see it
    _eigen(a, v)
    for e in range(3):
        stretch = np.sqrt(max(a[e, e], 1e-12))
        factor = min(max(stretch, 1.0 / max_stretch), max_stretch) / stretch
        for j in range(3):
            g[e, j] = factor * (v[0, e] * f[0, j] + v[1, e] * f[1, j] + v[2, e] * f[2, j])
    for i in range(3):
        for j in range(3):
            f[i, j] = v[i, 0] * g[0, j] + v[i, 1] * g[1, j] + v[i, 2] * g[2, j]


@njit(cache=True)
def _inverse_cube_root(x):
    """x^(-1/3); near 1, where determinants are, by two Newton steps from the Taylor series."""
    d = x - 1.0
    if abs(d) > 0.125:
        return x ** (-1.0 / 3.0)
    # the series is off by at most 14/81 (1/8)^3 = 3e-4, each step squares that and doubles it
    root = 1.0 + d * (-1.0 / 3.0 + d * (2.0 / 9.0))
    root *= 4.0 / 3.0 - 1.0 / 3.0 * x * root * root * root
    return root * (4.0 / 3.0 - 1.0 / 3.0 * x * root * root * root)


@njit(cache=True)
def _advanced_row(f, c, p, i, dt):
    """Row i of (I + dt C) F of particle p."""
    x, y, z = dt * c[p, i, 0], dt * c[p, i, 1], dt * c[p, i, 2]
    return (
        f[p, i, 0] + x * f[p, 0, 0] + y * f[p, 1, 0] + z * f[p, 2, 0],
        f[p, i, 1] + x * f[p, 0, 1] + y * f[p, 1, 1] + z * f[p, 2, 1],
        f[p, i, 2] + x * f[p, 0, 2] + y * f[p, 1, 2] + z * f[p, 2, 2],
    )


@shared(lambda deformation, *_: (0, ((len(deformation)) + CHUNK - 1) // CHUNK))
def _update(begin, end, deformation, affine, dt, max_stretch, out):
    n = len(deformation)
    for chunk in range(begin, end):
        f, a, v, g = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        first = chunk * CHUNK
        for p in range(first, min(first + CHUNK, n)):
            f00, f01, f02 = _advanced_row(deformation, affine, p, X, dt)
            f10, f11, f12 = _advanced_row(deformation, affine, p, Y, dt)
            f20, f21, f22 = _advanced_row(deformation, affine, p, Z, dt)
            det = f00 * (f11 * f22 - f12 * f21) - f01 * (f10 * f22 - f12 * f20) + f02 * (f10 * f21 - f11 * f20)
            if not (det > 1e-6 and det < 1e6):
                for i in range(3):
                    for j in range(3):
                        out[p, i, j] = 1.0 if i == j else 0.0
                continue
            s = _inverse_cube_root(det)
            f00, f01, f02 = s * f00, s * f01, s * f02
            f10, f11, f12 = s * f10, s * f11, s * f12
            f20, f21, f22 = s * f20, s * f21, s * f22
            out[p, 0, 0], out[p, 0, 1], out[p, 0, 2] = f00, f01, f02
            out[p, 1, 0], out[p, 1, 1], out[p, 1, 2] = f10, f11, f12
            out[p, 2, 0], out[p, 2, 1], out[p, 2, 2] = f20, f21, f22
            squared = f00 * f00 + f01 * f01 + f02 * f02 + f10 * f10 + f11 * f11 + f12 * f12
            squared += f20 * f20 + f21 * f21 + f22 * f22
            # with det F = 1 and a limit s >= 2, a sum of squared stretches up to 2 s keeps all within [1/s, s]
            if squared > 2.0 * max_stretch or max_stretch < 2.0:
                f[0, 0], f[0, 1], f[0, 2] = f00, f01, f02
                f[1, 0], f[1, 1], f[1, 2] = f10, f11, f12
                f[2, 0], f[2, 1], f[2, 2] = f20, f21, f22
                _limit_stretches(f, max_stretch, a, v, g)
                for i in range(3):
                    for j in range(3):
                        out[p, i, j] = f[i, j]


def updated_deformation(
    deformation: Float[np.ndarray, "n 3 3"], affine: Float[np.ndarray, "n 3 3"], dt: float, *, max_stretch: float = 4.0
) -> Float[np.ndarray, "n 3 3"]:
    """(I + dt C) F with its determinant brought back to 1 and its stretches kept within [1/max_stretch, max_stretch].

    The flow is incompressible: a determinant other than 1 is the error of the interpolated gradient. A determinant
    beyond repair (a particle turned inside out within one step) starts again from the identity.

    Args:
        deformation: F, no unit.
        affine: C, 1/s.
        dt: s.
        max_stretch: largest singular value, above 1.
    """
    require(max_stretch > 1, f"max_stretch {max_stretch}", "above 1")
    before = np.ascontiguousarray(deformation, np.float32)
    out = np.empty_like(before)
    _update(before, np.ascontiguousarray(affine, np.float32), float(dt), float(max_stretch), out)
    return out


def updated_deformation_plain(
    deformation: Float[np.ndarray, "n 3 3"], affine: Float[np.ndarray, "n 3 3"], dt: float, *, max_stretch: float = 4.0
) -> Float[np.ndarray, "n 3 3"]:
    """`updated_deformation` with singular values, as it reads."""
    f = (np.eye(3) + dt * np.asarray(affine, np.float64)) @ np.asarray(deformation, np.float64)
    det = np.linalg.det(f)
    lost = ~((det > 1e-6) & (det < 1e6))
    f[lost], det[lost] = np.eye(3), 1.0
    u, s, vt = np.linalg.svd(f / np.cbrt(det)[:, None, None])
    return (u * np.clip(s, 1 / max_stretch, max_stretch)[:, None, :]) @ vt


@njit(cache=True)
def _axes(turn, sizes):
    """R S of a splat, row by row, from its quaternion (w, x, y, z) and its standard deviations."""
    w, x, y, z = np.float64(turn[0]), np.float64(turn[1]), np.float64(turn[2]), np.float64(turn[3])
    unit = max(w * w + x * x + y * y + z * z, 1e-24)
    k, a, b, c = 2.0 / unit, sizes[0], sizes[1], sizes[2]
    return (
        (1.0 - k * (y * y + z * z)) * a, (k * (x * y - w * z)) * b, (k * (x * z + w * y)) * c,
        (k * (x * y + w * z)) * a, (1.0 - k * (x * x + z * z)) * b, (k * (y * z - w * x)) * c,
        (k * (x * z - w * y)) * a, (k * (y * z + w * x)) * b, (1.0 - k * (x * x + y * y)) * c,
    )  # fmt: skip


@njit(cache=True)
def _moved(f, p, own):
    """F R S of particle p, row by row."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = own
    x0, x1, x2 = np.float64(f[p, 0, 0]), np.float64(f[p, 0, 1]), np.float64(f[p, 0, 2])
    y0, y1, y2 = np.float64(f[p, 1, 0]), np.float64(f[p, 1, 1]), np.float64(f[p, 1, 2])
    z0, z1, z2 = np.float64(f[p, 2, 0]), np.float64(f[p, 2, 1]), np.float64(f[p, 2, 2])
    return (
        x0 * m00 + x1 * m10 + x2 * m20, x0 * m01 + x1 * m11 + x2 * m21, x0 * m02 + x1 * m12 + x2 * m22,
        y0 * m00 + y1 * m10 + y2 * m20, y0 * m01 + y1 * m11 + y2 * m21, y0 * m02 + y1 * m12 + y2 * m22,
        z0 * m00 + z1 * m10 + z2 * m20, z0 * m01 + z1 * m11 + z2 * m21, z0 * m02 + z1 * m12 + z2 * m22,
    )  # fmt: skip


@njit(cache=True)
def _squared(m):
    """M M^T: xx, xy, xz, yy, yz, zz."""
    x0, x1, x2, y0, y1, y2, z0, z1, z2 = m
    return (
        x0 * x0 + x1 * x1 + x2 * x2, x0 * y0 + x1 * y1 + x2 * y2, x0 * z0 + x1 * z1 + x2 * z2,
        y0 * y0 + y1 * y1 + y2 * y2, y0 * z0 + y1 * z1 + y2 * z2, z0 * z0 + z1 * z1 + z2 * z2,
    )  # fmt: skip


@njit(cache=True)
def _finite(a):
    """Whether all six numbers are."""
    return (
        np.isfinite(a[0]) and np.isfinite(a[1]) and np.isfinite(a[2])
        and np.isfinite(a[3]) and np.isfinite(a[4]) and np.isfinite(a[5])
    )  # fmt: skip


@njit(cache=True)
def _quaternion(v, n):
    """w, x, y, z of the rotation in lane n; the largest of the four squared components is safe to divide by."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = v[0][n], v[1][n], v[2][n], v[3][n], v[4][n], v[5][n], v[6][n], v[7][n], v[8][n]
    d = xx + yy + zz
    if d >= xx and d >= yy and d >= zz:
        w = np.sqrt(max(1.0 + d, 0.0)) / 2.0
        return w, (zy - yz) / (4 * w), (xz - zx) / (4 * w), (yx - xy) / (4 * w)
    if xx >= yy and xx >= zz:
        x = np.sqrt(max(1.0 + xx - yy - zz, 0.0)) / 2.0
        return (zy - yz) / (4 * x), x, (yx + xy) / (4 * x), (xz + zx) / (4 * x)
    if yy >= zz:
        y = np.sqrt(max(1.0 - xx + yy - zz, 0.0)) / 2.0
        return (xz - zx) / (4 * y), (yx + xy) / (4 * y), y, (zy + yz) / (4 * y)
    z = np.sqrt(max(1.0 - xx - yy + zz, 0.0)) / 2.0
    return (yx - xy) / (4 * z), (xz + zx) / (4 * z), (zy + yz) / (4 * z), z


@shared(lambda f, *_: (0, (len(f) + LANES - 1) // LANES))
def _deform(begin, end, f, source, turns, sizes, quats, scales, max_ratio, max_size):
    """Axes and standard deviations of F A0 F^T = (F R S) (F R S)^T, `LANES` particles at a time."""
    a, v, going, finite = matrices(), matrices(), np.empty(LANES, np.bool_), np.empty(LANES, np.bool_)
    last = len(f) - 1
    for group in range(begin, end):
        first = group * LANES
        for n in range(LANES):
            p = min(first + n, last)  # lanes that are left over repeat the last one
            own = _axes(turns[source[p]], sizes[source[p]])
            square = _squared(_moved(f, p, own))
            finite[n] = _finite(square)
            if not finite[n]:
                square = _squared(own)
            a[0][n], a[4][n], a[8][n] = square[0], square[3], square[5]
            a[1][n] = a[3][n] = square[1]
            a[2][n] = a[6][n] = square[2]
            a[5][n] = a[7][n] = square[4]
        axes_of(a, v, going)
        for n in range(min(LANES, last + 1 - first)):
            p = first + n
            x, y, z = np.sqrt(max(a[0][n], 1e-18)), np.sqrt(max(a[4][n], 1e-18)), np.sqrt(max(a[8][n], 1e-18))
            x, y, z = np.float32(x), np.float32(y), np.float32(z)
            size = (1.0 * x * y * z) ** (1.0 / 3.0)
            limit, least = max_ratio * size, 1e-3 * size
            turn = (1.0, 0.0, 0.0, 0.0)
            if not finite[n] or x > limit or y > limit or z > limit:
                x = y = z = np.float32(size)
            else:
                turn = _quaternion(v, n)
            scales[p, 0], scales[p, 1], scales[p, 2] = (
                min(max(x, least), max_size), min(max(y, least), max_size), min(max(z, least), max_size),
            )  # fmt: skip
            quats[p, 0], quats[p, 1], quats[p, 2], quats[p, 3] = turn


def deformed_covariances(
    covariances: Float[np.ndarray, "n 3 3"], deformation: Float[np.ndarray, "n 3 3"], *, max_ratio: float = 12.0
) -> Float[np.ndarray, "n 3 3"]:
    """F A F^T (m^2), symmetric positive definite (plain reference of `deform_gaussians`).

    Needles, whose longest axis exceeds `max_ratio` times the mean one (cube root of the product), become spheres of
    the same volume; axes below 1/1000 of the mean one are lifted to it.
    """
    f = np.asarray(deformation, np.float64)
    a = f @ np.asarray(covariances, np.float64) @ np.swapaxes(f, 1, 2)
    bad = ~np.all(np.isfinite(a), axis=(1, 2))
    a[bad] = covariances[bad]
    values, vectors = np.linalg.eigh(0.5 * (a + np.swapaxes(a, 1, 2)))
    scales = np.sqrt(np.maximum(values, 1e-18))
    size = np.cbrt(scales.prod(axis=1, keepdims=True))
    needle = bad[:, None] | np.any(scales > max_ratio * size, axis=1)[:, None]
    scales = np.where(needle, size, np.maximum(scales, 1e-3 * size))
    return (vectors * (scales**2)[:, None, :]) @ np.swapaxes(vectors, 1, 2)


def deform_gaussians(
    rest: Gaussians, particles: Particles, *, max_stretch: float = 12.0, max_size: float = np.inf
) -> Gaussians:
    """The Gaussians that the particles carry now, one per particle.

    Centres are the particles, covariances F A0 F^T of their source, opacities and colours those of the source.
    Needles are rounded as in `deformed_covariances` with `max_ratio` = max_stretch.

    Args:
        rest: the undeformed Gaussians.
        particles: `source` indexes `rest`.
        max_stretch: longest axis over the mean one beyond which a Gaussian starts again as a sphere.
        max_size: largest standard deviation, m.

    Raises:
        ValueError: a source outside the rest Gaussians.
    """
    source = particles.source
    n = len(source)
    in_range = n == 0 or (len(rest) > 0 and int(source.min()) >= 0 and int(source.max()) < len(rest))
    require(in_range, "a particle whose source is no rest Gaussian", f"0 to {len(rest) - 1}")
    quats, scales = np.zeros((n, 4), np.float32), np.zeros((n, 3), np.float32)
    if n:
        deformation = np.ascontiguousarray(particles.deformation, np.float32)
        turns, sizes = (np.ascontiguousarray(a, np.float32) for a in (rest.quats, rest.scales))
        _deform(deformation, source, turns, sizes, quats, scales, float(max_stretch), float(max_size))
    return Gaussians(particles.positions, quats, scales, rest.opacities[source], rest.sh[source])
