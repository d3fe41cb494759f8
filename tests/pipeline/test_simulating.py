"""What enters looks like the body downstream, mirrored: no seam, no single colour for long."""

import numpy as np

from fluidlift.pipeline.simulating import emission_look
from fluidlift.types import Gaussians

ALONG = np.array([1.0, 0.0, 0.0])


def line():
    x = np.linspace(0.0, 1.0, 101)
    return Gaussians.isotropic(np.stack([x, 0 * x, 0 * x], axis=1), 0.01, np.full((101, 3), 0.5))


def looked_up(speed, times):
    look = emission_look(line(), ALONG, speed)
    return np.array([0.01 * look(np.zeros((1, 3)), t)[0] for t in times])


def test_the_pattern_moves_upstream_at_the_speed_of_the_inflow():
    # from 12 % (what lies before is left out) onwards; Gaussians stand 0.01 apart
    np.testing.assert_allclose(looked_up(0.5, [0.4, 0.8, 1.2]), [0.2, 0.4, 0.6], atol=0.011)


def test_at_the_end_it_turns_back_without_a_jump():
    times = np.arange(0.0, 8.0, 0.05)
    steps = np.abs(np.diff(looked_up(0.5, times)))
    # 0.5 * 0.05 per step, rounded to Gaussians 0.01 apart
    assert steps.max() <= 0.036
    assert looked_up(0.5, times).max() <= 0.91


def test_still_water_keeps_one_look():
    assert np.ptp(looked_up(0.0, [0.0, 1.0, 5.0])) == 0.0
