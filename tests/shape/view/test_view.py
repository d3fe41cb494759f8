"""What pictures say of the camera's tilt: sky, the upper end of water, plumb lines."""

import cv2
import numpy as np
import pytest

from fluidlift.shape.kind import estimate_up, level_camera
from fluidlift.shape.view import PictureEvidence, look_at
from fluidlift.shape.view.horizon import elevation, farthest_elevation, skyline, skyline_evidence, upper_outline
from fluidlift.shape.view.plumb import plumb_evidence, plumb_lines
from fluidlift.types import PinholeCamera, UpEvidence, kind_of
from fluidlift.types.kind import STREAM

SIZE = (320, 200)
CAMERA = PinholeCamera.from_fov(50.0, SIZE)
PITCHES = np.arange(-20.0, 71.0, 2.0)


def tilted(pitch, roll=0.0):
    return level_camera(CAMERA, UpEvidence(pitch, roll, "", 1.0))


def landscape(pitch, hills=3.0, shore=8.0, roll=0.0):
    """Sky above hills that many degrees high, textured banks, water that begins `shore` degrees below the horizon."""
    above = elevation(tilted(pitch, roll), CAMERA.pixel_grid().reshape(-1, 2)).reshape(SIZE[::-1])
    rng = np.random.default_rng(3)
    ground = cv2.GaussianBlur(rng.uniform(20, 130, (*SIZE[::-1], 3)).astype(np.float32), (0, 0), 1.5)
    sky = np.array([205.0, 215.0, 235.0]) - 0.5 * above[..., None]
    water = above < -shore
    picture = np.where((above > hills)[..., None], sky, ground)
    return np.clip(picture, 0, 255).astype(np.uint8), water


def share_of(log):
    share = np.exp(log - log.max())
    return share / share.sum()


def log_of(found, pitches=PITCHES):
    return np.array([found(tilted(p)) for p in pitches])


def test_the_sky_keeps_the_horizon_below_it():
    picture, water = landscape(12.0)
    sky = skyline(picture, water)
    assert sky is not None
    assert np.median(elevation(tilted(12.0), sky.border)) == pytest.approx(3.0, abs=1.0)
    share = share_of(log_of(lambda c: skyline_evidence(c, sky)))
    assert share[PITCHES > 12.0 + 3.0 + 4.0].sum() < 0.1  # the horizon would stand in the sky
    assert abs(PITCHES[np.argmax(share)] - 12.0 - 3.0) < 3.0  # its likeliest place is at the skyline's foot


@pytest.mark.parametrize("change", ["dark", "water", "flat"])
def test_a_dark_wall_water_and_an_even_picture_are_no_sky(change):
    picture, water = landscape(12.0)
    if change == "dark":
        picture[~water & (picture[..., 2] > 180)] = 15
    elif change == "water":
        water = np.ones_like(water)
    else:
        picture[:] = 200
    assert skyline(picture, water) is None


def test_what_was_mistaken_for_sky_cannot_rule_anything_out():
    picture, water = landscape(12.0)
    sky = skyline(picture, water)
    assert sky is not None
    log = log_of(lambda c: skyline_evidence(c, sky))
    assert log.max() - log.min() < 7.0  # a factor of 1000 at most, which motion and plumb lines can outweigh


def test_the_farthest_water_is_seen_below_the_horizon_by_what_it_is():
    _, water = landscape(12.0, shore=8.0)
    assert farthest_elevation(tilted(12.0), upper_outline(water)) == pytest.approx(-8.0, abs=0.5)


def posts(pitch, roll, count=14, lean=0.0):
    """A picture of vertical posts, and their number."""
    camera, picture = tilted(pitch, roll), np.full((*SIZE[::-1], 3), 150, np.uint8)
    rng = np.random.default_rng(5)
    for x in np.linspace(-1.6, 1.6, count):
        foot = np.array([x, 3.0, -3.0 * np.tan(np.radians(pitch)) - 0.5])
        head = foot + [lean * rng.normal(), 0.0, 1.0]
        ends, z = camera.project(np.stack([foot, head]))
        assert (z > 0).all()
        (u0, v0), (u1, v1) = np.round(ends * 16).astype(int)
        cv2.line(picture, (int(u0), int(v0)), (int(u1), int(v1)), (30, 40, 35), 3, cv2.LINE_AA, 4)
    return picture


@pytest.mark.parametrize(("pitch", "roll"), [(10.0, 0.0), (30.0, 3.0), (45.0, -4.0)])
def test_posts_show_pitch_and_roll(pitch, roll):
    lines = plumb_lines(posts(pitch, roll), np.ones(SIZE[::-1], bool))
    assert lines is not None
    rolls = np.arange(-6.0, 7.0, 1.0)
    log = np.array([[plumb_evidence(tilted(p, r), lines) for r in rolls] for p in PITCHES])
    i, j = np.unravel_index(np.argmax(log), log.shape)
    assert PITCHES[i] == pytest.approx(pitch, abs=2.5)
    assert rolls[j] == pytest.approx(roll, abs=1.5)


def test_scattered_lines_say_little():
    rng, picture = np.random.default_rng(1), np.full((*SIZE[::-1], 3), 150, np.uint8)
    for _ in range(40):
        a = rng.uniform([20, 20], [300, 180])
        turn = rng.uniform(-np.pi, np.pi)
        b = a + 25 * np.array([np.cos(turn), np.sin(turn)])
        cv2.line(picture, tuple(a.astype(int).tolist()), tuple(b.astype(int).tolist()), (40, 40, 40), 2, cv2.LINE_AA)
    lines = plumb_lines(picture, np.ones(SIZE[::-1], bool))
    assert lines is not None
    log = np.array([plumb_evidence(tilted(p), lines) for p in np.arange(0.0, 41.0, 5.0)])
    assert np.ptp(log) < 2.0


def test_what_moves_is_no_post():
    assert plumb_lines(posts(20.0, 0.0), np.zeros(SIZE[::-1], bool)) is None


def test_a_fall_beside_posts_is_seen_from_where_the_posts_say():
    picture, fluid = posts(30.0, 2.0), np.zeros(SIZE[::-1], bool)
    fluid[60:160, 150:170] = True
    flow = np.zeros((*SIZE[::-1], 2))
    flow[..., 1] = 3.0
    seen = look_at(kind_of("fall"), picture, fluid, fluid)
    up = estimate_up("fall", fluid, flow, np.ones(SIZE[::-1]), CAMERA, seen)
    without = estimate_up("fall", fluid, flow, np.ones(SIZE[::-1]), CAMERA)
    assert without.pitch == pytest.approx(kind_of("fall").pitch_prior[0], abs=0.01)
    assert abs(up.pitch - 30.0) < 0.5 * abs(without.pitch - 30.0)
    assert "plumb lines" in up.source and up.confidence > without.confidence


@pytest.mark.parametrize("pitch", [2.0, 5.0, 9.0])
def test_a_quiet_river_under_the_sky_is_seen_from_near_the_horizon(pitch):
    """Sky and far shore alone; main habit is a camera that looks over a landscape at 10 degrees."""
    picture, water = landscape(pitch, hills=5.0, shore=3.0)
    up = still_water(water, look_at(STREAM, picture, water, water))
    assert up.pitch == pytest.approx(pitch, abs=5.0)
    assert up.error < 8.0 and up.warnings == []
    assert {"sky", "upper end of the water"} <= set(up.source.split(", "))


def test_what_nothing_is_known_of_is_seen_as_usual_and_unsure():
    up = still_water(np.ones(SIZE[::-1], bool), PictureEvidence())
    assert up.error > 15.0 and up.confidence < 0.2
    assert up.source == "usual view of a stream"
    assert len(up.warnings) == 1 and "--pitch" in up.warnings[0]
    assert PictureEvidence().words == []


def still_water(water, picture):
    still = np.zeros((*SIZE[::-1], 2))
    return estimate_up("stream", water, still, np.zeros(SIZE[::-1]), CAMERA, picture)
