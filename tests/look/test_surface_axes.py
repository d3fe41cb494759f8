"""What falls or stands is a map over the clip's picture: places, velocities and splats go there and back."""

import numpy as np
import pytest

from fluidlift.look.surface_axes import BESIDE, PictureAxes, PlanAxes
from fluidlift.types import Gaussians, PinholeCamera, matrix_from_quat

CAMERA = PinholeCamera.looking((3.0, -4.0, 2.0), (0.0, 0.0, 0.5), fov_degrees=45.0, size=(160, 120))
DISTANCE = 5.0
AXES = PictureAxes(CAMERA, DISTANCE)


def cloud(count: int = 200, seed: int = 0) -> np.ndarray:
    """Points (m) in the picture, 3 to 7 m before the camera."""
    rng = np.random.default_rng(seed)
    return CAMERA.unproject(rng.uniform(5, [155, 115], (count, 2)), rng.uniform(3, 7, count))


def test_points_come_back_from_the_map():
    world = cloud()
    np.testing.assert_allclose(AXES.world_points(AXES.points(world)), world, atol=1e-9)  # double precision


def test_the_map_lies_as_the_picture_does():
    """Right is +X, up is +Y, nearer is higher; and a metre in the fluid's distance is a metre on the map."""
    eye = CAMERA.camera_from_world.inverse()
    middle, right, up, near = eye.points(np.array([[0, 0, 5.0], [1, 0, 5.0], [0, -1, 5.0], [0, 0, 4.0]]))
    m, r, u, n = AXES.points(np.stack([middle, right, up, near]))
    np.testing.assert_allclose([r - m, u - m, n - m], np.eye(3), atol=1e-9)
    uv = CAMERA.project(cloud())[0]
    np.testing.assert_allclose(AXES.pixels(AXES.points(cloud())), uv, atol=1e-8)


def test_velocities_are_how_points_of_the_map_move():
    world, rng = cloud(), np.random.default_rng(1)
    moving, step = rng.normal(size=world.shape), 1e-5
    there, back = AXES.points(world + 0.5 * step * moving), AXES.points(world - 0.5 * step * moving)
    # central differences: an error of the second order in 1e-5, and rounding of 1e-16 / 1e-5
    np.testing.assert_allclose(AXES.velocities(world, moving), (there - back) / step, atol=1e-8)


def test_velocities_come_back_from_the_map():
    world, moving = cloud(), np.random.default_rng(2).normal(size=(200, 3))
    back = AXES.world_velocities(AXES.points(world), AXES.velocities(world, moving))
    np.testing.assert_allclose(back, moving, atol=1e-9)


def test_what_is_in_the_picture_or_near_it_is_shown():
    width, height = CAMERA.size
    uv = np.array(
        [[80, 60], [1, 1], [-0.5 * BESIDE * width, 60], [-1.5 * BESIDE * width, 60], [80, (1 + 1.5 * BESIDE) * height]]
    )
    world = CAMERA.unproject(uv, np.full(5, 4.0))
    np.testing.assert_array_equal(AXES.shown(AXES.points(world)), [True, True, True, False, False])


def test_what_is_behind_the_camera_or_at_its_lens_is_not_shown():
    """Its mirror image would lie in the middle of the picture."""
    eye = CAMERA.camera_from_world.inverse()
    behind = eye.points(np.array([[0.0, 0.0, -3.0], [0.2, 0.1, -4.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.005 * DISTANCE]]))
    points = AXES.points(behind)
    assert np.isfinite(points).all() and not AXES.shown(points).any()
    assert np.isfinite(AXES.velocities(behind, np.ones((4, 3)))).all()


def test_splats_that_lie_on_the_map_face_the_camera():
    """Their short axis is the map's Z, which is the camera's own axis, towards it; their sizes stay."""
    points = AXES.points(cloud(20))
    flat = Gaussians(
        points.astype(np.float32), np.tile([1.0, 0, 0, 0], (20, 1)), np.tile([0.2, 0.2, 0.01], (20, 1)),
        np.full(20, 0.9), np.zeros((20, 1, 3)),
    )  # fmt: skip
    shown = AXES.world_splats(flat)
    normal = matrix_from_quat(shown.quats)[:, :, 2]
    towards = -CAMERA.camera_from_world.rotation[2]
    np.testing.assert_allclose(normal, np.broadcast_to(towards, (20, 3)), atol=1e-6)  # single precision
    assert ((CAMERA.position - shown.means) * normal).sum(axis=1).min() > 0
    np.testing.assert_array_equal(shown.scales, flat.scales)
    np.testing.assert_allclose(shown.means, cloud(20), atol=1e-5)


def test_a_splat_that_leans_on_the_map_leans_so_before_the_camera():
    """Turned by 30 degrees about the map's X, which is the camera's right, its normal leans down in the picture."""
    angle = np.radians(30.0)
    lean = Gaussians(
        np.zeros((1, 3)) + [0, 0, -5.0], [[np.cos(angle / 2), np.sin(angle / 2), 0, 0]], [[0.2, 0.2, 0.01]],
        [0.9], np.zeros((1, 1, 3)),
    )  # fmt: skip
    normal = matrix_from_quat(AXES.world_splats(lean).quats)[0, :, 2]
    seen = CAMERA.camera_from_world.rotation @ normal  # x right, y down, z forward
    # on the map (0, -sin, cos): down by the sine, towards the camera by the cosine
    np.testing.assert_allclose(seen, [0, np.sin(angle), -np.cos(angle)], atol=1e-6)


def test_the_plan_is_the_world_itself():
    world, axes = cloud(), PlanAxes()
    for found in (axes.points(world), axes.world_points(world), axes.velocities(world, world)):
        np.testing.assert_array_equal(found, world)
    assert axes.shown(world).all()
    np.testing.assert_array_equal(axes.world_velocities(world, 2 * world), 2 * world)


@pytest.mark.parametrize("depth", [3.0, 7.0])
def test_lengths_are_those_at_the_fluids_distance(depth):
    """What is nearer looks larger there as it does in the picture."""
    ends = CAMERA.camera_from_world.inverse().points(np.array([[0.0, 0.0, depth], [0.4, 0.0, depth]]))
    a, b = AXES.points(ends)
    assert np.linalg.norm(b - a) == pytest.approx(0.4 * DISTANCE / depth, rel=1e-9)
