"""A body from elsewhere lands where its camera saw it."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.shape.external_body import canonical_from_given, into_view, near_and_far
from fluidlift.types import Gaussians, PinholeCamera

CENTRE, RADIUS = np.array([3.0, -2.0, 1.0]), 0.5


def ball(n=6000):
    direction = np.random.default_rng(0).normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Gaussians.isotropic(CENTRE + RADIUS * direction, 0.02, np.full((n, 3), 0.5))


def camera():
    return PinholeCamera.looking(CENTRE + np.array([2.0, -1.0, 0.8]), CENTRE, 40, (96, 64))


def test_the_canonical_camera_is_at_the_origin_looks_along_y_and_sees_the_body_at_depth_one():
    body, cam = ball(), camera()
    canonical = canonical_from_given(cam, body)
    eye = canonical.points(cam.position[None])[0]
    np.testing.assert_allclose(eye, 0, atol=1e-9)
    middle = canonical.points(CENTRE[None])[0]
    assert abs(middle[0]) < 1e-9 and middle[1] > 0
    distance = np.linalg.norm(CENTRE - cam.position)
    # the median depth of the ball's points is that of its centre, up to sampling
    assert np.linalg.norm(middle) == pytest.approx(1.0, rel=0.02)
    assert canonical.scale == pytest.approx(1.0 / distance, rel=0.02)


def test_near_and_far_sides_are_a_diameter_apart_in_the_middle():
    body, cam = ball(), camera()
    uv, _ = cam.project(body.means)
    inside = np.linalg.norm(cam.pixel_grid() - np.array(cam.center), axis=-1) < 15
    near, far = near_and_far(body, cam, inside)
    distance = np.linalg.norm(CENTRE - cam.position)
    row, col = 32, 48
    # points scattered over the sphere and the filter of a few pixels: 3 % of the distance
    assert near[row, col] == pytest.approx(distance - RADIUS, rel=0.03)
    assert far[row, col] == pytest.approx(distance + RADIUS, rel=0.03)
    assert (near[~inside] == 0).all() and len(uv) == len(body)


def test_a_body_beside_the_mask_is_rejected():
    corner = np.zeros((64, 96), bool)
    corner[:10, :10] = True
    with pytest.raises(InputRejected, match="cover"):
        near_and_far(ball(), camera(), corner)


def test_a_camera_that_looks_away_is_rejected():
    cam = camera()
    away = PinholeCamera.looking(cam.position, 2 * cam.position - CENTRE, 40, (96, 64))
    with pytest.raises(InputRejected, match="behind"):
        canonical_from_given(away, ball())


def wide(fov, centre, size=(96, 64)):
    """A level camera at the origin with its principal point anywhere."""
    from dataclasses import replace

    return replace(PinholeCamera.looking(np.zeros(3), np.array([0.0, 1.0, 0.0]), fov, size), center=centre)


def test_a_body_seen_by_the_same_kind_of_camera_keeps_every_pixel():
    body, cam = ball(), camera()
    from dataclasses import replace

    view = replace(wide(40, cam.center), focal=cam.focal)
    moved = body.transformed(into_view(body.means, cam, view, depth=3.0))
    before, z = cam.project(body.means)
    after, depth = view.project(moved.means)
    np.testing.assert_allclose(after, before, atol=1e-3)  # float32 positions
    assert np.median(depth) == pytest.approx(3.0, rel=1e-5)
    np.testing.assert_allclose(depth / z, 3.0 / np.median(z), rtol=1e-5)


@pytest.mark.parametrize(("fov", "centre"), [(25, (48.0, 32.0)), (60, (48.0, 32.0)), (40, (20.0, 50.0))])
def test_a_body_of_a_camera_of_another_kind_keeps_its_place_its_size_and_its_side(fov, centre):
    small = ball()
    shrunk = Gaussians(
        (CENTRE + 0.1 * (small.means - CENTRE)).astype(np.float32), small.quats, small.scales, small.opacities, small.sh
    )
    cam = camera()
    view = wide(fov, centre)
    moved = shrunk.transformed(into_view(shrunk.means, cam, view))
    before, z = cam.project(shrunk.means)
    after, depth = view.project(moved.means)
    # 0.05 across at a distance of 2.4: weak perspective is right to 2 % of its 4 px, off the axis to a few more
    np.testing.assert_allclose(after, before, atol=0.25)
    # the median of each coordinate is no longer that of a turned body: a small part of its size of 0.04
    assert np.median(depth) == pytest.approx(1.0, abs=0.002)
    assert np.corrcoef(z, depth)[0, 1] > 0.95  # what was in front is in front


def test_pictures_of_another_size_count_as_the_same_view():
    body, cam = ball(), camera()
    once = into_view(body.means, cam, wide(40, (48.0, 32.0)))
    twice = into_view(body.means, cam.resized((192, 128)), wide(40, (48.0, 32.0)))
    np.testing.assert_allclose(twice.points(body.means), once.points(body.means), atol=1e-9)


def test_a_body_behind_the_camera_that_came_with_it_is_rejected():
    cam = camera()
    away = PinholeCamera.looking(cam.position, 2 * cam.position - CENTRE, 40, (96, 64))
    with pytest.raises(InputRejected, match="behind"):
        into_view(ball().means, away, wide(40, (48.0, 32.0)))
