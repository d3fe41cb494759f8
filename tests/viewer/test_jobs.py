"""Long work behind the page."""

import threading

from fluidlift.errors import FluidliftError
from fluidlift.viewer.jobs import Jobs


def test_progress_is_told_and_the_outcome_stays():
    jobs, seen, go = Jobs(), [], threading.Event()

    def work(progress):
        progress.stage("simulate", 1, 2)
        progress.update(3, 12)
        seen.append(jobs.state)
        go.wait(60)
        return "all done"

    assert jobs.start("full simulation", work)
    assert not jobs.start("another", lambda progress: "never")
    go.set()
    assert jobs.wait(60)
    assert seen[0].told == "full simulation: simulating, frame 3 of 12" and seen[0].share == 25
    assert jobs.state.told == "all done" and not jobs.state.failed


def test_a_stop_reaches_the_work_between_two_frames():
    jobs, begun, frames = Jobs(), threading.Event(), []

    def work(progress):
        for k in range(10_000):
            progress.update(k, 10_000)
            frames.append(k)
            begun.set()
            threading.Event().wait(0.001)
        return "never"

    jobs.start("full simulation", work)
    assert begun.wait(60)
    jobs.stop()
    assert jobs.wait(60)
    assert "stopped" in jobs.state.outcome and not jobs.state.failed
    assert len(frames) < 10_000
    assert jobs.start("again", lambda progress: "fine") and jobs.wait(60) and jobs.state.outcome == "fine"


def test_an_error_is_told_and_the_next_piece_can_begin():
    ended = []
    jobs = Jobs(lambda: ended.append(jobs.state.outcome))

    def broken(progress):
        raise FluidliftError("The disk is full.")

    def surprising(progress):
        raise ZeroDivisionError("oh")

    jobs.start("export", broken)
    assert jobs.wait(60) and jobs.state.failed
    jobs.start("export", surprising)
    assert jobs.wait(60)
    assert ended == ["export: The disk is full.", "export: unexpected ZeroDivisionError: oh"]


def test_an_error_after_the_end_and_one_nobody_expected_are_logged_and_the_next_piece_can_begin(caplog):
    def ended():
        raise KeyError("panel")

    def surprising(progress):
        raise ZeroDivisionError("oh")

    jobs = Jobs(ended)
    assert jobs.start("export", surprising) and jobs.wait(60)
    assert [r.exc_info[0] for r in caplog.records] == [ZeroDivisionError, KeyError]
    assert jobs.start("again", lambda progress: "fine") and jobs.wait(60) and jobs.state.outcome == "fine"
