"""The quadratic B-spline of particle-grid transfers.

N(r) = 3/4 - r^2 for |r| < 1/2, (3/2 - |r|)^2 / 2 for |r| < 3/2, else 0; r in cells. It has the moments
sum_i N = 1, sum_i N (x_i - x) = 0 and sum_i N (x_i - x)^2 = 1/4 cell^2, which is why the affine matrix of APIC
needs the constant factor 4 / h^2 (paper: `particle_map`; Jiang et al. 2015).
"""

from __future__ import annotations

import numpy as np
from numba import njit


def quadratic(coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First of the three samples each point touches, int64 [...], and their weights [...,3].

    Args:
        coordinates: positions in cells, such that sample i lies at coordinate i.
    """
    base = np.floor(coordinates - 0.5).astype(np.int64)
    r = coordinates - base  # in [0.5, 1.5)
    weights = np.stack([0.5 * (1.5 - r) ** 2, 0.75 - (r - 1.0) ** 2, 0.5 * (r - 0.5) ** 2], axis=-1)
    return base, weights


@njit(cache=True, inline="always")
def quadratic_weights(coordinate):
    """`quadratic` of one number, for kernels: base and the three weights."""
    base = np.int64(np.floor(coordinate - np.float32(0.5)))
    r = coordinate - np.float32(base)
    a = np.float32(1.5) - r
    b = r - np.float32(1.0)
    c = r - np.float32(0.5)
    return base, np.float32(0.5) * a * a, np.float32(0.75) - b * b, np.float32(0.5) * c * c
