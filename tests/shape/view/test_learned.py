"""A learned model of the view is one more witness: it is heard, doubted, and outvoted."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.shape.kind import estimate_up, level_camera
from fluidlift.shape.view import LearnedTilt, PictureEvidence
from fluidlift.shape.view.habit import ROLL
from fluidlift.shape.view.learned import MISTAKEN_MODEL
from fluidlift.shape.view.plumb import PlumbLines
from fluidlift.types import PinholeCamera, UpEvidence, kind_of

CAMERA = PinholeCamera.from_fov(50.0, (96, 64))
MASK = np.zeros((64, 96), bool)
MASK[30:60, 20:76] = True
STILL, NOTHING = np.zeros((64, 96, 2)), np.zeros((64, 96))


def tilt(pitch, roll=0.0, error=4.5):
    return LearnedTilt("geocalib", pitch, roll, error, 1.5)


def up_of(kind, picture):
    return estimate_up(kind, MASK, STILL, NOTHING, CAMERA, picture)


@pytest.mark.parametrize("kind", ["stream", "fall", "pour", "plume", "dam", "basin"])
@pytest.mark.parametrize("roll", [0.0, 5.0])
def test_where_nothing_else_speaks_it_decides(kind, roll):
    """At a pitch that is a standard deviation above what is usual."""
    mean, spread = kind_of(kind).usual_pitch
    pitch = mean + spread
    habit, up = up_of(kind, None), up_of(kind, PictureEvidence(learned=tilt(pitch, roll)))
    assert abs(up.pitch - pitch) < 0.6 * abs(habit.pitch - pitch)  # of the narrowest habit, 6 degrees, it takes 0.64
    held = ROLL**2 / (ROLL**2 + 1.5**2)  # of a Gaussian habit and a Gaussian error
    assert up.roll == pytest.approx(held * roll, abs=0.5)
    assert up.error < habit.error and "geocalib" in up.source


def test_it_says_nothing_of_what_was_given():
    picture = PictureEvidence(learned=tilt(35.0, 5.0))
    up = estimate_up("stream", MASK, STILL, NOTHING, CAMERA, picture, given=(12.0, 0.0))
    assert (up.pitch, up.roll, up.error) == (12.0, 0.0, 0.0)


def plumb(pitch, count):
    """Upright edges of posts, as a camera at a pitch sees them."""
    camera = level_camera(CAMERA, UpEvidence(pitch, 0.0, "", 1.0))
    rng = np.random.default_rng(0)
    middle = rng.uniform([5, 5], [91, 59], (count, 2))
    down = -camera.camera_from_world.rotation[:, 2]
    at = (middle - np.asarray(camera.center)) / np.asarray(camera.focal)
    way = down[:2] - at * down[2]
    return PlumbLines(middle, np.degrees(np.arctan2(way[:, 0], way[:, 1])), np.ones(count))


@pytest.mark.parametrize("kind", ["stream", "pour", "basin"])
def test_witnesses_that_agree_are_surer_than_each(kind):
    lines = PictureEvidence(lines=plumb(30.0, 12))
    alone, both = up_of(kind, lines), up_of(kind, replace(lines, learned=tilt(30.0)))
    assert both.pitch == pytest.approx(30.0, abs=2.0) and abs(both.pitch - 30.0) < abs(alone.pitch - 30.0)
    assert both.error < min(alone.error, 4.5)


@pytest.mark.parametrize("kind", ["stream", "pour", "basin"])
def test_a_wrong_model_is_outvoted_by_what_the_picture_shows(kind):
    """A dozen posts say 10 degrees: a model that says 45 does not move them, but the spread grows."""
    lines = PictureEvidence(lines=plumb(10.0, 12))
    alone, wrong = up_of(kind, lines), up_of(kind, replace(lines, learned=tilt(45.0)))
    assert wrong.pitch == pytest.approx(10.0, abs=1.0)
    assert wrong.error > alone.error


@pytest.mark.parametrize("kind", ["stream", "pour", "basin"])
def test_where_neither_is_sure_the_spread_says_so(kind):
    """Six posts against the same model: less is known than from either alone."""
    lines = PictureEvidence(lines=plumb(10.0, 6))
    alone, up = up_of(kind, lines), up_of(kind, replace(lines, learned=tilt(45.0)))
    assert up.error > max(alone.error, up_of(kind, PictureEvidence(learned=tilt(45.0))).error)
    assert up.warnings  # tilt-unsure


def test_a_roll_that_nobody_films_leaves_the_pitch_heard():
    """A picture turned by 40 degrees is more likely a mistake about the roll: pitch and roll may be mistaken apart."""
    for kind in ("stream", "fall"):
        up = up_of(kind, PictureEvidence(learned=tilt(20.0, 40.0)))
        assert abs(up.roll) < 1.0
        assert up.pitch == pytest.approx(up_of(kind, PictureEvidence(learned=tilt(20.0))).pitch, abs=1.0)


def test_far_from_its_angle_all_are_alike():
    log = tilt(20.0).log(np.array([20.0, 60.0, 80.0]), np.array([0.0, 20.0]))
    assert log[1, 0] == pytest.approx(log[2, 0]) and log[0, 0] > log[1, 0]
    # the density of a mistake over that of the peak
    ratio = np.exp(log[1, 0] - log[0, 0])
    assert ratio == pytest.approx(MISTAKEN_MODEL / 90.0 * 4.5 * np.sqrt(2 * np.pi) / (1 - MISTAKEN_MODEL), rel=0.02)


def test_without_it_the_rolls_are_those_of_the_habit():
    np.testing.assert_allclose(tilt(0.0, 60.0).rolls(ROLL), [-4.0, 0.0, 4.0])
    middle = tilt(0.0, 5.0).rolls(ROLL)
    assert middle[1] == pytest.approx(5.0 * ROLL**2 / (ROLL**2 + 1.5**2))
    assert middle[2] - middle[1] == pytest.approx(middle[1] - middle[0])
