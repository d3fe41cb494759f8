"""People see how far a long stage is."""

import io
import itertools

import pytest

from fluidlift import progress
from fluidlift.progress import Pace, PlainProgress


def left(times, total, start=0):
    pace = Pace()
    for k, now in enumerate(times):
        pace.at(start + k, now)
    return pace.left(total)


@pytest.mark.parametrize(
    ("times", "total", "start", "words"),
    [
        ([0, 3, 6, 9, 12], 20, 0, "about 48 s left"), ([0, 6, 12, 18], 103, 0, "about 10 min left"),
        ([0, 36, 72, 108], 1003, 0, "about 10.0 h left"),
        # frames that a checkpoint had already do not count as fast ones
        ([0, 3, 6, 9], 113, 100, "about 30 s left"),
        ([0], 20, 0, ""), ([0, 1], 20, 0, ""), ([0, 1, 2], 20, 0, ""), ([0, 3, 6, 9], 3, 0, ""), ([], 3, 0, ""),
    ],
)  # fmt: skip
def test_the_rest_takes_as_long_as_the_parts_before(times, total, start, words):
    assert left(times, total, start) == words


def test_what_is_compiled_for_the_first_frame_and_a_body_at_rest_are_no_measure_of_the_rest():
    # the body at rest is written at once, the first frame takes a minute to compile, each later one 2 s
    times = [0.0, 0.1, 60.1, 62.1, 64.1]
    assert [left(times[:k], 33) for k in (1, 2, 3)] == ["", "", ""]
    assert left(times, 33) == "about 58 s left"


def test_a_stage_that_slows_down_is_told_by_its_later_half():
    times = [float(t) for t in [*range(12), *range(13, 60, 4)]]  # s: at first one a part, then four
    assert left(times, len(times) + 9) == "about 40 s left"


def test_plain_lines_tell_the_frame_every_few_seconds(monkeypatch):
    clock = itertools.count(0.0, 4.0)  # s: each look at the clock is four seconds after the one before
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    stream = io.StringIO()
    plain = PlainProgress(stream, every=10.0)
    plain.stage("motion", 1, 2)
    for k in range(8):
        plain.update(k, 8)
    plain.finished("motion", 32.0, False)
    assert stream.getvalue().splitlines() == [
        "[1/2] velocities ...",
        "[1/2] velocities: 2 of 8",
        "[1/2] velocities: 5 of 8, about 12 s left",
        "[1/2] velocities: 32.0 s",
    ]
