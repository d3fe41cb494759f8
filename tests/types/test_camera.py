"""The pinhole camera: projection and its reverse, picture sizes, poses, JSON."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fluidlift.errors import InputRejected
from fluidlift.types import PinholeCamera, RigidTransform

LOOK = PinholeCamera.looking((3.0, -4.0, 2.0), (0.2, 0.1, 0.3), 45.0, (120, 80))


def test_a_point_on_the_axis_appears_at_the_centre_of_the_picture():
    camera = PinholeCamera.from_fov(60, (100, 50))
    uv, z = camera.project(np.array([[0.0, 0.0, 7.0]]))
    np.testing.assert_allclose(uv, [[50, 25]])
    np.testing.assert_allclose(z, [7])


def test_right_in_the_world_is_right_and_down_is_down():
    uv, _ = PinholeCamera.from_fov(60, (100, 50)).project(np.array([[1.0, 0.5, 7.0]]))
    assert uv[0, 0] > 50 and uv[0, 1] > 25


def test_the_field_of_view_spans_the_longer_side():
    for size in ((100, 50), (50, 100)):
        camera = PinholeCamera.from_fov(60, size)
        edge = np.tan(np.radians(30))  # half the field of view, at unit depth
        along = np.array([[edge, 0, 1.0]]) if size[0] > size[1] else np.array([[0, edge, 1.0]])
        uv, _ = camera.project(along)
        assert uv.max() == pytest.approx(100)


def test_pixel_centres_lie_half_a_pixel_from_the_corner():
    grid = PinholeCamera.from_fov(60, (4, 3)).pixel_grid()
    assert grid.shape == (3, 4, 2)
    np.testing.assert_allclose(grid[0, 0], [0.5, 0.5])
    np.testing.assert_allclose(grid[2, 3], [3.5, 2.5])


@given(
    arrays(np.float64, (6, 2), elements=st.floats(-50, 200)),
    arrays(np.float64, 6, elements=st.floats(0.05, 50)),
)
def test_unprojected_pixels_project_back_to_themselves(uv, depth):
    back, z = LOOK.project(LOOK.unproject(uv, depth))
    # double precision: positions of up to 100 m over depths from 0.05 m, times 150 px
    np.testing.assert_allclose(back, uv, atol=1e-8)
    np.testing.assert_allclose(z, depth, rtol=1e-9)


def test_depth_is_along_the_axis_not_along_the_ray():
    forward = LOOK.camera_from_world.rotation[2]
    corner = LOOK.unproject(np.array([0.0, 0.0]), 5.0)
    assert (corner - LOOK.position) @ forward == pytest.approx(5.0)
    assert np.linalg.norm(corner - LOOK.position) > 5.0


def test_points_behind_the_camera_keep_a_negative_depth():
    behind = LOOK.position - LOOK.camera_from_world.rotation[2]
    uv, z = LOOK.project(behind[None])
    assert z[0] == pytest.approx(-1.0)
    assert np.isfinite(uv).all()
    assert np.isfinite(LOOK.project(LOOK.position[None])[0]).all()  # nor does its own centre divide by zero


@pytest.mark.parametrize("size", [(60, 40), (240, 160), (90, 80)])
def test_a_resized_camera_sees_the_same_view(size):
    small = LOOK.resized(size)
    x = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    uv, z = LOOK.project(x)
    uv_small, z_small = small.project(x)
    assert small.size == size
    np.testing.assert_allclose(uv_small, uv * np.array(size) / LOOK.size, atol=1e-10)
    np.testing.assert_allclose(z_small, z)


def test_looking_puts_the_target_in_the_middle_and_up_above_it():
    target = np.array([0.2, 0.1, 0.3])
    uv, z = LOOK.project(np.stack([target, target + [0, 0, 0.1]]))
    np.testing.assert_allclose(uv[0], [60, 40], atol=1e-9)
    assert z[0] == pytest.approx(np.linalg.norm(target - [3, -4, 2]))
    np.testing.assert_allclose(uv[1, 0], 60, atol=1e-9)  # the vertical stays vertical in the picture
    assert uv[1, 1] < 40
    np.testing.assert_allclose(LOOK.position, [3, -4, 2], atol=1e-12)


@pytest.mark.parametrize("down", [1.0, -1.0])
def test_looking_straight_up_or_down_is_no_singularity(down):
    camera = PinholeCamera.looking((1.0, 2.0, down), (1.0, 2.0, 0.0), 45.0, (64, 64))
    np.testing.assert_allclose(camera.camera_from_world.rotation[2], [0, 0, -down], atol=1e-12)


def test_the_camera_file_gives_the_same_camera_back():
    data = json.loads(json.dumps(LOOK.to_dict()))
    back = PinholeCamera.from_dict(data)
    x = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    np.testing.assert_array_equal(back.project(x)[0], LOOK.project(x)[0])


def test_a_camera_file_without_pose_sits_at_the_origin():
    data = {k: v for k, v in LOOK.to_dict().items() if k in ("width", "height", "K")}
    camera = PinholeCamera.from_dict(data)
    np.testing.assert_array_equal(camera.position, np.zeros(3))
    np.testing.assert_array_equal(camera.camera_from_world.rotation, np.eye(3))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"K": None}, "K"), ({"K": [[1, 2], [3, 4]]}, "K"), ({"width": "wide"}, "width"), ({"width": 0}, "width"),
        ({"R": np.diag([1, 1, -1]).tolist()}, "R"), ({"t": [0, 0]}, "t"), ({"K": np.diag([-5, 5, 1]).tolist()}, "K"),
        ({"K": [[float("nan"), 0, 1], [0, 2, 1], [0, 0, 1]]}, "K"),
    ],
)  # fmt: skip
def test_a_camera_file_that_makes_no_sense_is_rejected_with_what_is_needed(change, word):
    data = LOOK.to_dict() | change
    with pytest.raises(InputRejected) as caught:
        PinholeCamera.from_dict({k: v for k, v in data.items() if v is not None})
    assert word in caught.value.needed


def test_impossible_cameras_are_refused():
    with pytest.raises(ValueError, match="focal"):
        PinholeCamera((0.0, 1.0), (1, 1), (2, 2))
    with pytest.raises(ValueError, match="size"):
        PinholeCamera((1.0, 1.0), (1, 1), (0, 2))
    with pytest.raises(ValueError, match="field of view"):
        PinholeCamera.from_fov(180, (2, 2))
    with pytest.raises(ValueError, match="same point"):
        PinholeCamera.looking((1, 1, 1), (1, 1, 1), 40, (2, 2))


def test_the_position_is_where_all_rays_start():
    pose = RigidTransform(LOOK.camera_from_world.rotation, np.array([0.3, -0.2, 4.0]))
    camera = PinholeCamera((50.0, 60.0), (10.0, 12.0), (32, 24), pose)
    np.testing.assert_allclose(pose.points(camera.position), 0, atol=1e-12)


@pytest.mark.parametrize("shape", [(3,), (0, 3), (7, 3), (4, 5, 3)], ids=str)
def test_points_of_any_shape_are_projected_as_each_alone(shape):
    camera = PinholeCamera.looking((0.3, -3.0, 1.2), (0.0, 0.0, 0.0), 50.0, (64, 48))
    points = np.random.default_rng(0).normal(0.0, 2.0, shape)
    if points.size > 12:
        points.reshape(-1, 3)[:3] = [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, -9.0, 1.0]]  # the last lies behind
    with np.errstate(invalid="ignore"):
        uv, depth = camera.project(points)
        row, column, same = camera.nearest_pixels(points)
    assert uv.shape == (*shape[:-1], 2) and depth.shape == row.shape == column.shape == shape[:-1]
    np.testing.assert_array_equal(same, depth)
    pose, (fx, fy), (cx, cy) = camera.camera_from_world, camera.focal, camera.center
    for place in np.ndindex(shape[:-1]):
        with np.errstate(invalid="ignore"):
            x, y, z = pose.rotation @ points[place] + pose.translation
            plain = np.array([fx * x / z + cx, fy * y / z + cy])
        np.testing.assert_allclose(uv[place], plain, rtol=1e-12)
        seen = np.nan_to_num(plain, posinf=1e9, neginf=-1e9) if z > 0 else np.zeros(2)
        assert column[place] == int(np.clip(seen[0], 0, 63)) and row[place] == int(np.clip(seen[1], 0, 47))


def test_rays_are_those_of_the_pixels_on_the_cameras_axes():
    camera = PinholeCamera.looking((0.3, -3.0, 1.2), (0.0, 0.0, 0.0), 50.0, (64, 48))
    rays = camera.rays(camera.pixel_grid())
    assert rays.shape == (48, 64, 3) and rays.flags.c_contiguous
    ahead = rays @ camera.camera_from_world.rotation.T
    np.testing.assert_allclose(ahead[..., 2], 1.0, rtol=1e-12)
    np.testing.assert_allclose(ahead[..., 0] * camera.focal[0] + camera.center[0], camera.pixel_grid()[..., 0])
