"""The edge of a growing body moves with its fluid."""

import numpy as np
import pytest

from fluidlift.motion.front import LARGEST_FACTOR, cap_speed, front_factor


def rising(speed, frames=16):
    masks = np.zeros((frames, 120, 60), bool)
    for t in range(frames):
        masks[t, int(round(90 - speed * t)) : 110, 20:40] = True
    return masks


@pytest.mark.parametrize("speed", [1.0, 2.5, 4.0])
def test_the_cap_rises_as_fast_as_the_body_grows(speed):
    # rows are whole numbers and the 3 % row lags a little as the body grows: 10 %
    assert cap_speed(rising(speed), 8) == pytest.approx(speed, rel=0.1)


def test_flow_that_sees_half_the_rise_is_doubled():
    flow = np.zeros((120, 60, 2), np.float32)
    flow[..., 1] = -1.25
    assert front_factor(flow, rising(2.5), 8) == pytest.approx(2.0, rel=0.1)


def test_a_body_that_does_not_grow_changes_nothing():
    flow = np.zeros((120, 60, 2), np.float32)
    flow[..., 1] = -1.0
    assert front_factor(flow, rising(0.0), 8) == 1.0


def test_the_factor_is_bounded_and_never_slows_the_flow():
    flow = np.zeros((120, 60, 2), np.float32)
    flow[..., 1] = -0.2
    assert front_factor(flow, rising(4.0), 8) == LARGEST_FACTOR
    flow[..., 1] = -9.0
    assert front_factor(flow, rising(4.0), 8) == 1.0
