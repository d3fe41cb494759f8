"""Motion of a whole clip: the mean of all of its fluid in each pair of frames, beside that of the ground."""

from types import SimpleNamespace

import numpy as np

from fluidlift.motion.steady_flow import bulk_motion
from fluidlift.types import PixelFlow

PAIRS, H, W = 6, 8, 12


def test_the_bulk_motion_is_that_of_the_fluid_of_each_frame_and_of_the_ground_that_stays_dry():
    row = np.arange(H)[:, None] * np.ones((1, W))
    wet = [row >= 4 - (t % 2) for t in range(PAIRS + 1)]
    ever = np.any(wet, axis=0)
    displacement = np.zeros((PAIRS, H, W, 2), np.float32)
    confidence = np.ones((PAIRS, H, W), np.float32)
    for t in range(PAIRS):
        displacement[t][wet[t]] = (t, -1.0)
        displacement[t][~wet[t]] = (0.5, 0.25 * t)
    confidence[2][wet[2]] = 0.0
    displacement[4, 7, :] = 99.0
    confidence[4, 7, :] = 0.0
    clip = SimpleNamespace(times=0.04 * np.arange(PAIRS + 1), interval=0.04)
    water, ground = bulk_motion(clip, PixelFlow(displacement, confidence), lambda t: wet[t], ever)  # type: ignore[arg-type]
    known = [0, 1, 3, 4, 5]
    np.testing.assert_allclose(water[known], [[t, -1.0] for t in known], atol=1e-6)
    assert np.isnan(water[2]).all(), "nothing was measured"
    np.testing.assert_allclose(ground, [[0.5, 0.25 * t] for t in range(PAIRS)], atol=1e-6)
    assert np.isnan(bulk_motion(clip, PixelFlow(displacement, confidence), lambda t: wet[t], ever | True)[1]).all()  # type: ignore[arg-type]
