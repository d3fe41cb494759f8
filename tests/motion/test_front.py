"""The edge of a growing body moves with its fluid, and so does what is below it."""

import numpy as np
import pytest

from fluidlift.motion.front import LARGEST_FACTOR, cap_speed, raised_flow, row_rise


def rising(speed, frames=16):
    masks = np.zeros((frames, 120, 60), bool)
    for t in range(frames):
        masks[t, int(round(90 - speed * t)) : 110, 20:40] = True
    return masks


def flow_up(rise):
    flow = np.zeros((120, 60, 2), np.float32)
    flow[..., 1] = -np.asarray(rise, np.float32).reshape(-1, 1)
    return flow


@pytest.mark.parametrize("speed", [1.0, 2.5, 4.0])
def test_the_cap_rises_as_fast_as_the_body_grows(speed):
    # rows are whole numbers and the 3 % row lags a little as the body grows: 10 %
    assert cap_speed(rising(speed), 8) == pytest.approx(speed, rel=0.1)


def test_flow_that_sees_half_the_rise_is_raised_half_way():
    raised, factor = raised_flow(flow_up(1.25), rising(2.5), 8)
    # half lies half way between what is raised altogether (a quarter) and what is left alone (three quarters)
    assert factor == pytest.approx(1.5, rel=0.1)
    assert -raised[rising(2.5)[8], 1].mean() == pytest.approx(0.5 * (1.25 + 2.5), rel=0.1)


def test_a_stem_without_texture_rises_with_its_cap_and_the_cap_stays_as_it_was_seen():
    rows = np.arange(120)
    seen = np.where(rows < 85, 2.4, 0.1)  # the stem, from row 85, looks the same in every frame
    flow = flow_up(seen)
    flow[..., 0] = 0.3 * np.sin(rows)[:, None]
    masks = rising(2.5)
    raised, _ = raised_flow(flow, masks, 8)
    rise = row_rise(raised, masks[8])
    np.testing.assert_array_equal(raised[70:80], flow[70:80])
    # the cap's speed is known to 10 % (above)
    assert rise[90:108] == pytest.approx(np.full(18, 2.5), rel=0.1)
    np.testing.assert_array_equal(raised[..., 0], flow[..., 0])  # nothing is known of the motion across


def test_a_body_that_does_not_grow_changes_nothing():
    flow = flow_up(1.0)
    raised, factor = raised_flow(flow, rising(0.0), 8)
    assert factor == 1.0
    np.testing.assert_array_equal(raised, flow)


def test_a_body_that_reaches_the_upper_border_changes_nothing():
    masks = rising(2.5)
    masks[:, :60, 20:40] = True
    flow = flow_up(0.2)
    raised, factor = raised_flow(flow, masks, 8)
    assert factor == 1.0
    np.testing.assert_array_equal(raised, flow)


def test_the_factor_is_bounded_and_never_slows_the_flow():
    raised, factor = raised_flow(flow_up(0.2), rising(4.0), 8)
    assert 2.0 < factor <= LARGEST_FACTOR
    assert (-raised[..., 1] <= 0.2 * LARGEST_FACTOR + 1e-6).all()
    fast = flow_up(9.0)
    raised, factor = raised_flow(fast, rising(4.0), 8)
    assert factor == 1.0
    np.testing.assert_array_equal(raised, fast)


def test_what_lies_outside_the_body_is_not_touched():
    masks = rising(2.5)
    flow = flow_up(0.5)
    raised, _ = raised_flow(flow, masks, 8)
    np.testing.assert_array_equal(raised[~masks[8]], flow[~masks[8]])
