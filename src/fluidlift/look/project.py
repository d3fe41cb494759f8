"""What makes any Gaussians drawable from one camera: colours for the view, nothing broken, nothing huge."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.numerics.harmonics import basis
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import SH_C0, Gaussians

LARGEST = 0.25
"""largest standard deviation of a drawn Gaussian, as a share of the longer side of the picture"""


def view_colors(gaussians: Gaussians, camera: PinholeCamera) -> Float[np.ndarray, "n 3"]:
    """Colours as this camera sees them, at least 0 (harmonics may overshoot 1, as in 3D Gaussian Splatting)."""
    degree = int(round(gaussians.sh.shape[1] ** 0.5)) - 1
    if degree == 0:
        return np.maximum(0.5 + SH_C0 * gaussians.sh[:, 0], 0.0)
    d = gaussians.means - camera.position.astype(np.float32)
    d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12)
    return np.maximum(0.5 + np.einsum("nk,nkc->nc", basis(d, degree), gaussians.sh), 0.0)


def sound(gaussians: Gaussians) -> Float[np.ndarray, "n"]:
    """bool [n]: every number finite, scales not negative, a quaternion that is not zero."""
    g = gaussians
    ok = np.isfinite(g.means).all(1) & np.isfinite(g.quats).all(1) & np.isfinite(g.scales).all(1)
    ok &= np.isfinite(g.opacities) & np.isfinite(g.sh).all((1, 2))
    return ok & (g.scales >= 0).all(1) & (np.abs(g.quats).max(1, initial=0.0) > 1e-12)


def bounded_scales(
    scales: Float[np.ndarray, "n 3"], depths: Float[np.ndarray, "n"], camera: PinholeCamera, largest: float = LARGEST
) -> Float[np.ndarray, "n 3"]:
    """Scales (m) held so that none is wider than `largest` of the picture at its depth (m).

    A Gaussian that fills the picture is an accident of its maker, and near the camera the affine approximation of the
    projection no longer holds.
    """
    limit = largest * max(camera.size) / max(camera.focal) * np.maximum(depths, 0.0)
    return np.minimum(scales, limit[:, None].astype(np.float32))
