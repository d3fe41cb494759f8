"""The worker behind the live preview, with the real simulator."""

import pytest

from fluidlift.io.asset_folder import load_asset
from fluidlift.pipeline import preview
from fluidlift.pipeline.preview import LivePreview, PreviewRequest, PreviewSize


@pytest.fixture
def begun(tank_folder, until):
    workers = []

    def begin(**options):
        worker = LivePreview(load_asset(tank_folder), tank_folder, **options)
        workers.append(worker)
        worker.start()
        until(lambda: worker.phase == "ready")
        return worker

    yield begin
    for worker in workers:
        worker.close()


def test_a_surprise_is_told_and_logged_and_the_next_wish_is_served(begun, caplog, until):
    broken = [True]

    def keep(frame):
        if broken:
            raise ZeroDivisionError("oh")
        return frame.number

    worker = begun(size=PreviewSize(frames=3, seconds=None), keep=keep)
    worker.ask(PreviewRequest({}, "gravity 3"))
    until(lambda: not worker.busy)
    assert "gravity 3" in worker.problem and "ZeroDivisionError" in caplog.text
    broken.clear()
    worker.ask(PreviewRequest({}, "gravity 4"))
    until(lambda: worker.shown is not None and worker.shown.complete)
    assert worker.shown.frames == [0, 1, 2] and not worker.problem


@pytest.mark.parametrize(("seconds", "doubled"), [(None, False), (1e-9, True), (1e9, False)])
def test_cells_double_where_a_frame_takes_longer_than_it_may_and_never_where_the_clock_does_not_count(
    begun, monkeypatch, seconds, doubled
):
    fine = []
    monkeypatch.setattr(preview, "bears_coarser", lambda asset: len(asset.rest) == fine[0])  # once
    monkeypatch.setattr(preview, "coarse_asset", lambda asset, size: fine.append(len(asset.rest)) or asset)
    assert (begun(size=PreviewSize(seconds=seconds)).particles < fine[0]) == doubled
