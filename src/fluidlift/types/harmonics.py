"""Real spherical harmonics up to degree 3, in the order and sign of 3D Gaussian Splatting (Kerbl et al. 2023).

They stand on this floor because Gaussians must know how their own colours turn.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require


def basis(directions: Float[np.ndarray, "n 3"], degree: int) -> Float[np.ndarray, "n k"]:
    """The k = (degree + 1)^2 harmonics at unit directions (from the camera to the Gaussian)."""
    require(0 <= degree <= 3, f"harmonics of degree {degree}", "0 to 3")
    d = np.asarray(directions)
    x, y, z = d[:, 0], d[:, 1], d[:, 2]
    out = np.empty((len(d), (degree + 1) ** 2), d.dtype)
    out[:, 0] = 0.28209479177387814
    if degree > 0:
        out[:, 1], out[:, 2], out[:, 3] = -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x
    if degree > 1:
        out[:, 4] = 1.0925484305920792 * x * y
        out[:, 5] = -1.0925484305920792 * y * z
        out[:, 6] = 0.31539156525252005 * (2 * z * z - x * x - y * y)
        out[:, 7] = -1.0925484305920792 * x * z
        out[:, 8] = 0.5462742152960396 * (x * x - y * y)
    if degree > 2:
        out[:, 9] = -0.5900435899266435 * y * (3 * x * x - y * y)
        out[:, 10] = 2.890611442640554 * x * y * z
        out[:, 11] = -0.4570457994644658 * y * (4 * z * z - x * x - y * y)
        out[:, 12] = 0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y)
        out[:, 13] = -0.4570457994644658 * x * (4 * z * z - x * x - y * y)
        out[:, 14] = 1.445305721320277 * z * (x * x - y * y)
        out[:, 15] = -0.5900435899266435 * x * (x * x - 3 * y * y)
    return out


def harmonics_rotation(rotation: Float[np.ndarray, "3 3"], degree: int) -> Float[np.ndarray, "k k"]:
    """The matrix that turns spherical harmonic coefficients with the body: new(R d) = old(d) for every direction d.

    Found by least squares over many directions; exact, because each degree is closed under rotation.
    """
    i = np.arange(64) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / 64), np.pi * (1 + 5**0.5) * i
    old = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    new = old @ np.asarray(rotation, np.float64).T
    return np.linalg.lstsq(basis(new, degree), basis(old, degree), rcond=None)[0]


def rotated(sh: Float[np.ndarray, "n k 3"], rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n k 3"]:
    """Coefficients of bodies turned by `rotation`; those of degree 0 are the same from all sides."""
    k = sh.shape[1]
    if k == 1 or np.array_equal(rotation, np.eye(3)):
        return sh
    turn = harmonics_rotation(rotation, math.isqrt(k) - 1).astype(np.float32)
    return np.tensordot(turn, sh, axes=(1, 1)).transpose(1, 0, 2)
