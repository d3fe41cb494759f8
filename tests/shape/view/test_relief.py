"""A flat view is built from a little higher, a steep one as it is seen."""

import numpy as np
import pytest

from fluidlift.shape.kind import level_camera
from fluidlift.shape.view import as_relief
from fluidlift.shape.view.horizon import elevation
from fluidlift.shape.view.relief import MOST_SPREAD
from fluidlift.types import PinholeCamera, UpEvidence

CAMERA = PinholeCamera.from_fov(50.0, (320, 180))


def water(pitch: float) -> np.ndarray:
    """bool [180,320]: all that lies a degree below the horizon, and lower."""
    rows, columns = np.mgrid[0:180, 0:320]
    places = np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5
    seen = elevation(level_camera(CAMERA, UpEvidence(pitch, 0.0, "", 0.0)), places)
    return (seen < -1.0).reshape(180, 320)


def spread(up: UpEvidence, mask: np.ndarray) -> float:
    """Farthest distance over the nearest, all but the last percents."""
    places = np.argwhere(mask)[:, ::-1] + 0.5
    low, high = np.percentile(-elevation(level_camera(CAMERA, up), places), [2.0, 98.0])
    return float(np.sin(np.radians(high)) / np.sin(np.radians(low)))


@pytest.mark.parametrize("pitch", [3.0, 8.0, 15.0])
def test_water_to_the_horizon_is_built_as_a_relief_and_that_is_said(pitch):
    seen, mask = UpEvidence(pitch, 1.0, "sky", 0.8, 4.0), water(pitch)
    built = as_relief(seen, mask, lambda up: level_camera(CAMERA, up))
    assert built.pitch - built.raised == pytest.approx(pitch)
    assert built.roll == 1.0
    assert 0.9 * MOST_SPREAD < spread(built, mask) <= MOST_SPREAD < spread(seen, mask)
    (told,) = built.warnings
    assert f"--pitch {pitch:.0f}" in told


def test_a_steep_view_and_water_far_below_the_horizon_stay_as_they_are():
    high, near = UpEvidence(60.0, 0.0, "", 0.8), UpEvidence(8.0, 0.0, "", 0.8)
    low_rows = np.zeros((180, 320), bool)
    low_rows[130:] = True
    assert as_relief(high, water(60.0), lambda up: level_camera(CAMERA, up)) == high
    assert as_relief(near, low_rows, lambda up: level_camera(CAMERA, up)) == near and near.warnings == []
