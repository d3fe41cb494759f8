"""The studio as a person uses it, in a real browser: drop, look, draw, drag, undo, make, shelf."""

import base64
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason="starlette is not installed: pip install 'fluidlift[studio]'")
pytest.importorskip("uvicorn", reason="uvicorn is not installed: pip install 'fluidlift[studio]'")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

from fluidlift.io.hints_file import read_found, read_hints
from fluidlift.types import Label

CHROMIUM = Path("/usr/bin/chromium")
pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason=f"there is no {CHROMIUM}")


@pytest.fixture(scope="module")
def served(tmp_path_factory, serve):
    from fluidlift.studio.desk import Desk

    made = serve(Desk(tmp_path_factory.mktemp("studio")))
    yield made
    made.close()
    made.desk.close()


@pytest.fixture(scope="module")
def window(visitor, served, stream_clip):
    """The page with the small clip dropped on it and looked at."""
    made = visitor(served)
    made.says("Drop a clip here")
    made.page.set_input_files("#file", str(stream_clip))
    made.until(lambda: served.desk.strip is not None and served.desk.strip.first, "the first picture")
    made.looked()
    yield made
    made.page.close()


@pytest.fixture
def visit(window):
    """The page with its clip and no hints."""
    desk = window.desk
    if desk.history is None:  # a test that failed left another clip
        desk.open("stream.mp4")
    while desk.history.can_undo:
        desk.change(lambda history: history.undo())
    window.looked()
    window.page.keyboard.press("Escape")
    window.page.keyboard.press("v")
    window.tab("Put right")
    window.shown()
    yield window
    assert window.complaints == [] and window.strangers == []


def label_at(visit, x, y, t=0):
    labels = visit.desk.looking.look.segmentation.labels.labels
    return labels[t, int(y * labels.shape[1]), int(x * labels.shape[2])]


def test_what_was_found_stands_beside_the_picture_and_on_disk(visit):
    visit.until(lambda: "as found: stream" in visit.page.locator("#kind").inner_text(), "the kind")
    visit.says("of the picture, sure")
    file = visit.desk.folder / "stream.hints.yaml"
    assert read_found(file)["kind"] == "stream"
    assert visit.desk.times["first_picture"] < visit.desk.times["findings"]
    visit.until(lambda: visit.page.locator("#thumbs img").count() == 10, "the strip")


def test_a_stroke_changes_the_mask_and_undo_takes_it_back(visit):
    before = label_at(visit, 0.5, 0.5)
    assert before == Label.FLUID
    visit.page.keyboard.press("b")
    visit.page.get_by_label("what is there").select_option("rock")
    visit.drag((0.4, 0.5), (0.6, 0.5))
    visit.until(lambda: label_at(visit, 0.5, 0.5) == Label.SOLID, "the mask with the rock")
    visit.says("rock: brush 1")
    assert read_hints(visit.desk.history.file).regions[0].what == "rock"
    visit.press("Undo")
    visit.until(lambda: label_at(visit, 0.5, 0.5) == Label.FLUID, "the mask as before")
    visit.page.keyboard.press("Control+Shift+z")
    visit.until(lambda: label_at(visit, 0.5, 0.5) == Label.SOLID, "the mask with the rock again")


def test_the_mask_is_cleared_and_painted_anew_from_a_frame_on(visit):
    visit.page.keyboard.press("b")
    picture = visit.page.locator("#picture").bounding_box()
    visit.press("clear the mask")
    visit.says("leave no fluid")
    last = len(visit.desk.looking.look.read.clip) - 1
    visit.page.get_by_label("frame", exact=True).fill(str(last // 2))
    visit.page.get_by_label("what is there").select_option("fluid")
    visit.page.get_by_label("from here on").check()
    visit.drag((0.3, 0.5), (0.7, 0.5))
    visit.until(lambda: label_at(visit, 0.5, 0.5, 0) == Label.BACKGROUND, "the mask without what was found")
    assert label_at(visit, 0.5, 0.5, last) == Label.FLUID and label_at(visit, 0.1, 0.5, last) == Label.BACKGROUND
    visit.says("s on")
    visit.page.get_by_label("from here on").uncheck()
    visit.page.get_by_label("frame", exact=True).fill("0")
    visit.page.keyboard.press("r")
    assert visit.page.locator("#picture").bounding_box() == picture, "it stays where it is whichever tool is taken"


def test_an_area_is_closed_by_enter_and_taken_back_by_its_line(visit):
    visit.area("not fluid", (0.1, 0.4), (0.3, 0.4), (0.3, 0.6), (0.1, 0.6))
    visit.until(lambda: label_at(visit, 0.2, 0.5) == Label.BACKGROUND, "the mask without the area")
    visit.page.get_by_label("take back: not fluid: area 1").click()
    visit.until(lambda: label_at(visit, 0.2, 0.5) == Label.FLUID, "the mask as before")


def test_the_horizon_is_dragged_and_the_tilt_follows(visit):
    visit.page.keyboard.press("h")
    h, w = visit.desk.info["size"][1], visit.desk.info["size"][0]
    ends = visit.page.evaluate("window.studio.handles()")
    for k, x in enumerate((0.0, 1.0)):
        at = ends[k]["at"]
        visit.drag((at[0] / w, at[1] / h), (x, -0.2))
        visit.until(lambda: visit.desk.history.hints.horizon is not None, "a horizon")
        visit.shown()
    visit.looked()
    (_, left), (_, right) = visit.desk.history.hints.horizon
    assert left == pytest.approx(-0.2 * h, abs=0.02 * h) and right == pytest.approx(left, abs=0.02 * h)
    visit.says("(as said)")
    visit.page.fill("#pitch", "70")
    visit.page.keyboard.press("Enter")
    visit.until(lambda: visit.desk.history.hints.pitch == 70.0, "the pitch in its place")
    assert visit.desk.history.hints.horizon is None


def test_kind_and_ruler_are_taken(visit):
    visit.page.get_by_label("kind", exact=True).select_option("fall")
    visit.until(lambda: visit.desk.looking.look.facts["kind"] == "fall", "the kind")
    visit.page.keyboard.press("r")
    visit.page.fill("#metres", "2.5")
    visit.drag((0.2, 0.5), (0.7, 0.5))
    visit.until(lambda: "ruler" in visit.desk.looking.look.facts["scale"], "the scale")
    visit.says("by the ruler laid along it")


def test_a_rim_is_drawn_and_moved_by_its_handles(visit):
    visit.page.keyboard.press("e")
    visit.drag((0.3, 0.3), (0.7, 0.6))
    visit.until(lambda: len(visit.desk.history.hints.rims) == 1, "a rim")
    visit.shown()
    center = visit.desk.history.hints.rims[0].center
    w, h = visit.desk.info["size"]
    visit.drag((center[0] / w, center[1] / h), (0.4, 0.4))
    visit.until(lambda: visit.desk.history.hints.rims[0].center != center, "the rim elsewhere")
    assert visit.desk.history.hints.rims[0].center == pytest.approx((0.4 * w, 0.4 * h), abs=2.0)


def test_an_arrow_that_was_found_is_turned_by_its_head_and_moved_by_its_tail(visit):
    visit.page.keyboard.press("f")
    w, h = visit.desk.info["size"]
    found = [x for x in visit.page.evaluate("window.studio.handles()") if x["kind"] == "arrow-found"]
    assert len(found) > 3
    arrow = min(found, key=lambda x: abs(x["from"][0] / w - 0.5) + abs(x["from"][1] / h - 0.5))
    (ax, ay), (bx, by) = arrow["from"], arrow["at"]
    visit.drag((bx / w, by / h), ((2 * ax - bx) / w, (2 * ay - by) / h))
    visit.until(lambda: len(visit.desk.history.hints.flow) == 1, "the arrow")
    said = visit.desk.history.hints.flow[0]
    assert said.at == pytest.approx((ax, ay), abs=0.2) and said.to == pytest.approx((2 * ax - bx, 2 * ay - by), abs=2.0)
    visit.looked()
    near = min(visit.desk.looking.look.facts["flow"], key=lambda a: abs(a["at"][0] - ax) + abs(a["at"][1] - ay))
    assert (near["to"][0] - near["at"][0]) * (bx - ax) + (near["to"][1] - near["at"][1]) * (by - ay) < 0
    visit.says("arrow 1 of the flow")
    visit.shown()
    visit.drag((ax / w, ay / h), (ax / w + 0.1, ay / h))
    visit.until(lambda: visit.desk.history.hints.flow[0].at[0] > ax + 0.05 * w, "the arrow elsewhere")
    assert len(visit.desk.history.hints.flow) == 1
    visit.press("Undo")
    visit.press("Undo")
    visit.until(lambda: visit.desk.history.hints.flow == (), "no arrow")


def test_a_new_arrow_and_a_level_line_are_drawn_and_taken_back_by_their_lines(visit):
    visit.page.keyboard.press("f")
    w, _ = visit.desk.info["size"]
    visit.drag((0.02, 0.02), (0.1, 0.02))  # where no arrow was found
    visit.until(lambda: len(visit.desk.history.hints.flow) == 1, "the arrow")
    assert visit.desk.history.hints.flow[0].direction == pytest.approx((1.0, 0.0), abs=0.05)
    visit.page.get_by_label("take back: arrow 1 of the flow").click()
    visit.until(lambda: visit.desk.history.hints.flow == (), "no arrow")
    visit.page.keyboard.press("l")
    visit.drag((0.1, 0.5), (0.9, 0.5))
    visit.until(lambda: visit.desk.history.hints.level is not None, "the level line")
    visit.shown()
    visit.drag((0.9, 0.5), (0.9, 0.6))
    visit.until(lambda: visit.desk.history.hints.level[1][1] > visit.desk.history.hints.level[0][1] + 2, "it is tilted")
    visit.looked()
    assert abs(visit.desk.looking.look.facts["roll"]) > 1.0 and visit.desk.history.hints.level[1][0] > 0.8 * w


def test_a_ledge_that_runs_uphill_is_told_in_the_picture_with_the_way_out(visit):
    visit.area("ledge", (0.3, 0.3), (0.7, 0.3), (0.7, 0.8), (0.3, 0.8))
    visit.until(lambda: len(visit.desk.history.hints.regions) == 1, "the ledge")
    visit.page.keyboard.press("f")
    visit.shown()
    visit.desk.change(lambda history: history.change({"add": "flow", "item": arrow_up(visit.desk)}))
    visit.says("ledge 1 runs uphill: arrow 1 of the flow points up it")
    visit.page.get_by_label("take back: arrow 1 of the flow").click()
    visit.until(lambda: not visit.desk.looking.look.error, "the end of the trouble")


def arrow_up(desk):
    w, h = desk.info["size"]
    return {"at": [0.5 * w, 0.7 * h], "to": [0.5 * w, 0.4 * h]}


def test_what_is_known_of_the_camera_and_the_parts_stands_beside_the_picture(visit):
    visit.says("stands still")
    rows = visit.page.locator("#found tr").all_inner_texts()
    assert any(row.startswith("Slope") for row in rows) and any(row.startswith("Camera") for row in rows)


def test_strokes_that_leave_no_fluid_are_told_with_the_way_back(visit):
    visit.area("not fluid", (0.001, 0.001), (0.999, 0.001), (0.999, 0.999), (0.001, 0.999))
    visit.says("leave no fluid (region 1 takes it away)")
    visit.press("Undo")
    visit.until(lambda: not visit.desk.looking.look.error, "the end of the trouble")


def test_the_strip_trims_the_clip(visit):
    frames = len(visit.desk.looking.look.read.clip)
    handle = visit.page.locator("#trim-end").bounding_box()
    strip = visit.page.locator("#strip").bounding_box()
    visit.page.mouse.move(handle["x"] + 3, handle["y"] + 20)
    visit.page.mouse.down()
    visit.page.mouse.move(strip["x"] + 0.5 * strip["width"], handle["y"] + 20, steps=5)
    visit.page.mouse.up()
    visit.until(lambda: len(visit.desk.looking.look.read.clip) < 0.7 * frames, "fewer frames")
    visit.says("s long")


def test_two_windows_show_the_same_and_one_may_close_in_the_middle(visit, visitor, served):
    other = visitor(served)
    other.page.get_by_label("kind", exact=True).select_option("pour")
    visit.says("kind: pour")
    other.page.close()
    visit.looked()
    assert visit.desk.looking.look.facts["kind"] == "pour"


def test_a_new_desk_over_the_folder_goes_on_where_the_old_one_was(visit):
    from fluidlift.studio.desk import Desk

    visit.page.get_by_label("kind", exact=True).select_option("fall")
    visit.until(lambda: visit.desk.history.hints.kind == "fall", "the hint")
    again = Desk(visit.desk.folder)  # as after the program was killed: nothing of it was told to end
    try:
        again.open("stream.mp4")
        assert again.history.hints.kind == "fall" and again.history.can_undo
        again.history.undo()
        assert again.history.hints.kind is None
        again.history.redo()
    finally:
        again.close()


LATE = 500
"""ms by which an answer comes after the state that it led to: the events of a page come on their own connection"""


def answered_late(route):
    answer = route.fetch()
    time.sleep(0.001 * LATE)
    route.fulfill(response=answer)


def test_a_file_that_is_no_clip_is_refused_in_the_page(visit, tmp_path):
    (tmp_path / "notes.txt").write_text("no film")
    visit.page.set_input_files("#file", str(tmp_path / "notes.txt"))
    visit.says("is no video by its name")
    visit.page.keyboard.press("Escape")
    (tmp_path / "broken.mp4").write_bytes(b"no film either" * 100)
    visit.page.route("**/clips?*", answered_late)
    visit.page.set_input_files("#file", str(tmp_path / "broken.mp4"))
    visit.until(lambda: visit.desk.error, "the refusal")
    visit.until(lambda: "not a video" in visit.page.locator("#message").inner_text(), "the refusal on the page")
    visit.page.wait_for_timeout(2 * LATE)
    assert visit.page.locator("#message").is_visible(), "an answer that has nothing to say took the refusal away"
    visit.page.unroute("**/clips?*")
    visit.page.get_by_label("clip", exact=True).select_option("stream.mp4")
    visit.looked()


DROP = """([name, data]) => {
  const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0)), carried = new DataTransfer();
  carried.items.add(new File([bytes], name, { type: "video/mp4" }));
  const stage = document.getElementById("stage");
  for (const kind of ["dragenter", "dragover", "drop"])
    stage.dispatchEvent(new DragEvent(kind, { dataTransfer: carried, bubbles: true, cancelable: true }));
}"""


def test_a_clip_is_dropped_on_the_picture(visit, stream_clip):
    visit.page.evaluate(DROP, ["dropped.mp4", base64.b64encode(stream_clip.read_bytes()).decode()])
    visit.until(lambda: visit.desk.clip is not None and visit.desk.clip.name == "dropped.mp4", "the clip")
    assert (visit.desk.folder / "dropped.mp4").read_bytes() == stream_clip.read_bytes()
    assert "over" not in (visit.page.locator("#stage").get_attribute("class") or "")
    visit.looked()
    visit.page.get_by_label("clip", exact=True).select_option("stream.mp4")
    visit.looked()


def test_a_page_that_is_closed_in_the_middle_of_a_make_does_not_end_it(visitor, served, window):
    other = visitor(served)
    other.tab("Make")
    other.page.locator("#make").click()
    other.until(lambda: len(served.desk.making.state.finished) >= 1, "the first stage")
    other.page.close()
    window.page.wait_for_timeout(300)
    state = served.desk.making.state
    assert state.running or state.outcome.startswith("made"), state
    window.until(lambda: len(served.desk.making.state.finished) >= 2, "the next stage")
    again = visitor(served)
    again.tab("Make")
    again.says("read:")
    again.page.close()
    served.desk.making.stop()
    window.until(lambda: not served.desk.making.state.running, "the stop")
    assert window.complaints == []


def make_whole(visit):
    """Press Make and wait for the end of it; what is done already is not made again."""
    making = visit.desk.making
    visit.page.locator("#make").click()
    visit.until(lambda: making.state.running or making.state.outcome.startswith("made"), "the make")
    visit.until(lambda: not making.state.running, "the end", 900.0)


def test_make_can_be_stopped_goes_on_and_lies_on_the_shelf(visit):
    desk = visit.desk
    visit.page.keyboard.press("v")
    visit.tab("Make")
    visit.page.locator("#make").click()
    visit.until(lambda: len(desk.making.state.finished) >= 1, "the first stage")
    visit.press("Stop")
    visit.until(lambda: not desk.making.state.running, "the stop")
    visit.says("what was done is kept")
    make_whole(visit)
    assert desk.making.state.finished[0]["kept"], desk.making.state
    visit.says("made in")
    visit.tab("Shelf")
    visit.says("stream.fluid")
    visit.press("Duplicate")
    visit.until(lambda: (desk.folder / "stream-copy.fluid").is_dir(), "the copy")
    visit.page.locator(".card", has_text="stream-copy.fluid").get_by_role("button", name="To the trash").click()
    visit.until(lambda: not (desk.folder / "stream-copy.fluid").exists(), "the trash")
    visit.press("Restore")
    visit.until(lambda: (desk.folder / "stream-copy.fluid").is_dir(), "what was restored")


@pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed")
def test_the_result_opens_in_the_viewer(visit):
    if not visit.desk.making.state.outcome.startswith("made"):  # alone, or in another worker than the test above
        visit.tab("Make")
        make_whole(visit)
    visit.tab("Shelf")
    with visit.page.expect_popup() as opened:
        visit.page.locator(".card", has_text="stream.fluid").get_by_role(
            "button", name="Open in the viewer"
        ).first.click()
    end = time.monotonic() + 120
    while not opened.value.url.startswith("http://127.0.0.1") and time.monotonic() < end:
        visit.page.wait_for_timeout(100)
    assert opened.value.url.startswith("http://127.0.0.1")
    opened.value.close()
