"""Signed distance fields (SDF) at grid nodes: making them, and keeping points outside the solid."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from fluidlift.numerics.sharing import shared
from fluidlift.types import Grid


@njit(cache=True)
def distance_and_gradient(field, low, inverse_spacing, x, y, z):
    """Trilinear value and gradient (per m) of a node field at one point, for kernels."""
    nx, ny, nz = field.shape
    px = min(max((x - low[0]) * inverse_spacing, 0.0), nx - 1.0)
    py = min(max((y - low[1]) * inverse_spacing, 0.0), ny - 1.0)
    pz = min(max((z - low[2]) * inverse_spacing, 0.0), nz - 1.0)
    i = min(np.int64(px), nx - 2)
    j = min(np.int64(py), ny - 2)
    k = min(np.int64(pz), nz - 2)
    fx, fy, fz = px - i, py - j, pz - k
    a00 = field[i, j, k] * (1 - fx) + field[i + 1, j, k] * fx
    a10 = field[i, j + 1, k] * (1 - fx) + field[i + 1, j + 1, k] * fx
    a01 = field[i, j, k + 1] * (1 - fx) + field[i + 1, j, k + 1] * fx
    a11 = field[i, j + 1, k + 1] * (1 - fx) + field[i + 1, j + 1, k + 1] * fx
    value = (a00 * (1 - fy) + a10 * fy) * (1 - fz) + (a01 * (1 - fy) + a11 * fy) * fz
    gz = (a01 * (1 - fy) + a11 * fy) - (a00 * (1 - fy) + a10 * fy)
    gy = (a10 - a00) * (1 - fz) + (a11 - a01) * fz
    d00 = field[i + 1, j, k] - field[i, j, k]
    d10 = field[i + 1, j + 1, k] - field[i, j + 1, k]
    d01 = field[i + 1, j, k + 1] - field[i, j, k + 1]
    d11 = field[i + 1, j + 1, k + 1] - field[i, j + 1, k + 1]
    gx = (d00 * (1 - fy) + d10 * fy) * (1 - fz) + (d01 * (1 - fy) + d11 * fy) * fz
    return value, gx * inverse_spacing, gy * inverse_spacing, gz * inverse_spacing


@shared(lambda points, *_: (0, len(points)))
def _push(begin, end, points, field, low, inverse_spacing, margin, inside):
    for p in range(begin, end):
        x, y, z = np.float64(points[p, 0]), np.float64(points[p, 1]), np.float64(points[p, 2])
        for _ in range(8):
            value, gx, gy, gz = distance_and_gradient(field, low, inverse_spacing, x, y, z)
            if value >= margin:
                break
            squared = gx * gx + gy * gy + gz * gz
            if squared < 1e-6:
                break
            step = 1.01 * (margin - value) / squared
            x += step * gx
            y += step * gy
            z += step * gz
        points[p, 0], points[p, 1], points[p, 2] = x, y, z
        value, gx, gy, gz = distance_and_gradient(
            field, low, inverse_spacing, np.float64(points[p, 0]), np.float64(points[p, 1]), np.float64(points[p, 2])
        )
        inside[p] = value < 0.0


def push_outside(
    points: Float[np.ndarray, "n 3"], signed_distance: np.ndarray, grid: Grid, margin: float = 0.0
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Points (m, float32) moved along the gradient until `margin` m outside, and which of them are still inside."""
    moved = np.array(points, np.float32, order="C")
    inside = np.zeros(len(moved), bool)
    field = np.ascontiguousarray(signed_distance, np.float32)
    _push(moved, field, grid.low, 1.0 / grid.spacing, float(margin), inside)
    return moved, inside
