"""The playhead: which frame is shown when."""

import pytest

from fluidlift.viewer.timeline import Timeline


def playing(count=10, interval=0.1, **options):
    timeline = Timeline(count, interval, **options)
    timeline.play(0.0)
    return timeline


def test_it_plays_in_real_time_whatever_the_rate_of_ticks():
    quick, slow = playing(), playing()
    for k in range(1, 46):
        quick.tick(0.01 * k)
    slow.tick(0.45)
    assert quick.frame == slow.frame == 4


def test_the_end_goes_on_at_the_beginning():
    timeline = playing()
    assert [timeline.tick(t) for t in (0.95, 1.05, 2.15)] == [9, 0, 1]


def test_while_frames_are_still_made_the_end_waits_for_them():
    timeline = playing(3, growing=True)
    assert timeline.tick(5.0) == 2
    timeline.resize(8)
    assert timeline.tick(5.25) == 4


@pytest.mark.parametrize(("speed", "frame"), [(0.5, 2), (1.0, 5), (2.0, 0)])
def test_speed_is_a_multiple_of_real_time(speed, frame):
    timeline = playing(speed=speed)
    assert timeline.tick(0.501) == frame


def test_a_pause_and_a_jump_stay_where_they_are():
    timeline = playing()
    timeline.tick(0.31)
    timeline.pause()
    assert timeline.tick(7.0) == 3
    timeline.seek(99)
    assert timeline.frame == 9
    timeline.seek(-5)
    assert timeline.frame == 0


def test_after_a_pause_it_goes_on_from_there_and_not_from_where_the_clock_is():
    timeline = playing()
    timeline.tick(0.31)
    timeline.pause()
    timeline.play(100.0)
    assert timeline.tick(100.1) == 4


def test_play_at_the_end_begins_again():
    timeline = Timeline(10, 0.1)
    timeline.seek(9)
    timeline.play(0.0)
    assert timeline.tick(0.05) == 0


def test_frames_are_numbered_from_1001_and_told_in_seconds():
    timeline = Timeline(10, 0.04)
    timeline.seek(5)
    assert timeline.label.split() == ["1006", "·", "0.20", "s"]


def test_a_shorter_simulation_moves_the_playhead_to_its_last_frame():
    timeline = Timeline(10, 0.1)
    timeline.seek(9)
    timeline.resize(4)
    assert timeline.frame == 3


def test_no_frames_at_all_is_no_error():
    timeline = playing(0)
    assert timeline.tick(3.0) == 0
    timeline.step(1)
    assert timeline.frame == 0
