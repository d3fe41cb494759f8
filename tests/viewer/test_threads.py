"""What the page's own threads do with errors that nobody expected."""

import time

import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'fluidlift[view]'")


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


@pytest.fixture
def opened(tank_folder):
    from fluidlift.pipeline.preview import PreviewSize
    from fluidlift.viewer.app import Viewer, ViewRequest
    from fluidlift.viewer.ports import free_port

    made = []

    def begin():
        made.append(
            Viewer(tank_folder, ViewRequest(port=free_port("127.0.0.1", 18200)), size=PreviewSize(seconds=None))
        )
        return made[0]

    yield begin
    for viewer in made:
        viewer.close()


def broken(*_):
    raise ZeroDivisionError("oh")


def test_a_search_for_the_input_video_that_breaks_is_told_and_over(opened, monkeypatch, caplog):
    from fluidlift.viewer import app

    monkeypatch.setattr(app, "input_pictures", broken)
    viewer = opened()
    until(lambda: not viewer.looking_for_pictures)
    assert viewer.pictures is None and "input video: unexpected ZeroDivisionError" in viewer.messages
    assert "ZeroDivisionError" in caplog.text


def test_a_comparison_that_breaks_is_told_and_the_next_one_is_made(opened, monkeypatch, caplog):
    viewer = opened()
    until(lambda: viewer.stale is not None)
    with monkeypatch.context() as while_broken:
        while_broken.setattr(viewer.draft, "stale", broken)
        viewer.compare()
        until(lambda: viewer.stale is not None)
        assert viewer.stale == {"simulate", "look"} and "unexpected ZeroDivisionError" in viewer.messages
    monkeypatch.setattr(viewer.draft, "stale", lambda: {"look"})
    viewer.compare()
    until(lambda: viewer.stale == {"look"})
