"""What particles carry, at other points: means weighted by a kernel (Numba).

The weight is (1 - d^2 / reach^2)^3 (Mueller, Charypar and Gross 2003), which needs no root and is as wide as a cubic
spline that reaches 4/3 as far. The mean is that of Shepard: the weights are divided by their sum, so that an even field
stays even at the rim of a body, where half a kernel is empty.

Particles are sorted into cells as wide as the kernel reaches; a point looks into 27 of them.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.numerics.cell_list import CellList
from fluidlift.numerics.sharing import shared

_CHUNK = 256


@shared(lambda points, *_: (0, -(-points.shape[0] // _CHUNK)), error_model="numpy", fastmath={"contract"})
def mean_kernel(begin, end, points, particles, values, starts, low, reach, shape, out, total):
    """Sums over the particles (sorted by cell) of weight times value, divided by the sum of weights, which is kept."""
    n, width, one = points.shape[0], values.shape[1], np.float32(1)
    steep = np.float32(1.0 / (reach * reach))
    for chunk in range(begin, end):
        sums, at = np.empty(width, np.float32), np.empty(3, np.int64)
        for p in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            x, y, z = points[p, 0], points[p, 1], points[p, 2]
            for axis in range(3):
                at[axis] = np.int64(math.floor((points[p, axis] - low[axis]) / reach))
            sums[:] = 0
            weights = np.float32(0)
            for around in range(27):
                i, j = (at[0] + around // 9 - 1) % shape[0], (at[1] + around // 3 % 3 - 1) % shape[1]
                cell = (i * shape[1] + j) * shape[2] + (at[2] + around % 3 - 1) % shape[2]
                for k in range(starts[cell], starts[cell + 1]):
                    dx, dy, dz = particles[k, 0] - x, particles[k, 1] - y, particles[k, 2] - z
                    left = one - (dx * dx + dy * dy + dz * dz) * steep
                    if left > 0:
                        w = left * left * left
                        weights += w
                        for c in range(width):
                            sums[c] += w * values[k, c]
            total[p] = weights
            for c in range(width):
                out[p, c] = sums[c] / weights if weights > 0 else np.float32(0)


def kernel_mean(
    points: Float[np.ndarray, "m 3"],
    particles: Float[np.ndarray, "n 3"],
    values: Float[np.ndarray, "n k"],
    reach: float,
) -> Float[np.ndarray, "m k"]:
    """Means of the values of the particles around each point, float32; that of the nearest where none is in reach.

    Args:
        points, particles: m, finite; at least one particle.
        reach: m, from which on particles do not weigh.

    Raises:
        ValueError: no particle, or a reach that is not positive.
    """
    require(len(particles) > 0, "no particles", "one or more")
    require(np.isfinite(reach) and reach > 0, f"a reach of {reach}", "positive metres")
    low, reach, shape, order, starts = CellList.of(particles, reach)
    out, total = np.empty((len(points), values.shape[1]), np.float32), np.empty(len(points), np.float32)
    sorted_values = np.ascontiguousarray(values[order], np.float32)
    mean_kernel(points, particles[order], sorted_values, starts, low, reach, shape, out, total)
    lost = np.flatnonzero(total <= 0)
    if len(lost):
        from scipy.spatial import KDTree

        out[lost] = values[KDTree(particles).query(points[lost])[1]]
    return out


def kernel_mean_plain(
    points: Float[np.ndarray, "m 3"],
    particles: Float[np.ndarray, "n 3"],
    values: Float[np.ndarray, "n k"],
    reach: float,
) -> Float[np.ndarray, "m k"]:
    """The plain twin of `kernel_mean`, for points with particles in reach: m x n numbers."""
    squared = ((points[:, None].astype(np.float64) - particles) ** 2).sum(axis=2)
    weights = np.maximum(1.0 - squared / reach**2, 0.0) ** 3
    return (weights @ values / weights.sum(axis=1, keepdims=True)).astype(np.float32)
