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


def test_rows_that_see_half_the_rise_are_raised_half_way():
    flow = flow_up(np.where(np.arange(120) < 85, 2.5, 1.25))
    raised, _ = raised_flow(flow, rising(2.5), 8)
    # half lies half way between what is raised altogether (a quarter) and what is left alone (three quarters)
    assert row_rise(raised, rising(2.5)[8])[90:108] == pytest.approx(np.full(18, 0.5 * (1.25 + 2.5)), rel=0.1)


def test_flow_that_is_slower_than_the_cap_everywhere_saw_a_part_of_all_motion():
    flow = flow_up(1.25)
    flow[..., 0] = 0.5
    raised, factor = raised_flow(flow, rising(2.5), 8)
    # the cap's speed is known to 10 %, and not believed for the last tenth
    assert factor == pytest.approx(0.9 * 2.5 / 1.25, rel=0.1)
    np.testing.assert_allclose(raised[rising(2.5)[8]], factor * flow[rising(2.5)[8]], rtol=1e-4)


def test_a_thing_above_the_cap_that_is_taken_for_smoke_does_not_hold_it_up_for_long():
    masks = rising(2.5, frames=30)
    masks[:, 78:84, 20:40] = True  # the cap is behind it from frame 5 on
    assert cap_speed(masks[:7], 0) < 1.0
    # over a course of twelve frames, five of them at rest, more than half of the speed is found, and not too much
    assert 0.5 * 2.5 < cap_speed(masks, 0) < 1.1 * 2.5


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


def test_a_narrow_stem_is_faster_than_the_cap_that_it_feeds():
    masks = rising(2.5)
    masks[:, 90:, :27] = masks[:, 90:, 33:] = False  # six px below twenty
    raised, _ = raised_flow(flow_up(2.4), masks, 8)
    rise = row_rise(raised, masks[8])
    np.testing.assert_array_equal(raised[70:88], flow_up(2.4)[70:88])
    # the cap's speed is known to 10 % (above)
    assert rise[92:108] == pytest.approx(np.full(16, 1.25 * 2.5), rel=0.1)
    fast = flow_up(np.where(np.arange(120) < 90, 2.4, 5.0))
    raised, _ = raised_flow(fast, masks, 8)
    np.testing.assert_array_equal(raised, fast)  # a stem that is seen to be faster stays as it was seen


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
