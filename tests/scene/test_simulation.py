"""Frames are written beside other work, one at a time."""

import threading

import pytest

from fluidlift.scene.simulation import Written


def test_one_frame_is_written_while_the_next_one_is_made_and_no_more_wait():
    gate, done = threading.Event(), []

    def write(number: int, *, gate: threading.Event | None = None) -> None:
        if gate is not None:
            assert gate.wait(10.0)
        done.append(number)

    with Written() as written:
        written.begin(write, 0, gate=gate)
        assert done == []  # it is not waited for
        threading.Timer(0.1, gate.set).start()
        written.begin(write, 1)
        assert done[:1] == [0]  # the one before is written first
        written.wait()
        assert done == [0, 1]
        written.begin(write, 2)
    assert done == [0, 1, 2]


def fails(number: int) -> None:
    raise OSError(f"no room for frame {number}")


def test_what_goes_wrong_with_a_frame_is_told_by_the_next_one_or_at_the_end():
    done: list[int] = []
    with pytest.raises(OSError, match="frame 3"), Written() as written:
        written.begin(fails, 3)
        written.begin(done.append, 4)
    with pytest.raises(OSError, match="frame 5"), Written() as written:
        written.begin(fails, 5)
    with pytest.raises(ValueError, match="something else"), Written() as written:
        written.begin(fails, 6)
        raise ValueError("something else")  # what ended the block counts
    assert done == []
