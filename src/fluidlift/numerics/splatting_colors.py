"""Colours of Gaussians as a camera sees them: real spherical harmonics up to degree 3, with their exact derivatives.

Order and sign are those of 3D Gaussian Splatting (Kerbl et al. 2023), as in `harmonics.basis`: a colour is
max(0.5 + sum_k sh_k Y_k(d), 0), where d is the unit direction from the camera to the Gaussian's centre.
With gradients, and for reading: `splatting_colors_torch`.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require
from fluidlift.numerics.sharing import shared

_CHUNK = 4096
C0, C1 = 0.28209479177387814, 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


@nb.njit(cache=True)
def _basis(x, y, z, count, out):
    out[0] = C0
    if count > 1:
        out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if count > 4:
        out[4], out[5], out[7] = C2[0] * x * y, -C2[0] * y * z, -C2[0] * x * z
        out[6], out[8] = C2[1] * (2.0 * z * z - x * x - y * y), C2[2] * (x * x - y * y)
    if count > 9:
        out[9], out[15] = -C3[0] * y * (3.0 * x * x - y * y), -C3[0] * x * (x * x - 3.0 * y * y)
        out[10], out[14] = C3[1] * x * y * z, C3[4] * z * (x * x - y * y)
        ring = 4.0 * z * z - x * x - y * y
        out[11], out[13] = -C3[2] * y * ring, -C3[2] * x * ring
        out[12] = C3[3] * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)


@nb.njit(cache=True)
def _basis_backward(x, y, z, count, g):
    """Gradient of sum_k g_k Y_k(x, y, z), with Y taken as the polynomials above."""
    gx, gy, gz = 0.0, 0.0, 0.0
    if count > 1:
        gx, gy, gz = -C1 * g[3], -C1 * g[1], C1 * g[2]
    if count > 4:
        a, b, c = C2
        gx += a * (y * g[4] - z * g[7]) + 2.0 * x * (c * g[8] - b * g[6])
        gy += a * (x * g[4] - z * g[5]) - 2.0 * y * (c * g[8] + b * g[6])
        gz += -a * (y * g[5] + x * g[7]) + 4.0 * b * z * g[6]
    if count > 9:
        a, b, c, d, e = C3
        xx, yy, zz = x * x, y * y, z * z
        gx += -6.0 * a * x * y * g[9] + b * y * z * g[10] + 2.0 * c * x * y * g[11] - 6.0 * d * x * z * g[12]
        gx += -c * (4.0 * zz - 3.0 * xx - yy) * g[13] + 2.0 * e * x * z * g[14] - 3.0 * a * (xx - yy) * g[15]
        gy += -3.0 * a * (xx - yy) * g[9] + b * x * z * g[10] - c * (4.0 * zz - xx - 3.0 * yy) * g[11]
        gy += -6.0 * d * y * z * g[12] + 2.0 * c * x * y * g[13] - 2.0 * e * y * z * g[14] + 6.0 * a * x * y * g[15]
        gz += b * x * y * g[10] - 8.0 * c * z * (y * g[11] + x * g[13])
        gz += d * (6.0 * zz - 3.0 * xx - 3.0 * yy) * g[12] + e * (xx - yy) * g[14]
    return gx, gy, gz


@nb.njit(cache=True)
def _direction(means, position, i):
    x, y, z = means[i, 0] - position[0], means[i, 1] - position[1], means[i, 2] - position[2]
    k = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return x * k, y * k, z * k, k


@shared(lambda means, sh, position, rows, *_: (0, -(-rows.shape[0] // _CHUNK)), error_model="numpy")
def colors_kernel(begin, end, means, sh, position, rows, out):
    n, count = rows.shape[0], sh.shape[1]
    for chunk in range(begin, end):
        basis = np.empty(16)
        for p in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            i = rows[p]
            if count > 1:
                x, y, z, _ = _direction(means, position, i)
                _basis(x, y, z, count, basis)
            else:
                basis[0] = C0
            for c in range(3):
                total = 0.5
                for k in range(count):
                    total += basis[k] * sh[i, k, c]
                out[p, c] = max(total, 0.0)


@shared(lambda means, sh, *_: (0, -(-sh.shape[0] // _CHUNK)), error_model="numpy")
def colors_backward_kernel(begin, end, means, sh, position, out, g_out, g_means, g_sh):
    n, count = sh.shape[0], sh.shape[1]
    for chunk in range(begin, end):
        basis, g = np.empty(16), np.empty(16)
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            x, y, z, scale = _direction(means, position, i)
            _basis(x, y, z, count, basis)
            for k in range(count):
                g[k] = 0.0
                for c in range(3):
                    push = g_out[i, c] if out[i, c] > 0 else 0.0  # a colour held at 0 does not move
                    g_sh[i, k, c] = push * basis[k]
                    g[k] += push * sh[i, k, c]
            gx, gy, gz = _basis_backward(x, y, z, count, g)
            along = gx * x + gy * y + gz * z
            g_means[i, 0] = scale * (gx - along * x)
            g_means[i, 1] = scale * (gy - along * y)
            g_means[i, 2] = scale * (gz - along * z)


def colors(
    means: Float[np.ndarray, "n 3"],
    sh: Float[np.ndarray, "n k 3"],
    position: Float[np.ndarray, "3"],
    rows: Int[np.ndarray, " m"] | None = None,
) -> Float[np.ndarray, "m 3"]:
    """Colours (0 and up) of Gaussians at `means` (m) seen from `position` (m), in the precision of `sh`: of all, or of
    those of `rows`, in that order.

    Raises:
        ValueError: other than 1, 4, 9 or 16 coefficients.
    """
    require(sh.shape[1] in (1, 4, 9, 16), f"{sh.shape[1]} coefficients of harmonics", "1, 4, 9 or 16 (degree 0 to 3)")
    rows = np.arange(len(sh), dtype=np.int32) if rows is None else np.ascontiguousarray(rows, np.int32)
    out = np.empty((len(rows), 3), sh.dtype)
    colors_kernel(means, sh, np.asarray(position, np.float64), rows, out)
    return out
