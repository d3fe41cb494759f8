"""From one view to metres: the scale, the heading and the origin of the world."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.shape.kind import UpEvidence, level_camera
from fluidlift.shape.place import (
    STANDARD_GRAVITY,
    PlacedHeight,
    free_fall_acceleration,
    metric_scale,
    place,
    pose_up,
)
from fluidlift.shape.surface import PlaneHeight
from fluidlift.types import PinholeCamera, RigidTransform

RNG = np.random.default_rng(0)
CANONICAL = level_camera(PinholeCamera.from_fov(50.0, (160, 100)), UpEvidence(30.0, 0.0, "", 1.0))
POINTS = np.column_stack([RNG.uniform(-0.4, 0.4, 900), RNG.uniform(0.7, 1.3, 900), np.full(900, -0.6)])
STILL = np.zeros_like(POINTS)


# scale ----------------------------------------------------------------------------------------------------------


def test_a_given_size_is_the_longest_side_of_the_fluid():
    scale = metric_scale("stream", POINTS, STILL, size=12.0)
    assert scale.source == "size" and not scale.warning
    # the box leaves out 0.5 % of the points at either end
    assert scale.value * 0.8 == pytest.approx(12.0, rel=0.03)


def test_the_size_wins_over_everything_else_and_metric_depth_over_the_camera():
    assert metric_scale("stream", POINTS, STILL, size=1.0, camera_height=3.0, known_scale=2.0).source == "size"
    found = metric_scale("stream", POINTS, STILL, camera_height=3.0, known_scale=2.0)
    assert (found.source, found.value) == ("depth", 2.0)


def test_a_camera_three_metres_above_the_water_gives_the_scale():
    scale = metric_scale("stream", POINTS, STILL, camera_height=3.0)
    assert scale.source == "camera" and not scale.warning
    assert scale.value == pytest.approx(3.0 / 0.6)


def falling(acceleration, n=4000, noise=0.0):
    z = RNG.uniform(-1.0, 1.0, n)
    speed = np.sqrt(0.3**2 + 2 * acceleration * (1.0 - z)) * (1 + noise * RNG.normal(size=n))
    points = np.column_stack([RNG.uniform(-0.1, 0.1, n), np.ones(n), z])
    return points, np.column_stack([np.zeros(n), np.zeros(n), -speed])


@pytest.mark.parametrize("g", [2.0, 9.81, 40.0])
@pytest.mark.parametrize("kind", ["pour", "fall"])
def test_what_falls_with_g_units_shows_how_long_a_metre_is(g, kind):
    scale = metric_scale(kind, *falling(g))
    assert scale.source == "free fall" and not scale.warning
    # medians of v^2 over twelve layers of height are nearly exact: v^2 is linear in height
    assert scale.value == pytest.approx(STANDARD_GRAVITY / g, rel=0.02)


def test_noise_on_the_speed_hardly_moves_the_free_fall():
    found, explained = free_fall_acceleration(*falling(9.81, noise=0.1))
    # 10 % noise on v is 20 % on v^2, averaged over 300 points per layer and twelve layers: about 1 %; three times that
    assert found == pytest.approx(9.81, rel=0.04)
    assert explained > 0.95


def test_water_that_falls_at_one_speed_shows_no_gravity():
    points, velocities = falling(9.81)
    velocities[:, 2] = -2.0 * (1 + 0.05 * RNG.normal(size=len(points)))
    assert metric_scale("pour", points, velocities).source == "assumed"


def test_what_rises_does_not_fall_freely():
    points, velocities = falling(9.81)
    assert free_fall_acceleration(points, -velocities) == (0.0, 0.0)
    assert free_fall_acceleration(points[:20], velocities[:20]) == (0.0, 0.0)  # nor do a few points say anything


@pytest.mark.parametrize("kind", ["stream", "plume", "pour"])
def test_an_unknown_size_is_one_metre_and_said_so(kind):
    scale = metric_scale(kind, POINTS, STILL)
    assert scale.source == "assumed"
    assert "--size" in scale.warning
    assert scale.value * 0.8 == pytest.approx(1.0, rel=0.03)


# placement ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mainstream", [(1.0, 0, 0), (0.6, -0.8, 0), (0, 0, -1.0)], ids=["right", "oblique", "down"])
def test_points_stay_under_their_pixels(mainstream):
    to_world, camera = place(CANONICAL, POINTS, 3.7, heading=None, eye=None, mainstream=np.array(mainstream))
    before, depth = CANONICAL.project(POINTS)
    after, metres = camera.project(to_world.points(POINTS))
    # double precision
    np.testing.assert_allclose(after, before, atol=1e-8)
    np.testing.assert_allclose(metres, 3.7 * depth, rtol=1e-10)


def test_a_river_runs_along_the_x_axis_over_the_origin():
    stream = np.array([0.6, -0.8, 0.0])
    to_world, _ = place(CANONICAL, POINTS, 2.0, heading=None, eye=None, mainstream=stream)
    np.testing.assert_allclose(to_world.vectors(stream), [2.0, 0, 0], atol=1e-12)
    p = to_world.points(POINTS)
    assert p[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    # percentiles of the outermost 0.5 % set the middle
    np.testing.assert_allclose(0.5 * (p.min(0) + p.max(0))[:2], 0.0, atol=0.02)


def test_up_stays_up():
    to_world, _ = place(CANONICAL, POINTS, 2.0, heading=None, eye=None, mainstream=np.array([0.6, -0.8, 0.0]))
    np.testing.assert_allclose(to_world.vectors(np.array([0, 0, 1.0])), [0, 0, 2.0], atol=1e-12)


def surveyed(roll=0.0):
    """Four metres right, seven metres behind and three metres above the origin, its picture turned."""
    eye = np.array([4.0, -7.0, 3.0])
    straight = PinholeCamera.looking(eye, (1.0, 2.0, 0.0), 50.0, (160, 100))
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ straight.camera_from_world.rotation
    return replace(straight, camera_from_world=RigidTransform(rotation, -rotation @ eye))


@pytest.mark.parametrize("roll", [0.0, 15.0, -40.0])
def test_a_surveyed_camera_keeps_its_world(roll):
    known = surveyed(roll)
    up, heading = pose_up(known)
    assert up.roll == pytest.approx(roll)
    canonical = level_camera(known, up)
    to_world, camera = place(
        canonical, POINTS, 5.0, heading=heading, eye=known.position, mainstream=np.array([1.0, 0, 0])
    )
    np.testing.assert_allclose(camera.camera_from_world.rotation, known.camera_from_world.rotation, atol=1e-12)
    np.testing.assert_allclose(camera.position, known.position, atol=1e-12)
    np.testing.assert_allclose(to_world.points(np.zeros(3)), known.position)


@pytest.mark.parametrize(("pitch", "roll"), [(25.0, 0.0), (40.0, 8.0), (10.0, -12.0), (-5.0, 3.0)])
def test_tilt_and_roll_are_read_from_a_pose(pitch, roll):
    up, heading = pose_up(level_camera(CANONICAL, UpEvidence(pitch, roll, "", 1.0)))
    assert (up.pitch, up.roll, heading) == pytest.approx((pitch, roll, 0.0), abs=1e-9)
    assert up.confidence == 1.0


def test_a_camera_at_its_height_above_water_at_zero_puts_the_water_at_zero():
    known = surveyed()
    up, heading = pose_up(known)
    canonical = level_camera(known, up)
    scale = metric_scale("stream", POINTS, STILL, camera_height=float(known.position[2]))
    to_world, _ = place(
        canonical, POINTS, scale.value, heading=heading, eye=known.position, mainstream=np.array([1.0, 0, 0])
    )
    np.testing.assert_allclose(to_world.points(POINTS)[:, 2], 0.0, atol=1e-12)


def test_a_placed_height_lies_above_the_placed_points():
    plane = PlaneHeight((0.2, -0.1), -0.6)
    points = POINTS.copy()
    points[:, 2] = plane.height(points[:, :2])
    to_world, _ = place(CANONICAL, points, 3.0, heading=None, eye=None, mainstream=np.array([0.6, -0.8, 0.0]))
    world = to_world.points(points)
    np.testing.assert_allclose(PlacedHeight(plane, to_world).height(world[:, :2]), world[:, 2], atol=1e-12)
