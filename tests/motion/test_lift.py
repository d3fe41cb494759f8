"""From px/frame to m/s on a plane that moves as known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.motion.lift import depth_change, follow_depth, lift_flow
from fluidlift.types import PinholeCamera

CAMERA = PinholeCamera.looking((0.3, -2.0, 1.5), (0.0, 0.0, 0.0), 50.0, (96, 72))
INTERVAL = 0.04


def plane(offset: float = 0.0) -> np.ndarray:
    """Camera z of the plane z = offset in the world."""
    rays = CAMERA.rays(CAMERA.pixel_grid())
    return (offset - CAMERA.position[2]) / rays[..., 2]


def flow_of(velocity: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """px/frame of points of the visible surface that move with one velocity (m/s)."""
    uv = CAMERA.pixel_grid()
    moved, _ = CAMERA.project(CAMERA.unproject(uv, depth) + velocity * INTERVAL)
    return moved - uv


@pytest.mark.parametrize("velocity", [(0.6, 0.0, 0.0), (-0.2, 0.9, 0.0), (0.3, 0.2, 0.5)])
def test_a_rigidly_moving_plane_has_its_velocity(velocity: tuple[float, float, float]) -> None:
    v = np.array(velocity)
    depth = plane()
    mask = np.ones(depth.shape, bool)
    d = flow_of(v, depth)
    motion = lift_flow(d, mask, mask, depth, plane(v[2] * INTERVAL), CAMERA, INTERVAL)
    u, w = np.moveaxis(CAMERA.pixel_grid() + d, -1, 0)
    inner = ((u > 1) & (u < 95) & (w > 1) & (w < 71)).ravel()
    # inverse depth is linear over a plane: what is left is float32
    assert np.abs(motion.velocities[inner] - v).max() < 1e-3
    assert np.allclose(motion.points, CAMERA.unproject(CAMERA.pixel_grid(), depth).reshape(-1, 3), atol=1e-5)


def test_fluid_that_leaves_the_mask_slides_along_the_surface() -> None:
    v = np.array([0.8, 0.0, 0.0])
    depth = plane()
    mask = np.zeros(depth.shape, bool)
    mask[20:60, 30:60] = True
    nowhere = np.where(mask, depth, 0.0)  # depth outside the mask means nothing and must not be looked at
    motion = lift_flow(flow_of(v, depth), mask, mask, nowhere, nowhere, CAMERA, INTERVAL)
    assert np.abs(motion.velocities - v).max() < 0.01  # one-sided gradients at the rim are exact on a plane


def test_a_jump_of_depth_is_cut_back() -> None:
    v = np.array([0.5, 0.0, 0.0])
    depth = plane()
    mask = np.ones(depth.shape, bool)
    broken = depth.copy()
    broken[30:34, 40:44] = 8.0  # 5 m behind: 140 m/s if believed
    motion = lift_flow(flow_of(v, depth), mask, mask, depth, broken, CAMERA, INTERVAL)
    assert np.linalg.norm(motion.velocities, axis=-1).max() < 5.0
    assert np.median(np.abs(motion.velocities - v)) < 0.01


def test_every_pixel_of_the_fluid_gives_a_point_and_observed_goes_along() -> None:
    depth = plane()
    mask = np.ones(depth.shape, bool)
    mask[:10] = False
    observed = np.zeros_like(mask)
    observed[:, :48] = True
    d = np.zeros((*mask.shape, 2), np.float32)
    motion = lift_flow(d, observed, mask, depth, depth, CAMERA, INTERVAL)
    assert len(motion.points) == mask.sum()
    assert (motion.observed == observed[mask]).all()
    assert np.abs(motion.velocities).max() < 1e-3


def test_depth_change_is_what_the_material_gains() -> None:
    v = np.array([0.0, 1.0, 0.0])
    depth = plane()
    mask = np.ones(depth.shape, bool)
    gained = CAMERA.camera_from_world.vectors(v)[2] * INTERVAL
    change = depth_change(flow_of(v, depth), mask, depth, depth)
    assert np.abs(change[8:-8, 8:-8] - gained).max() < 0.02 * abs(gained)


def turning_flow(camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """Flow and depth of the plane z = 0 that turns about the vertical through (0.2, 0.1) and rises."""
    uv = camera.pixel_grid()
    rays = camera.rays(uv)
    depth = -camera.position[2] / rays[..., 2]
    x = camera.unproject(uv, depth)
    velocity = np.stack([-(x[..., 1] - 0.1), x[..., 0] - 0.2, np.full(depth.shape, 0.05)], axis=-1)
    moved, _ = camera.project(x + velocity * INTERVAL)
    return moved - uv, depth


def test_a_cropped_and_enlarged_picture_with_its_camera_gives_the_same_velocities() -> None:
    x0, y0, size, scale = 17, 9, (54, 40), 3
    cut = replace(CAMERA, center=(CAMERA.center[0] - x0, CAMERA.center[1] - y0), size=size)
    working = cut.resized((scale * size[0], scale * size[1]))
    found = []
    for camera in (CAMERA, working):
        flow, depth = turning_flow(camera)
        mask = np.ones(depth.shape, bool)
        rising = depth + 0.05 * INTERVAL / camera.rays(camera.pixel_grid())[..., 2]
        motion = lift_flow(flow, mask, mask, depth, rising, camera, INTERVAL)
        found.append([a.reshape(*mask.shape, 3) for a in (motion.points, motion.velocities)])
    # the centre of pixel i of the source is that of pixel 3 i + 1 of the enlarged cut
    source = [a[y0 : y0 + size[1], x0 : x0 + size[0]] for a in found[0]]
    there = [a[1::scale, 1::scale] for a in found[1]]
    inner = (slice(2, -2), slice(2, -2))  # at the rim of the cut fluid leaves the picture, which the source shows
    assert np.abs(source[0] - there[0]).max() < 1e-5
    # both interpolate the depth of a plane, linearly in 1/z: float32 of metres over an interval
    assert np.abs(source[1] - there[1])[inner].max() < 2e-4
    assert np.linalg.norm(source[1], axis=-1).max() > 0.3


def test_fluid_that_passes_behind_nearer_fluid_is_not_observed_and_keeps_its_own_motion() -> None:
    v = np.array([0.8, 0.0, 0.0])
    depth = plane()
    mask = np.ones(depth.shape, bool)
    flow = flow_of(v, depth)
    after = depth.copy()
    after[:, 40:44] -= 0.3  # a crest comes in front of what was seen a frame before
    _, followed = follow_depth(flow, mask, depth, after)
    end, row = np.moveaxis(CAMERA.pixel_grid() + flow, -1, 0)
    inside = (row > 1.0) & (row < 71.0)
    behind = inside & (end > 40.5) & (end < 43.5)  # both columns that are interpolated belong to the crest
    clear = inside & ((end < 39.0) | ((end > 45.0) & (end < 95.0)))
    assert not followed[behind].any()
    assert followed[clear].all()
    motion = lift_flow(flow, mask, mask, depth, after, CAMERA, INTERVAL)
    assert (motion.observed == followed.ravel()).all()
    # depth goes on along the plane, one-sided gradients at the border of the picture are exact on it: float32
    assert np.abs(motion.velocities.reshape(*mask.shape, 3)[behind] - v).max() < 0.01


def test_fluid_that_leaves_the_fluid_or_the_picture_is_not_observed() -> None:
    v = np.array([0.8, 0.0, 0.0])
    depth = plane()
    flow = flow_of(v, depth)
    mask = np.zeros(depth.shape, bool)
    mask[10:60, 10:96] = True
    after = mask.copy()
    after[10:30, 60:] = False  # dry a frame later
    motion = lift_flow(flow, mask, mask, depth, depth, CAMERA, INTERVAL, mask_t1=after)
    u, w = np.moveaxis(CAMERA.pixel_grid() + flow - 0.5, -1, 0)
    rows, cols = np.clip(np.rint(w).astype(int), 0, 71), np.clip(np.rint(u).astype(int), 0, 95)
    leaves = (u > 95.0) | ~after[rows, cols]
    observed = np.zeros(mask.shape, bool)
    observed[mask] = motion.observed
    assert not observed[mask & leaves].any()
    assert observed[30:58, 12:80].all()
    assert (mask & leaves).sum() > 300


def test_wrong_input_is_named() -> None:
    depth = plane()
    mask = np.ones(depth.shape, bool)
    d = np.zeros((*mask.shape, 2))
    with pytest.raises(ValueError, match="interval"):
        lift_flow(d, mask, mask, depth, depth, CAMERA, 0.0)
    with pytest.raises(ValueError, match="depth"):
        lift_flow(d, mask, mask, 0 * depth, depth, CAMERA, INTERVAL)
    with pytest.raises(ValueError, match="camera"):
        lift_flow(d[:10], mask[:10], mask[:10], depth[:10], depth[:10], CAMERA, INTERVAL)
