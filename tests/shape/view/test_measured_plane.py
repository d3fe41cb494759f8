"""The water's plane, where a camera's path has measured it, beside what the picture says of the tilt."""

import numpy as np
import pytest

from fluidlift.shape.kind import estimate_up, level_camera
from fluidlift.shape.view import MeasuredPlane, PictureEvidence
from fluidlift.types import PinholeCamera, UpEvidence

CAMERA = PinholeCamera.from_fov(50.0, (96, 64))


def plane_at(pitch: float, roll: float) -> MeasuredPlane:
    return MeasuredPlane(tilted(pitch, roll).camera_from_world.rotation[:, 2])


def tilted(pitch: float, roll: float) -> PinholeCamera:
    return level_camera(CAMERA, UpEvidence(pitch, roll, "", 0.0))


def test_the_tilt_of_the_plane_is_likeliest_and_none_is_ruled_out():
    plane = plane_at(12.0, 3.0)
    pitches = np.arange(0.0, 60.0, 1.0)
    logs = [plane.tilt(tilted(p, 3.0)) for p in pitches]
    assert pitches[int(np.argmax(logs))] == 12.0
    assert plane.tilt(tilted(12.0, 3.0)) > plane.tilt(tilted(12.0, -3.0))
    assert max(logs) - min(logs) < 8.0  # a plane of something else, once in seventeen clips


@pytest.mark.parametrize("pitch", [6.0, 25.0])
def test_it_beats_habit_over_a_stream_that_shows_nothing_else(pitch):
    mask = np.zeros((64, 96), bool)
    mask[40:60, 20:76] = True
    still = np.zeros((64, 96, 2))
    picture = PictureEvidence(plane=plane_at(pitch, 0.0))
    up = estimate_up("stream", mask, still, np.zeros((64, 96)), CAMERA, picture)
    habit = estimate_up("stream", mask, still, np.zeros((64, 96)), CAMERA)
    assert abs(up.pitch - pitch) < 3.0  # as far as water falls
    assert abs(up.pitch - pitch) < abs(habit.pitch - pitch)
    assert up.error < habit.error and "path of the camera" in up.source
