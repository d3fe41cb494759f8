"""The slope of a stream and the tilt of the camera, from exact motion on planes."""

import numpy as np
import pytest

from fluidlift.shape.energy_line import Channel, energy_profile
from fluidlift.shape.heights import ProfileAlongHeight
from fluidlift.shape.kind import level_camera
from fluidlift.shape.slope import (
    LEVEL,
    STEEP,
    STEEP_RIVER,
    SlopePrior,
    estimate_slope,
    estimate_tilt,
    flow_patches,
    plane_axes,
    steepness,
)
from fluidlift.shape.surface import stream_surface
from fluidlift.shape.view import PictureEvidence, sky_of
from fluidlift.types import PinholeCamera, UpEvidence

SIZE = (128, 96)


def tilted(pitch, roll=0.0, fov=50.0):
    return level_camera(PinholeCamera.from_fov(fov, SIZE), UpEvidence(pitch, roll, "", 1.0))


def film(slope, heading, pitch, profile=0.0):
    """Exact image motion of a straight stream on a plane: camera, mask, px per frame. Its speed over the width is
    1 - profile s^2."""
    camera = tilted(pitch)
    axes = plane_axes(np.radians(slope), np.radians(heading))
    grid = camera.pixel_grid()
    rays = camera.rays(grid)
    middle = camera.rays(np.array(SIZE) / 2)
    facing = -rays @ axes[2]
    depth = np.where(facing > 0.05, -(middle @ axes[2]) / np.maximum(facing, 0.05), 0.0)
    points = rays * depth[..., None]
    along, across = ((points - middle) @ a for a in axes[:2])
    mask = (facing > 0.1) & (np.abs(across) < 0.22) & (np.abs(along) < 0.45)
    velocity = 0.02 * (1 - profile * (across / 0.22) ** 2)[..., None] * axes[0]
    later, _ = camera.project(np.where(mask[..., None], points + velocity, middle))
    return camera, mask, np.where(mask[..., None], later - grid, 0.0)


def evidence_of(camera, mask, motion, **options):
    return estimate_slope(camera, flow_patches(mask, motion, np.ones(mask.shape)), **options)


@pytest.mark.parametrize(("slope", "heading", "pitch"), [(20.0, -20.0, 30.0), (30.0, 200.0, 45.0), (15.0, -60.0, 40.0)])
@pytest.mark.parametrize("profile", [0.0, 0.75], ids=["plug", "parabola"])
def test_the_perspective_of_a_film_shows_how_steep_it_runs(slope, heading, pitch, profile):
    found = evidence_of(*film(slope, heading, pitch, profile))
    assert found.level_share < 0.5
    # slopes are tried in steps of 2 degrees and the prior pulls towards level; twice its own standard error at most
    assert abs(found.slope - slope) < max(4.0, 2.0 * found.standard_error)
    assert found.slope == pytest.approx(slope, abs=10.0)  # far from level


@pytest.mark.parametrize("turn", [-6.0, 6.0])
@pytest.mark.parametrize(("slope", "heading", "pitch"), [(20.0, -20.0, 30.0), (30.0, 200.0, 45.0)])
def test_a_mean_motion_that_is_a_little_off_does_not_turn_the_film(slope, heading, pitch, turn):
    camera, mask, motion = film(slope, heading, pitch, 0.75)
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    found = evidence_of(camera, mask, motion @ np.array([[c, s], [-s, c]]))
    # the vanishing point says where it runs to: headings that fit the mean motion alone are 8 to 14 degrees off
    assert abs(found.heading % 360.0 - heading % 360.0) < 5.0
    assert found.slope == pytest.approx(slope, abs=5.0)  # the turn itself is 6


@pytest.mark.parametrize("pitch", [25.0, 40.0, 55.0])
def test_a_level_stream_stays_level(pitch):
    found = evidence_of(*film(0.0, -20.0, pitch, 0.5))
    assert found.slope == 0.0
    assert found.level_share > 0.5


@pytest.mark.parametrize("slope", [13.0, 21.0])
def test_the_heading_belongs_to_the_slope_that_is_taken(slope):
    camera, mask, motion = film(slope, -20.0, 31.0, 0.75)
    found = evidence_of(camera, mask, motion)
    axes = plane_axes(np.radians(found.slope), np.radians(found.heading))
    middle = np.argwhere(mask).mean(axis=0)[::-1] + 0.5
    ray = camera.rays(middle)
    start = ray / -(ray @ axes[2])
    ends, _ = camera.project(np.stack([start - 1e-3 * axes[0], start + 1e-3 * axes[0]]))
    shown, seen = ends[1] - ends[0], motion[mask].mean(axis=0)
    turned = np.degrees(np.arctan2(shown[0] * seen[1] - shown[1] * seen[0], shown @ seen))
    # the middle of the pixels is not quite where the mean motion is seen; the neighbouring slope's heading is off by 1
    assert abs(turned) < 0.4


@pytest.mark.parametrize("slope", [0.0, 10.0])
def test_where_level_streams_are_rare_less_evidence_makes_a_slope(slope):
    scene = film(slope, -20.0, 31.0, 0.75)
    usual, rare = evidence_of(*scene), evidence_of(*scene, prior=SlopePrior(level=0.1))
    odds = [(1 - e.level_share) / e.level_share for e in (usual, rare)]
    assert odds[1] / odds[0] == pytest.approx((0.9 / 0.1) / (0.4 / 0.6))
    assert rare.likeliest == pytest.approx(usual.likeliest)


def test_under_the_open_sky_a_channel_is_hardly_steeper_than_a_cascade():
    """The same motion: a film that is filmed from near may fall by 30 degrees, a river does not."""
    scene = film(30.0, -20.0, 31.0, 0.75)
    near, river = (evidence_of(*scene, prior=SlopePrior(steep=s)) for s in (STEEP, STEEP_RIVER))
    assert river.likeliest < near.likeliest and river.slope <= near.slope
    assert steepness(PictureEvidence()) == STEEP
    assert steepness(PictureEvidence(sky=sky_of(np.arange(96)[:, None] < np.full(128, 20)))) == STEEP_RIVER


def test_ripples_that_each_move_their_own_way_say_little_of_a_slope():
    """Motion of each piece as large as the mean, in any direction: what is left is near the prior, either way. Were
    such noise not reckoned with, one of these four would be level with a probability of 0.02, one of 0.99."""
    camera, mask, motion = film(0.0, -20.0, 12.0, 0.75)
    usual = np.linalg.norm(motion[mask], axis=-1).mean()
    for seed in range(4):
        coarse = np.random.default_rng(seed).normal(0.0, usual, (12, 16, 2))
        ripples = np.repeat(np.repeat(coarse, 8, axis=0), 8, axis=1)
        found = evidence_of(camera, mask, np.where(mask[..., None], motion + ripples, motion))
        odds = (1.0 - found.level_share) / found.level_share * LEVEL / (1.0 - LEVEL)
        assert 1.0 / 20.0 < odds < 20.0


def test_where_level_streams_are_rare_less_of_the_tilt_is_the_cameras():
    _, mask, motion = film(15.0, -60.0, 31.0, 0.75)
    patches = flow_patches(mask, motion, np.ones(mask.shape))
    assert patches is not None
    usual, rare = (estimate_tilt(patches, tilted, PictureEvidence(), p) for p in (0.6, 0.1))
    assert rare.pitch < usual.pitch - 5.0


def test_without_motion_a_stream_is_level_and_says_why():
    found = estimate_slope(tilted(30.0), None)
    assert (found.slope, found.level_share) == (0.0, 1.0)
    assert found.source.startswith("prior")


def test_under_an_estimated_tilt_the_slope_is_the_mean_over_both_models():
    scene = film(8.0, 0.0, 35.0, 0.75)
    found, sure = evidence_of(*scene, tilt_known=False), evidence_of(*scene)
    assert found.slope == pytest.approx((1 - sure.level_share) * sure.likeliest)


def test_a_uniform_stream_towards_the_viewer_shows_the_tilt_better_than_the_prior():
    _, mask, motion = film(0.0, -60.0, 25.0)
    patches = flow_patches(mask, motion, np.ones(mask.shape))
    assert patches is not None
    found = estimate_tilt(patches, tilted, PictureEvidence())
    assert abs(found.pitch - 25.0) < 7.5  # half of the prior's error
    assert found.pitch_error < 13.0
    assert 0.0 < found.gained <= 1.0


def test_a_stream_across_the_view_leaves_the_tilt_to_the_prior():
    # its streamlines stay parallel in the picture at any pitch; a profile across it looks like a little perspective
    _, mask, motion = film(0.0, 0.0, 40.0, 0.75)
    patches = flow_patches(mask, motion, np.ones(mask.shape))
    assert patches is not None
    found = estimate_tilt(patches, tilted, PictureEvidence())
    without = estimate_tilt(None, tilted, PictureEvidence())
    assert abs(found.pitch - without.pitch) < 6.5  # a quarter of the prior's error
    assert found.pitch_error > 0.5 * without.pitch_error  # straight from above there would be no perspective at all


def test_frictionless_water_that_speeds_up_falls_by_its_gain_of_velocity_head():
    along = np.linspace(0.0, 10.0, 200)
    speed = 1.0 + 0.2 * along
    # a channel so wide, and so deep, that it has no friction
    run, fall = energy_profile(along, speed, np.ones(200), Channel(1e6, 0.0))
    # Bernoulli; slices take the middle of their speeds, so the ends are known to a twentieth of the way
    expected = ((1 + 0.2 * run[-1]) ** 2 - (1 + 0.2 * run[0]) ** 2) / (2 * 9.81)
    assert fall[-1] == pytest.approx(expected, rel=0.15)
    assert (np.diff(fall) >= 0).all()


def test_uniform_water_falls_as_manning_says():
    along = np.linspace(0.0, 10.0, 200)
    run, fall = energy_profile(along, np.ones(200), np.ones(200), Channel(5.0, 0.0))
    radius = 0.6 * 0.2 * 5.0
    gradient = (0.035 * 0.85) ** 2 / radius ** (4 / 3)
    np.testing.assert_allclose(fall, gradient * (run - run[0]), rtol=1e-6, atol=1e-9)


def test_water_that_slows_down_does_not_rise():
    along = np.linspace(0.0, 10.0, 200)
    _, fall = energy_profile(along, 3.0 - 0.2 * along, np.ones(200), Channel(1e6, 0.0))
    assert (np.diff(fall) >= 0).all()


def test_a_stream_surface_lies_on_the_plane_that_was_filmed():
    camera, mask, motion = film(22.0, -20.0, 31.0, 0.75)
    front = stream_surface(camera, mask, motion, np.ones(mask.shape), 0.04)
    normal = plane_axes(np.radians(22.0), np.radians(-20.0))[2]
    true = 1.0 / np.maximum(-camera.rays(camera.pixel_grid()) @ normal, 1e-3)
    ratio = front.depth[mask] / true[mask]
    error = np.abs(ratio / np.median(ratio) - 1.0)
    # a level plane is off by more than this in the middle of the pixels
    assert np.median(error) < 0.03
    assert front.slope is not None and front.slope.slope > 0


def test_bent_by_its_energy_a_film_is_as_steep_over_the_ground_as_its_plane():
    camera, mask, motion = film(22.0, -20.0, 31.0, 0.75)
    trust = np.ones(mask.shape)
    plane = stream_surface(camera, mask, motion, trust, 0.04)
    # slow: its velocity heads are nothing
    bent = stream_surface(camera, mask, motion, trust, 0.04, camera_height=0.02)
    assert plane.slope is not None and bent.slope is not None
    assert bent.slope.slope == pytest.approx(plane.slope.slope, abs=0.3)  # 1.4 less, if taken over the way along it


def test_a_profile_along_a_stream_goes_straight_on_and_is_level_across():
    model = ProfileAlongHeight((0.0, 1.0), np.array([0.0, 1.0, 2.0]), np.array([0.0, -0.1, -0.4]))
    xy = np.array([[0.0, 0.5], [7.0, 0.5], [0.0, -1.0], [0.0, 3.0]])
    np.testing.assert_allclose(model.height(xy), [-0.05, -0.05, 0.1, -0.7])
