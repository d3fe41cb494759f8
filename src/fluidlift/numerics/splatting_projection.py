"""The compiled loops that take Gaussians into the picture and their gradients back (Numba). Conventions: `splatting`.

The arithmetic is double precision inside, whatever the arrays hold: the determinant of a needle's covariance is a
difference of near equals, and a loop over Gaussians is not vectorised, so that doubles cost nothing here.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from fluidlift.numerics.sharing import X, Y, Z, shared

BLUR = np.float32(0.3)
"""px^2 added to the diagonal of a 2D covariance"""
ALPHA_MIN = np.float32(1.0 / 255.0)
REACH_MAX = 3.33
"""standard deviations beyond which nothing is drawn; an opacity of one reaches the cut at 3.329"""


@nb.njit(cache=True)
def _camera_point(view, means, i):
    p, q, r = nb.float64(means[i, 0]), nb.float64(means[i, 1]), nb.float64(means[i, 2])
    x = view[0] * p + view[1] * q + view[2] * r + view[9]
    y = view[3] * p + view[4] * q + view[5] * r + view[10]
    z = view[6] * p + view[7] * q + view[8] * r + view[11]
    return x, y, z


@nb.njit(cache=True)
def _unit_quat(quats, i):
    w, x, y, z = nb.float64(quats[i, 0]), nb.float64(quats[i, 1]), nb.float64(quats[i, 2]), nb.float64(quats[i, 3])
    k = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return w * k, x * k, y * k, z * k, k


@nb.njit(cache=True)
def _rotation(w, x, y, z):
    """Rows of the rotation matrix of a unit quaternion."""
    row0 = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y))
    row1 = (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x))
    row2 = (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
    return row0, row1, row2


@nb.njit(cache=True)
def _half(view, k, row0, row1, row2, scales, i):
    """Row k of the camera's half covariance m = W R diag(scale)."""
    a, b, c = view[3 * k], view[3 * k + 1], view[3 * k + 2]
    m0 = (a * row0[0] + b * row1[0] + c * row2[0]) * scales[i, 0]
    m1 = (a * row0[1] + b * row1[1] + c * row2[1]) * scales[i, 1]
    m2 = (a * row0[2] + b * row1[2] + c * row2[2]) * scales[i, 2]
    return m0, m1, m2


@nb.njit(cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@nb.njit(cache=True)
def _tangent(view, x, z, axis):
    """x/z, held within the picture and 0.3 of half its width beyond (gsplat), and whether it was held."""
    size, focal, center = view[16 + axis], view[12 + axis], view[14 + axis]
    margin = 0.15 * size / focal
    t = x / z
    low, high = -center / focal - margin, (size - center) / focal + margin
    return min(max(t, low), high), t < low or t > high


@shared(lambda view, means, *_: (0, means.shape[0]), error_model="numpy")
def project_kernel(begin, end, view, means, quats, scales, opacities, uv, conics, depths, extents):
    for i in range(begin, end):
        x, y, z = _camera_point(view, means, i)
        uv[i, 0], uv[i, 1], depths[i] = 0, 0, z
        conics[i, 0], conics[i, 1], conics[i, 2] = 1, 0, 1
        extents[i, 0], extents[i, 1] = 0, 0
        o = opacities[i]
        # comparisons with NaN are False, so that a Gaussian with any NaN stays undrawn
        if not (z > view[18] and z < 1e12 and o > ALPHA_MIN):
            continue
        fx, fy = view[12] / z, view[13] / z
        u, v = fx * x + view[14], fy * y + view[15]
        qw, qx, qy, qz, _ = _unit_quat(quats, i)
        row0, row1, row2 = _rotation(qw, qx, qy, qz)
        m0 = _half(view, X, row0, row1, row2, scales, i)
        m1 = _half(view, Y, row0, row1, row2, scales, i)
        m2 = _half(view, Z, row0, row1, row2, scales, i)
        tx, _ = _tangent(view, x, z, X)
        ty, _ = _tangent(view, y, z, Y)
        # rows of J m, with J = [fx (1, 0, -tx), fy (0, 1, -ty)]
        j0 = (fx * (m0[0] - tx * m2[0]), fx * (m0[1] - tx * m2[1]), fx * (m0[2] - tx * m2[2]))
        j1 = (fy * (m1[0] - ty * m2[0]), fy * (m1[1] - ty * m2[1]), fy * (m1[2] - ty * m2[2]))
        a, b, c = _dot(j0, j0) + BLUR, _dot(j0, j1), _dot(j1, j1) + BLUR
        det = a * c - b * b
        if not (det > 1e-12 * a * c and a + c < 1e12):
            continue
        reach = min(math.sqrt(2.0 * math.log(min(o, 1.0) * 255.0)), REACH_MAX)
        hx, hy = reach * math.sqrt(a), reach * math.sqrt(c)
        if not (u + hx > 0 and u - hx < view[16] and v + hy > 0 and v - hy < view[17]):
            continue
        uv[i, 0], uv[i, 1] = u, v
        conics[i, 0], conics[i, 1], conics[i, 2] = c / det, -b / det, a / det
        extents[i, 0], extents[i, 1] = hx, hy


@shared(lambda view, means, *_: (0, means.shape[0]), error_model="numpy")
def project_backward_kernel(
    begin, end, view, means, quats, scales, conics, extents, g_uv, g_conics, g_means, g_quats, g_scales
):
    for i in range(begin, end):
        if extents[i, 0] > 0:
            _backward_one(view, means, quats, scales, conics, g_uv, g_conics, g_means, g_quats, g_scales, i)


@nb.njit(cache=True, error_model="numpy")
def _backward_one(view, means, quats, scales, conics, g_uv, g_conics, g_means, g_quats, g_scales, i):
    x, y, z = _camera_point(view, means, i)
    qw, qx, qy, qz, k = _unit_quat(quats, i)
    row0, row1, row2 = _rotation(qw, qx, qy, qz)
    m0 = _half(view, X, row0, row1, row2, scales, i)
    m1 = _half(view, Y, row0, row1, row2, scales, i)
    m2 = _half(view, Z, row0, row1, row2, scales, i)
    fx, fy = view[12] / z, view[13] / z
    tx, held_x = _tangent(view, x, z, X)
    ty, held_y = _tangent(view, y, z, Y)
    # inverse: d cov = -conic (d conic) conic, with the off-diagonal entry counted twice
    p, q, w = nb.float64(conics[i, 0]), nb.float64(conics[i, 1]), nb.float64(conics[i, 2])
    gp, gq, gw = nb.float64(g_conics[i, 0]), nb.float64(g_conics[i, 1]), nb.float64(g_conics[i, 2])
    ga = -(p * p * gp + p * q * gq + q * q * gw)
    gb = -(2.0 * p * q * gp + (p * w + q * q) * gq + 2.0 * q * w * gw)
    gc = -(q * q * gp + q * w * gq + w * w * gw)
    # cov = (J m)(J m)^T with rows j0 = fx (m0 - tx m2), j1 = fy (m1 - ty m2)
    j0 = (m0[0] - tx * m2[0], m0[1] - tx * m2[1], m0[2] - tx * m2[2])
    j1 = (m1[0] - ty * m2[0], m1[1] - ty * m2[1], m1[2] - ty * m2[2])
    xx, xy, yy = _dot(j0, j0), _dot(j0, j1), _dot(j1, j1)
    xs, ys = _dot(j0, m2), _dot(j1, m2)
    g_fx, g_fy = 2.0 * fx * xx * ga + fy * xy * gb, 2.0 * fy * yy * gc + fx * xy * gb
    g_tx = -2.0 * fx * fx * xs * ga - fx * fy * ys * gb
    g_ty = -2.0 * fy * fy * ys * gc - fx * fy * xs * gb
    # u = fx x + cx, with fx = focal / z; t = x / z unless held
    gu, gv = nb.float64(g_uv[i, 0]), nb.float64(g_uv[i, 1])
    gx, gy = fx * gu, fy * gv
    gz = -(fx * (g_fx + x * gu) + fy * (g_fy + y * gv)) / z
    if not held_x:
        gx += g_tx / z
        gz -= tx * g_tx / z
    if not held_y:
        gy += g_ty / z
        gz -= ty * g_ty / z
    for n in range(3):
        g_means[i, n] = view[n] * gx + view[3 + n] * gy + view[6 + n] * gz
    # gradient of m: (G + G^T) m, G that of the quadratic form; column by column, turned back by the camera
    e00, e11, e01 = fx * fx * ga, fy * fy * gc, fx * fy * gb
    k0 = _column(view, e00, e01, e11, tx, ty, j0[0], j1[0])
    k1 = _column(view, e00, e01, e11, tx, ty, j0[1], j1[1])
    k2 = _column(view, e00, e01, e11, tx, ty, j0[2], j1[2])
    g_scales[i, 0] = k0[0] * row0[0] + k0[1] * row1[0] + k0[2] * row2[0]
    g_scales[i, 1] = k1[0] * row0[1] + k1[1] * row1[1] + k1[2] * row2[1]
    g_scales[i, 2] = k2[0] * row0[2] + k2[1] * row1[2] + k2[2] * row2[2]
    s0, s1, s2 = nb.float64(scales[i, 0]), nb.float64(scales[i, 1]), nb.float64(scales[i, 2])
    r0 = (k0[0] * s0, k1[0] * s1, k2[0] * s2)
    r1 = (k0[1] * s0, k1[1] * s1, k2[1] * s2)
    r2 = (k0[2] * s0, k1[2] * s1, k2[2] * s2)
    _quat_backward(qw, qx, qy, qz, k, r0, r1, r2, g_quats, i)


@nb.njit(cache=True)
def _column(view, e00, e01, e11, tx, ty, j0, j1):
    """One column of the gradient of R diag(scale), in the world, from that column of j0 and j1."""
    d0, d1 = 2.0 * e00 * j0 + e01 * j1, 2.0 * e11 * j1 + e01 * j0
    d2 = -tx * d0 - ty * d1
    c0 = view[0] * d0 + view[3] * d1 + view[6] * d2
    c1 = view[1] * d0 + view[4] * d1 + view[7] * d2
    c2 = view[2] * d0 + view[5] * d1 + view[8] * d2
    return c0, c1, c2


@nb.njit(cache=True)
def _quat_backward(qw, qx, qy, qz, k, r0, r1, r2, g_quats, i):
    """Gradient of a quaternion that is normalised before use (by k), from the rows of that of its rotation matrix."""
    gw = 2.0 * (qx * (r2[1] - r1[2]) + qy * (r0[2] - r2[0]) + qz * (r1[0] - r0[1]))
    gx = 2.0 * (qy * (r0[1] + r1[0]) + qz * (r0[2] + r2[0]) + qw * (r2[1] - r1[2])) - 4.0 * qx * (r1[1] + r2[2])
    gy = 2.0 * (qx * (r0[1] + r1[0]) + qz * (r1[2] + r2[1]) + qw * (r0[2] - r2[0])) - 4.0 * qy * (r0[0] + r2[2])
    gz = 2.0 * (qx * (r0[2] + r2[0]) + qy * (r1[2] + r2[1]) + qw * (r1[0] - r0[1])) - 4.0 * qz * (r0[0] + r1[1])
    along = qw * gw + qx * gx + qy * gy + qz * gz
    g_quats[i, 0], g_quats[i, 1] = k * (gw - along * qw), k * (gx - along * qx)
    g_quats[i, 2], g_quats[i, 3] = k * (gy - along * qy), k * (gz - along * qz)
