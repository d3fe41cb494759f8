"""Real spherical harmonics up to degree 3, in the order and sign of 3D Gaussian Splatting (Kerbl et al. 2023)."""

from __future__ import annotations

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
