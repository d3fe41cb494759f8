"""A body from elsewhere: Gaussians that another generator made, seen by a known camera."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import InputRejected
from fluidlift.shape.registration import pose_up
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
    assert index is not None
    return np.where(mask, near[tuple(index)], 0.0), np.where(mask, far[tuple(index)], 0.0)


def into_view(
    means: Float[np.ndarray, "n 3"], camera: PinholeCamera, view: PinholeCamera, *, depth: float = 1.0
) -> Similarity3:
    """Brings a body that `camera` saw to where `view` sees it at the same place, as large, from the same side.

    Generators have cameras of their own: always 40 degrees wide, say, on a cut-out as large as the fluid is in that
    frame. Their middle comes to the depth asked for along the ray of its pixel; the scale makes up for the focal
    lengths (weak perspective: exact for a body that is small beside its distance). For cameras of the same focal
    length and principal point it is exact for every body: a turn and a scaling about the camera.

    Args:
        means: of the Gaussians, in the generator's world.
        camera: that saw them there, with the size of the whole picture.
        view: the clip's camera, in the world that the body comes to.
        depth: camera z of the body's middle (median) in that world.

    Raises:
        InputRejected: the camera does not see the body.
    """
    seen = camera.camera_from_world.points(means)
    if len(seen) == 0 or (seen[:, 2] > 0).mean() < 0.5:
        raise InputRejected(
            "most Gaussians lie behind the camera that came with them", "x_cam = R x_world + t with z forward"
        )
    middle = np.median(seen[seen[:, 2] > 0], axis=0)
    before = middle / middle[2]
    pixel = np.array(camera.focal) * before[:2] + np.array(camera.center)
    pixel = pixel * np.array(view.size) / np.array(camera.size)
    after = np.append((pixel - np.array(view.center)) / np.array(view.focal), 1.0)
    focal = float(np.sqrt(np.prod(camera.focal) * np.prod(view.size) / np.prod(camera.size)))
    scale = focal / middle[2] * depth / float(np.sqrt(np.prod(view.focal)))
    turn = _rotation_between(before, after)
    world_from_view = view.camera_from_world.inverse()
    rotation = world_from_view.rotation @ turn @ camera.camera_from_world.rotation
    moved = turn @ (camera.camera_from_world.translation - middle) * scale + depth * after
    return Similarity3(scale, rotation, world_from_view.points(moved))


def _rotation_between(a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The shortest turn from the direction of one ray to that of another (Rodrigues; both look forward)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    x, y, z = np.cross(a, b)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + float(a @ b))
