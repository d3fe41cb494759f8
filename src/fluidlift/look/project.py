"""What makes any Gaussians drawable from one camera: colours for the view, nothing broken, nothing huge."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from fluidlift.numerics.sharing import shared
from fluidlift.numerics.splatting_colors import colors
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians

LARGEST = 0.25
"""largest standard deviation of a drawn Gaussian, as a share of the longer side of the picture"""


def view_colors(
    gaussians: Gaussians, camera: PinholeCamera, index: Int[np.ndarray, " m"] | None = None
) -> Float[np.ndarray, "m 3"]:
    """Colours as this camera sees them, at least 0 (harmonics may overshoot 1, as in 3D Gaussian Splatting); of all
    Gaussians, or of those of `index` in its order."""
    return colors(gaussians.means, gaussians.sh, camera.position, index)


def sound(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """Every number finite, scales not negative, a quaternion that is not zero."""
    g = gaussians
    ok = np.empty(len(g), np.bool_)
    sound_kernel(g.means, g.quats, g.scales, g.opacities, g.sh.reshape(len(g), 3 * g.sh.shape[1]), ok)
    return ok


@shared(lambda means, *_: (0, means.shape[0]))
def sound_kernel(begin, end, means, quats, scales, opacities, sh, ok):
    """`sound_plain` in one pass. A sum of zeros, each times a number, is 0 only if all of them are finite."""
    zero = np.float32(0)
    for i in range(begin, end):
        total, largest, least = zero * opacities[i], zero, scales[i, 0]
        for k in range(3):
            total += zero * means[i, k] + zero * scales[i, k]
            least = min(least, scales[i, k])
        for k in range(4):
            total += zero * quats[i, k]
            largest = max(largest, abs(quats[i, k]))
        for k in range(sh.shape[1]):
            total += zero * sh[i, k]
        ok[i] = total == zero and least >= zero and largest > 1e-12


def sound_plain(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """What `sound` does, for reading."""
    g = gaussians
    ok = np.isfinite(g.means).all(1) & np.isfinite(g.quats).all(1) & np.isfinite(g.scales).all(1)
    ok &= np.isfinite(g.opacities) & np.isfinite(g.sh).all((1, 2))
    return ok & (g.scales >= 0).all(1) & (np.abs(g.quats).max(1, initial=0.0) > 1e-12)


def camera_depths(means: Float[np.ndarray, "n 3"], camera: PinholeCamera) -> Float[np.ndarray, " n"]:
    """Camera z (float32, m) of world points, without double precision copies of them."""
    pose = camera.camera_from_world
    return means @ np.float32(pose.rotation[2]) + np.float32(pose.translation[2])


def bounded_scales(
    scales: Float[np.ndarray, "n 3"], depths: Float[np.ndarray, " n"], camera: PinholeCamera, largest: float = LARGEST
) -> Float[np.ndarray, "n 3"]:
    """Scales (m) held so that none is wider than `largest` of the picture at its depth (m).

    A Gaussian that fills the picture is an accident of its maker, and near the camera the affine approximation of the
    projection no longer holds.
    """
    limit = np.float32(largest * max(camera.size) / max(camera.focal)) * np.maximum(depths, np.float32(0.0))
    return np.minimum(scales, limit[:, None].astype(np.float32, copy=False))
