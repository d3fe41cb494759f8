"""From px/frame to m/s on a plane that moves as known."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.motion.lift import depth_change, lift_flow
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


def test_stride_thins_the_points_and_observed_goes_along() -> None:
    depth = plane()
    mask = np.ones(depth.shape, bool)
    observed = np.zeros_like(mask)
    observed[:, :48] = True
    d = np.zeros((*mask.shape, 2), np.float32)
    motion = lift_flow(d, observed, mask, depth, depth, CAMERA, INTERVAL, stride=2)
    assert len(motion.points) == 36 * 48
    assert (motion.observed.reshape(36, 48) == observed[::2, ::2]).all()
    assert np.abs(motion.velocities).max() < 1e-3


def test_depth_change_is_what_the_material_gains() -> None:
    v = np.array([0.0, 1.0, 0.0])
    depth = plane()
    mask = np.ones(depth.shape, bool)
    gained = CAMERA.camera_from_world.vectors(v)[2] * INTERVAL
    change = depth_change(flow_of(v, depth), mask, depth, depth)
    assert np.abs(change[8:-8, 8:-8] - gained).max() < 0.02 * abs(gained)


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
