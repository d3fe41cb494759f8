"""From one view to metres: the scale, the heading and the origin of the world."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.shape.heights import PlaneHeight
from fluidlift.shape.kind import level_camera
from fluidlift.shape.registration import (
    PlacedHeight,
    VelocityEvidence,
    fit_free_fall,
    metric_scale,
    place,
    pose_up,
)
from fluidlift.types import GRAVITY, PinholeCamera, RigidTransform, UpEvidence

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


def test_where_nothing_tells_the_usual_size_is_taken_and_said():
    scale = metric_scale("stream", POINTS, STILL, usual=10.0)
    assert (scale.source, scale.across) == ("assumed", 10.0) and "10 m across is assumed" in scale.warning
    assert scale.value == pytest.approx(10.0 * metric_scale("stream", POINTS, STILL).value)
    assert metric_scale("stream", POINTS, STILL, usual=10.0, size=3.0).across == 3.0


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
    assert scale.value == pytest.approx(GRAVITY / g, rel=0.02)


def test_noise_on_the_speed_hardly_moves_the_free_fall():
    found = fit_free_fall(*falling(9.81, noise=0.1))
    # 10 % noise on v, 4000 points: half a per cent; four times that
    assert found.acceleration == pytest.approx(9.81, rel=0.02)
    assert found.explained > 0.95 and not found.refusal


def test_water_that_falls_at_one_speed_shows_no_gravity():
    points, velocities = falling(9.81)
    velocities[:, 2] = -2.0 * (1 + 0.05 * RNG.normal(size=len(points)))
    assert metric_scale("pour", points, velocities).source == "assumed"


def test_what_rises_does_not_fall_freely():
    points, velocities = falling(9.81)
    for p, v in ((points, -velocities), (points[:20], velocities[:20])):  # nor do a few points say anything
        found = fit_free_fall(p, v)
        assert found.acceleration == 0.0 and "too little" in found.refusal


def filmed_fall(size, *, seed=0, outliers=0.15, noise=0.1, law=None):
    """A jet of so many metres as a camera films it, in canonical units: points, velocities, s between pictures.

    Parabolas; the displacement in the picture has 10 % noise, and a share of it is nonsense.
    """
    rng, n, start = np.random.default_rng(seed), 3000, 0.7 * np.sqrt(size)
    interval = 0.012 * np.sqrt(size)  # a share of the whole fall
    drop = rng.uniform(0, 0.6 * size, n)
    time = (-start + np.sqrt(start**2 + 2 * GRAVITY * drop)) / GRAVITY
    across = 0.03 * size * rng.uniform(-1, 1, n)

    def at(t):
        fallen = start * t + 0.5 * GRAVITY * t**2
        if law is not None:
            fallen = drop + (t - time) * law(drop / size) * np.sqrt(GRAVITY * size)
        return np.stack([across + 0.3 * start * t, np.full(n, size), 0.3 * size - fallen], axis=1) / size

    camera = level_camera(PinholeCamera.from_fov(50.0, (512, 512)), UpEvidence(8.0, 0.0, "", 1.0))
    (here, depth), (there, later) = camera.project(at(time)), camera.project(at(time + interval))
    moved = there - here
    moved += noise * np.linalg.norm(moved, axis=1, keepdims=True) * rng.normal(size=moved.shape)
    wrong = rng.uniform(size=n) < outliers
    moved[wrong] = rng.uniform(-3, 3, (int(wrong.sum()), 2))
    points = camera.unproject(here, depth)
    return points, (camera.unproject(here + moved, later) - points) / interval, interval


@pytest.mark.parametrize("size", [0.2, 1.0, 5.0, 30.0])
@pytest.mark.parametrize("outliers", [0.0, 0.15, 0.3])
def test_a_filmed_fall_of_known_size_comes_out_in_its_interval(size, outliers):
    points, velocities, interval = filmed_fall(size, outliers=outliers)
    found = metric_scale("pour", points, velocities, seen=VelocityEvidence(interval=interval))
    assert found.source == "free fall" and not found.warning
    # the points were made in units of the size; 95 % are 1.96 standard errors
    assert abs(found.value / size - 1.0) < 1.96 * found.relative_error * found.value / size
    assert found.relative_error < 0.04  # of which 3 % stand for what the law leaves out
    assert "from free fall, ± " in found.sentence


def test_the_standard_error_of_a_fall_is_the_scatter_over_repetitions():
    falls = []
    for seed in range(24):
        points, velocities, interval = filmed_fall(1.0, seed=seed)
        falls.append(fit_free_fall(points, velocities, seen=VelocityEvidence(interval=interval)))
    value, error = (np.array([getattr(f, n) for f in falls]) for n in ("acceleration", "standard_error"))
    # the deviation of 24 numbers is known to 15 %, and each error, from twelve bands, to 20 %
    assert np.std(value) == pytest.approx(np.median(error), rel=0.4)
    assert value.mean() == pytest.approx(GRAVITY, rel=0.004)  # three errors of the mean
    assert (np.abs(value - GRAVITY) < 1.96 * error).mean() > 0.8  # 19 of 20, less two deviations of 24 throws


def test_a_frame_between_two_pictures_is_no_lag():
    """Velocities from pictures are means over the interval: taken at its start, gravity would seem larger."""
    points, velocities, interval = filmed_fall(1.0, noise=0.0, outliers=0.0)
    at_middle = fit_free_fall(points, velocities, seen=VelocityEvidence(interval=interval))
    # straight bands through a law that is exact
    assert at_middle.acceleration == pytest.approx(GRAVITY, rel=1e-3)


@pytest.mark.parametrize(
    ("law", "word"),
    [
        (lambda d: 0.5 * np.ones_like(d), "faster"),  # a film that has reached its speed
        (lambda d: 0.1 + 2.5 * d, "held"),  # a viscous thread: v grows with the drop itself, not with its root
        (lambda d: np.sqrt(0.2 + 2 * np.minimum(d, 0.2)), "stops"),  # air, or a flow that follows no further
    ],
    ids=["film", "thread", "saturated"],
)
def test_a_fall_that_something_holds_back_gives_no_scale(law, word):
    points, velocities, interval = filmed_fall(1.0, law=law)
    found = metric_scale("pour", points, velocities, seen=VelocityEvidence(interval=interval))
    assert found.source == "assumed" and word in found.refusal
    assert "--size" in found.warning and found.refusal in found.warning


def test_a_jet_seen_from_above_says_less_about_its_drop():
    points, velocities, interval = filmed_fall(1.0)
    level, steep = (
        metric_scale("pour", points, velocities, seen=VelocityEvidence(interval=interval, pitch=p)) for p in (0.0, 45.0)
    )
    assert level.value == steep.value
    # eight degrees more or less at 45 degrees: 14 % of the height
    assert steep.relative_error == pytest.approx(np.hypot(level.relative_error, np.radians(8.0)), rel=1e-6)


def test_a_pool_below_the_jet_does_not_fall():
    points, velocities, interval = filmed_fall(1.0)
    pool = RNG.uniform([-0.4, 1.0, -0.6], [0.4, 1.0, -0.31], (6000, 3))
    stirred = 0.3 * RNG.normal(size=pool.shape)
    found = metric_scale(
        "pour", np.vstack([points, pool]), np.vstack([velocities, stirred]), seen=VelocityEvidence(interval=interval)
    )
    assert abs(found.value - 1.0) < 1.96 * found.relative_error


def test_distrusted_points_do_not_count():
    points, velocities, interval = filmed_fall(1.0, outliers=0.0)
    trust = np.ones(len(points))
    trust[:2000], velocities[:2000] = 0.0, 0.1 * velocities[:2000]
    found = metric_scale("fall", points, velocities, seen=VelocityEvidence(trust, interval))
    assert abs(found.value - 1.0) < 1.96 * found.relative_error


def test_where_the_scale_comes_from_has_an_order():
    """Size, metric depth, surveyed camera, free fall, one metre."""
    points, velocities, interval = filmed_fall(5.0)
    points = points - [0.0, 0.0, 1.0]  # below a camera at zero
    sources = []
    options = {"size": 3.0, "known_scale": 4.0, "camera_height": 6.0}
    while True:
        found = metric_scale("fall", points, velocities, seen=VelocityEvidence(interval=interval), **options)
        sources.append(found.source)
        if not options:
            break
        options.pop(next(iter(options)))
    assert sources == ["size", "depth", "camera", "free fall"]
    assert metric_scale("stream", points, velocities, seen=VelocityEvidence(interval=interval)).source == "assumed"


def test_a_size_that_the_camera_contradicts_is_taken_and_said_so():
    said = metric_scale("stream", POINTS, STILL, size=12.0, camera_height=3.0)  # the camera: 4 m
    assert said.source == "size" and "camera" in said.warning and "--size" in said.warning
    assert not metric_scale("stream", POINTS, STILL, size=4.2, camera_height=3.0).warning


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
