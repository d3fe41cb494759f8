"""People see how far a long stage is."""

import io
import itertools

import pytest

from fluidlift import progress
from fluidlift.progress import PlainProgress, time_left


@pytest.mark.parametrize(
    ("done", "total", "first", "seconds", "words"),
    [
        (10, 20, 0, 30.0, "about 30 s left"), (1, 101, 0, 6.0, "about 10 min left"),
        (1, 1001, 0, 36.0, "about 10.0 h left"),
        # frames that a checkpoint had already do not count as fast ones
        (110, 120, 100, 30.0, "about 30 s left"),
        (0, 20, 0, 0.0, ""), (20, 20, 0, 30.0, ""), (100, 120, 100, 3.0, ""),
    ],
)  # fmt: skip
def test_the_rest_takes_as_long_as_the_parts_before(done, total, first, seconds, words):
    assert time_left(done, total, first, seconds) == words


def test_plain_lines_tell_the_frame_every_few_seconds(monkeypatch):
    clock = itertools.count(0.0, 4.0)  # s: each look at the clock is four seconds after the one before
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    stream = io.StringIO()
    plain = PlainProgress(stream, every=10.0)
    plain.stage("simulate", 1, 2)
    for k in range(6):
        plain.update(k, 6)
    plain.finished("simulate", 24.0, False)
    assert stream.getvalue().splitlines() == [
        "[1/2] re-simulating ...",
        "[1/2] re-simulating: 3 of 6, about 12 s left",
        "[1/2] re-simulating: 24.0 s",
    ]
