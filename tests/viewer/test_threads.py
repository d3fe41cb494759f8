"""What the page's own threads do with errors that nobody expected."""

import time

import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'fluidlift[view]'")


@pytest.fixture
def opened(tank_folder, opened_viewer):
    made = []

    def begin():
        made.append(opened_viewer(tank_folder, 18200))
        return made[0]

    yield begin
    for viewer in made:
        viewer.close()


def broken(*_):
    raise ZeroDivisionError("oh")


def test_a_search_for_the_input_video_that_breaks_is_told_and_over(opened, monkeypatch, caplog, until):
    from fluidlift.viewer import app

    monkeypatch.setattr(app, "input_pictures", broken)
    viewer = opened()
    until(lambda: not viewer.looking_for_pictures)
    assert viewer.pictures is None and "input video: unexpected ZeroDivisionError" in viewer.messages
    assert "ZeroDivisionError" in caplog.text


def test_a_comparison_that_breaks_is_told_and_the_next_one_is_made(opened, monkeypatch, caplog, until):
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


def test_an_asset_that_another_process_writes_is_told_and_left_alone_until_it_is_done(opened, monkeypatch, until):
    import os

    from fluidlift.io.asset_lock import Holder
    from fluidlift.viewer import saved

    viewer = opened()
    until(lambda: viewer.preview.phase == "ready")
    monkeypatch.setattr(saved, "writer_of", lambda folder: Holder(os.getpid() + 1, "a simulation"))
    until(lambda: "Another process is writing this asset" in viewer.messages)
    for button in (viewer.panels.run._simulate, viewer.panels.run._export):
        viewer.say("")
        button(None)
        assert viewer.messages.startswith("Another process is writing this asset") and not viewer.jobs.running
    monkeypatch.setattr(saved, "writer_of", lambda folder: None)
    until(lambda: viewer.messages.startswith("The other process is done"))


def test_an_edit_while_somebody_else_edits_is_refused_and_told_and_the_scene_is_as_before(opened, until):
    from fluidlift.io.asset_lock import editing

    viewer = opened()
    with editing(viewer.folder):
        viewer.draft.move("parameters.density", 900.0, "density 900", time.monotonic())
        until(lambda: not viewer.draft.pending and viewer.messages)
    assert "edit" in viewer.messages and viewer.draft.parameters["density"] == 1000.0


def test_a_port_in_use_is_told_with_the_one_that_is_taken_instead(opened):
    from fluidlift.viewer.app import Viewer, ViewRequest

    first = opened()
    port = first.server.get_port()
    second = Viewer(first.folder, ViewRequest(port=port))
    try:
        told = "\n".join(second.lines())
        assert f"port {port} is in use; {second.server.get_port()} is taken instead" in told
        assert second.address in told and second.server.get_port() != port
    finally:
        second.close()
