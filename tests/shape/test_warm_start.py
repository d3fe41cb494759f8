"""Frames after the first start from the last: better for the same work, and without ghosts of what has gone."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.shape.generate import front_gaussians
from fluidlift.shape.refine import refine
from fluidlift.shape.warm_start import carried, follow
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians

CAMERA = PinholeCamera.looking(np.array([0.0, -3.0, 1.5]), np.zeros(3), 45, (96, 72))
SHIFT = 3


def sheet(shift: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frame, mask and depth of a level sheet with a pattern of 9 px that has moved by `shift` px to the right."""
    v, u = np.mgrid[0:72, 0:96].astype(np.float32)
    wave = np.sin((u - shift) * 0.7) * np.sin(v * 0.6)
    image = np.clip(np.stack([120 + 90 * wave, 130 + 70 * wave, np.full_like(u, 150)], -1), 0, 255).astype(np.uint8)
    mask = (v > 22) & (v < 62) & (u > 8) & (u < 88)
    rays = CAMERA.rays(CAMERA.pixel_grid())
    depth = np.where(mask, -CAMERA.position[2] / np.minimum(rays[..., 2], -1e-3), 0.0)
    return image, mask, depth.astype(np.float32)


def front(shift: float = 0.0) -> Gaussians:
    return front_gaussians(*sheet(shift), CAMERA, stride=2)


def test_a_frame_that_starts_from_the_last_needs_few_steps():
    image, mask, depth = sheet()
    first = refine(front(), image, mask, CAMERA, iterations=60).gaussians
    later = sheet(SHIFT)[0]
    motion = np.zeros((*mask.shape, 2), np.float32)
    motion[..., 0] = SHIFT
    warm = follow(first, front(SHIFT), later, mask, CAMERA, motion=motion, depths=(depth, depth), iterations=8)
    cold = refine(front(SHIFT), later, mask, CAMERA, iterations=8)
    whole = refine(front(SHIFT), later, mask, CAMERA, iterations=60)
    # three more pixels of the pattern come in at the left; otherwise the picture is the last one, moved
    assert warm.psnr_after > cold.psnr_after + 2
    assert warm.psnr_after > whole.psnr_after - 2, "in an eighth of the steps"
    assert warm.kept, "the guard lets it pass: the shape is that of the body it started from"


def test_carried_gaussians_stay_on_the_surface():
    _, mask, depth = sheet()
    body = front()
    motion = np.zeros((*mask.shape, 2), np.float32)
    motion[..., 1] = 2.0  # towards the camera: the surface is nearer there
    moved = carried(body, Gaussians.empty(), mask, CAMERA, motion=motion, depths=(depth, depth))
    assert 0 < len(moved) < len(body), "what leaves the mask is left behind"
    # at the front edge the depth is carried on from the last pixel: 2 px of 0.5 %
    assert np.abs(moved.means[:, 2]).max() < 0.06
    assert np.median(np.abs(moved.means[:, 2])) < 0.002


def test_what_the_fluid_has_left_is_dropped_and_what_it_has_reached_is_fresh():
    _, mask, _ = sheet()
    left, right = mask.copy(), mask.copy()
    left[:, 60:] = False
    right[:, :40] = False
    image, _, depth = sheet()
    last = front_gaussians(image, left, depth, CAMERA, stride=3)
    fresh = front_gaussians(image, right, depth, CAMERA, stride=3)
    body = carried(last, fresh, right, CAMERA)
    column = CAMERA.project(body.means)[0][:, 0]
    assert column.min() >= 40
    new = np.isin(body.means[:, 0], fresh.means[:, 0]) & (column > 63)
    assert new.sum() > 0.95 * (CAMERA.project(fresh.means)[0][:, 0] > 63).sum()
    assert len(body) < 1.15 * len(fresh), "no second layer where the last body covers the picture"


def test_gaussians_off_the_picture_and_behind_the_camera_stay():
    _, mask, _ = sheet()
    far = Gaussians.isotropic(np.float32([[9, 0, 0], [0, -9, 2]]), 0.1, np.float32([[0.3] * 3] * 2))
    motion = np.ones((*mask.shape, 2), np.float32)
    np.testing.assert_array_equal(carried(far, Gaussians.empty(), mask, CAMERA, motion=motion).means, far.means)


def test_what_does_not_fit_is_refused():
    image, mask, depth = sheet()
    with pytest.raises(ValueError, match="motion"):
        follow(front(), front(), image, mask, CAMERA, motion=np.zeros((3, 3, 2)))
    with pytest.raises(ValueError, match="depths"):
        follow(front(), front(), image, mask, CAMERA, depths=(depth[:-1], depth))
    with pytest.raises(InputRejected, match="empty fluid mask"):
        follow(front(), front(), image, np.zeros_like(mask), CAMERA)
