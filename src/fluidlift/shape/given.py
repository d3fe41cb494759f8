"""A body from elsewhere: Gaussians that another generator made, seen by a known camera."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import InputRejected
from fluidlift.shape.place import pose_up
from fluidlift.types import Gaussians, PinholeCamera, Similarity3


def canonical_from_given(camera: PinholeCamera, gaussians: Gaussians) -> Similarity3:
    """Turns, moves and scales a given body (z up) so that its camera is at the origin, looks along +y, and its middle
    is at depth 1.

    Raises:
        InputRejected: the camera does not see the body.
    """
    _, depth = camera.project(gaussians.means)
    in_front = depth > 0
    if in_front.mean() < 0.5:
        raise InputRejected(
            "most Gaussians lie behind the camera of their camera.json",
            "x_cam = R x_world + t with z forward, in the same units and axes (z up) as the PLY files",
        )
    _, heading = pose_up(camera)
    turn = np.radians(-heading)
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    scale = 1.0 / float(np.median(depth[in_front]))
    return Similarity3(scale, rotation, -scale * rotation @ camera.position)


def near_and_far(
    gaussians: Gaussians, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Camera depth of the near and the far side of a body at every pixel of a mask (0 elsewhere).

    Each Gaussian counts over the pixels within one standard deviation; pixels that none covers take the nearest.

    Raises:
        InputRejected: the body is not where the mask is.
    """
    height, width = mask.shape
    uv, z = camera.project(gaussians.means)
    col, row = np.floor(uv[:, 0]).astype(int), np.floor(uv[:, 1]).astype(int)
    ok = (z > 0) & (col >= 0) & (col < width) & (row >= 0) & (row < height) & (gaussians.opacities > 0.1)
    near, far = np.full(mask.shape, np.inf), np.full(mask.shape, -np.inf)
    np.minimum.at(near, (row[ok], col[ok]), z[ok])
    np.maximum.at(far, (row[ok], col[ok]), z[ok])
    radius = np.median(gaussians.scales[ok].max(axis=1) / z[ok]) * camera.focal[0] if ok.any() else 1.0
    side = 2 * int(np.clip(np.ceil(radius), 1, 8)) + 1
    near, far = ndimage.minimum_filter(near, size=side), ndimage.maximum_filter(far, size=side)
    seen = np.isfinite(near) & mask
    if seen.sum() < 0.3 * mask.sum():
        raise InputRejected(
            f"the given Gaussians cover {100 * seen.sum() / max(mask.sum(), 1):.0f} % of the fluid in the picture",
            "a body that its camera.json shows where the fluid is",
            "check the axes (z up) and the camera of --geometry-from, or the mask",
        )
    index = ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
    return np.where(mask, near[tuple(index)], 0.0), np.where(mask, far[tuple(index)], 0.0)
