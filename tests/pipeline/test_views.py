"""What a learned model of the view counts for: as much as it is sure, and its pictures agree."""

import numpy as np
import pytest

from fluidlift.config import JobConfig, ViewConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline.known_camera import USUAL_SPREAD
from fluidlift.pipeline.models import require_weights
from fluidlift.pipeline.views import LearnedView
from fluidlift.types import PinholeCamera
from fluidlift.types.stages import ViewGuesses

CAMERA = PinholeCamera.from_fov(50.0, (640, 360))


def guesses(pitch, focal, focal_error=0.16, by_focal=0.0):
    n = len(pitch)
    errors = np.tile([4.5, 1.5, focal_error], (n, 1))
    return ViewGuesses("geocalib", np.array(pitch), np.zeros(n), np.array(focal), errors, np.full(n, by_focal))


def test_pictures_that_agree_leave_the_models_own_error():
    found = LearnedView.of(guesses([20.0] * 3, [700.0] * 3))
    assert found is not None
    assert (found.pitch, found.focal) == pytest.approx((20.0, 700.0))
    assert (found.pitch_error, found.roll_error, found.focal_error) == pytest.approx((4.5, 1.5, 0.16))


def test_pictures_that_do_not_agree_make_it_less_sure():
    """One camera took all of them: what they differ by is error. The median leaves a single mistake out."""
    found = LearnedView.of(guesses([20.0, 21.0, 50.0], [700.0, 690.0, 2000.0]))
    assert found is not None
    assert found.pitch == 21.0 and found.focal == pytest.approx(700.0)
    assert found.pitch_error > 15.0 and found.focal_error > 0.5
    assert LearnedView.of(guesses([], [])) is None


def test_its_lens_counts_by_how_sure_it_is():
    found = LearnedView.of(guesses([20.0], [900.0], 0.16))
    assert found is not None
    usual, measured = found.lens(CAMERA, USUAL_SPREAD), found.lens(CAMERA, 0.01)
    weight = USUAL_SPREAD**2 / (USUAL_SPREAD**2 + 0.16**2)
    wanted = np.exp((1 - weight) * np.log(CAMERA.focal[0]) + weight * np.log(900.0))
    assert usual.focal[0] == usual.focal[1] == pytest.approx(wanted, rel=0.03)  # it may be mistaken, too
    assert measured.focal[0] == pytest.approx(CAMERA.focal[0], rel=0.01)  # the path of the camera says it better


def test_a_lens_far_from_what_is_measured_is_outvoted():
    """A view of 140 degrees by a model, and 5 % by the path of the camera: the model is mistaken."""
    wild = PinholeCamera.from_fov(140.0, CAMERA.size).focal[0]
    found = LearnedView.of(guesses([20.0], [wild], 0.16))
    assert found is not None
    assert found.lens(CAMERA, 0.05).focal[0] == pytest.approx(CAMERA.focal[0], rel=1e-3)
    pulled = found.lens(CAMERA, USUAL_SPREAD).focal[0]
    assert np.log(pulled / CAMERA.focal[0]) > 0.5 * np.log(wild / CAMERA.focal[0])  # it does not get all of it


def test_its_tilt_follows_the_lens_that_is_taken_in_the_end():
    """A horizon low in the picture means less pitch with a longer lens."""
    found = LearnedView.of(guesses([20.0], [700.0], 0.16, by_focal=-18.0))
    assert found is not None
    longer = PinholeCamera((900.0, 900.0), CAMERA.center, CAMERA.size)
    assert found.tilt(longer).pitch == pytest.approx(20.0 - 18.0 * np.log(900.0 / 700.0))
    told = LearnedView.of(guesses([20.0], [700.0], 0.0))
    assert told is not None and told.lens(longer, 0.0) is longer and told.tilt(longer).pitch == 20.0


@pytest.mark.parametrize(("weights", "says"), [(None, "without its weights"), ("nowhere.tar", "not there")])
def test_weights_are_asked_for_before_the_clip_is_read(weights, says):
    require_weights(JobConfig())
    require_weights(JobConfig(view=ViewConfig("geocalib", "model:geocalib")))
    with pytest.raises(InputRejected, match=says):
        require_weights(JobConfig(view=ViewConfig("geocalib", weights)))
