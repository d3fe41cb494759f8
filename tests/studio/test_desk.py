"""The desk without a browser: hints and their steps on disk, who is let in, names, and the shelf."""

import asyncio
import json
import shutil
from dataclasses import replace
from inspect import signature

import numpy as np
import pytest

pytest.importorskip("starlette", reason="starlette is not installed: pip install 'fluidlift[studio]'")

from fluidlift.cli import REJECTED, main
from fluidlift.errors import InputRejected
from fluidlift.io.hints_file import read_hints
from fluidlift.pipeline.models import Chosen, ModelWish
from fluidlift.studio.app import app_of, open_desk
from fluidlift.studio.clips import name_for
from fluidlift.studio.history import HintsHistory
from fluidlift.studio.looking import LOOK_FLOW, LOOK_SECONDS, LOOK_SIZE, FindRequest, look_config
from fluidlift.studio.making import MakeJob
from fluidlift.studio.making import main as making
from fluidlift.studio.shelf import Shelf
from fluidlift.studio.stage_pictures import StagePictures, flow_picture
from fluidlift.types.hints import ClipHints, ClipIdentity

SIZE = (320, 200)
AREA = {"is": "rock", "area": [[10, 10], [30, 10], [30, 30]]}


@pytest.fixture
def history(tmp_path):
    return steps_of(tmp_path)


def steps_of(folder):
    clip = folder / "a.mp4"
    clip.write_bytes(b"film")
    return HintsHistory(clip, folder / "a.hints.yaml", folder / "room" / "steps.json", ClipIdentity("a.mp4", SIZE))


def test_each_step_is_on_disk_and_can_be_taken_back_after_a_new_start(history, tmp_path):
    history.change({"set": "kind", "to": "pour"})
    history.change({"add": "regions", "item": AREA})
    assert read_hints(history.file).regions[0].what == "rock"
    again = steps_of(tmp_path)
    assert again.hints == history.hints and again.can_undo
    again.undo()
    assert again.hints.regions == () and again.hints.kind == "pour" and again.can_redo
    again.redo()
    assert read_hints(history.file).regions[0].what == "rock"


def test_several_entries_are_one_step(history):
    history.change({"set": ["start", "duration"], "to": [0.5, 1.0]})
    assert (history.hints.start, history.hints.duration) == (0.5, 1.0)
    history.undo()
    assert history.hints.start is None and not history.can_undo


def test_items_are_replaced_and_removed_by_their_place(history):
    history.change({"add": "clicks", "item": {"at": [1, 2], "fluid": True}})
    history.change({"put": "clicks", "at": 0, "item": {"at": [5, 6], "fluid": False}})
    assert history.hints.clicks[0].at == (5.0, 6.0)
    history.change({"remove": "clicks", "at": 0})
    assert history.hints.clicks == ()


def test_points_stay_where_they_were_drawn_though_another_frame_is_shown(history, tmp_path):
    click = {"at": [10.0, 20.0], "fluid": True}
    history.shown_time = 0.5
    history.change({"add": "clicks", "item": click})
    assert read_hints(history.file).clip.time == 0.5 and history.shown["clicks"] == [click]
    again = steps_of(tmp_path)  # another trim is laid on another frame, which looks 4 px to the right
    assert again.time == 0.5
    again.shown_time, again.shift = 1.5, (-4.0, 0.0)
    assert again.shown["clicks"] == [{"at": [6.0, 20.0], "fluid": True}]
    again.change({"put": "clicks", "at": 0, "item": {"at": [8.0, 20.0], "fluid": True}})
    assert read_hints(again.file).clicks[0].at == (12.0, 20.0) and read_hints(again.file).clip.time == 0.5
    again.undo()
    assert read_hints(again.file).clicks[0].at == (10.0, 20.0)


@pytest.mark.parametrize(
    "step",
    [
        {}, {"set": "found", "to": 1}, {"add": "clip", "item": 1}, {"remove": "regions", "at": 0},
        {"set": "kind", "to": "soup"}, {"add": "regions", "item": {"is": "rock"}}, {"set": ["start"], "to": 5},
        {"put": "rims", "at": "x", "item": {}},
    ],
)  # fmt: skip
def test_a_step_that_does_not_hold_changes_nothing(history, step):
    history.change({"set": "kind", "to": "dam"})
    before = history.file.read_bytes()
    with pytest.raises((InputRejected, ValueError)):
        history.change(step)
    assert history.file.read_bytes() == before and history.hints.kind == "dam"


def test_a_step_leaves_every_point_of_the_steps_before_as_it_is(history, tmp_path):
    history.change({"add": "clicks", "item": {"at": [141.18269, 62.40001], "fluid": True}})
    clicks = history.hints.clicks
    history.change({"add": "flow", "item": {"at": [15.123, 15.123], "to": [15.123, 11.456]}})
    assert history.hints.clicks == clicks == steps_of(tmp_path).hints.clicks


def test_what_another_program_writes_is_taken_over(history):
    history.change({"set": "kind", "to": "dam"})
    history.file.write_text(history.file.read_text().replace("dam", "fall"))
    history.change({"set": "fov", "to": 60})
    assert history.hints.kind == "fall" and read_hints(history.file).fov == 60.0


def test_damaged_steps_are_forgotten_and_damaged_hints_are_told(history, tmp_path):
    history.change({"set": "kind", "to": "dam"})
    (tmp_path / "room" / "steps.json").write_text("[1, 2")
    assert not steps_of(tmp_path).can_undo
    history.file.write_text("hints: 1\nkind: soup\n")
    with pytest.raises(InputRejected, match="kind = soup"):
        steps_of(tmp_path)


def ask(app, path, method="GET", headers=()):
    """Status, headers and body of a request."""
    found = {"body": b""}
    scope = {
        "type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": b"", "headers": [
            (b"host", b"127.0.0.1:8180"), *((k.encode(), v.encode()) for k, v in headers)
        ], "http_version": "1.1", "scheme": "http", "server": ("127.0.0.1", 8180), "client": ("127.0.0.1", 9),
    }  # fmt: skip

    async def receive():
        return {"type": "http.request", "body": b"{}", "more_body": False}

    async def send(message):
        if message["type"] == "http.response.start":
            found.update(status=message["status"], headers=dict(message["headers"]))
        else:
            found["body"] += message.get("body", b"")

    asyncio.run(app(scope, receive, send))
    return found


OWN = (("origin", "http://127.0.0.1:8180"),)


@pytest.mark.parametrize(
    ("path", "method", "headers", "status"),
    [
        ("/secret/", "GET", (), 200),
        ("/secret/state", "GET", (), 200),
        ("/", "GET", (), 403),
        ("/wrong/state", "GET", (), 403),
        ("/secret/state", "GET", (("origin", "http://evil.example"),), 403),
        ("/secret/do/undo", "POST", (), 403),
        ("/secret/do/undo", "POST", (("origin", "http://127.0.0.1:9999"),), 403),
        ("/secret/do/undo", "POST", OWN, 200),
        ("/secret/do/anything", "POST", OWN, 404),
        ("/secret/page/../app.py", "GET", (), 404),
        ("/secret/page/studio.js", "GET", (), 200),
        ("/secret/first.jpg", "GET", (), 204),
    ],
)
def test_only_who_knows_the_address_is_let_in(desk, path, method, headers, status):
    found = ask(app_of(desk, "secret"), path, method, headers)
    assert found["status"] == status
    if path.startswith("/secret") and status != 403:
        policy = found["headers"][b"content-security-policy"]
        assert b"frame-ancestors 'none'" in policy and found["headers"][b"referrer-policy"] == b"no-referrer"


def test_another_name_of_the_host_is_not_served(desk):
    app = app_of(desk, "secret")
    scope_host = (("host", "evil.example:8180"),)
    assert ask(app, "/secret/state", headers=scope_host)["status"] == 403


def test_without_a_clip_nothing_can_be_said(desk):
    found = json.loads(ask(app_of(desk, "secret"), "/secret/do/undo", "POST", OWN)["body"])
    assert "no clip is open" in found["error"]


@pytest.mark.parametrize("name", ["../../etc/passwd.mp4", "a\\b\\river.mp4", "  river .mp4", "x" * 300 + ".mp4"])
def test_a_dropped_clip_stays_in_the_folder(tmp_path, name):
    path = name_for(tmp_path, name)
    assert path.parent == tmp_path and path.suffix == ".mp4" and len(path.name) <= 125 and not path.name.startswith(".")


def test_a_dropped_clip_takes_no_name_that_is_there(tmp_path):
    (tmp_path / "river.mp4").touch()
    assert name_for(tmp_path, "river.mp4").name == "river-2.mp4"
    with pytest.raises(InputRejected, match="no video by its name"):
        name_for(tmp_path, "river.exe")


def test_a_place_that_is_neither_clip_nor_folder_is_refused(tmp_path):
    (tmp_path / "a.txt").touch()
    for name in ("a.txt", "nothing.mp4"):
        with pytest.raises(InputRejected):
            open_desk(tmp_path / name)


def test_a_hints_file_that_cannot_be_used_is_told_and_moved_aside(desk, monkeypatch):
    monkeypatch.setattr(desk.looking, "ask", lambda wish: None)
    file = desk.folder / "stream.hints.yaml"
    file.write_text("hints: 1\nclip: {size: [96, 64], sha256: abc, name: other.mp4}\n")
    desk.open("stream.mp4")
    state = desk.state()
    assert "belongs to another clip" in state["error"] and state["broken"] == file.name and state["hints"] is None
    desk.fresh_hints()
    assert desk.state()["error"] == "" and desk.state()["hints"] is not None
    assert len(list(desk.folder.glob("stream.hints.yaml.*.old"))) == 1


def test_a_clip_that_cannot_be_read_is_told(desk):
    (desk.folder / "broken.mp4").write_bytes(b"no film" * 50)
    desk.open("broken.mp4")
    assert "broken.mp4" in desk.state()["error"]


@pytest.mark.parametrize("duration", [None, 1.5])
def test_a_look_is_short_where_nothing_is_trimmed(duration):
    config = look_config(ClipHints(duration=duration))
    assert config.read.duration == (duration or LOOK_SECONDS) and config.read.max_size == LOOK_SIZE


def test_a_newer_wish_overtakes_slow_work_only_where_that_depends_on_it(desk, tmp_path):
    def wish(**hints):
        return FindRequest(tmp_path / "a.mp4", ClipHints(**hints), tmp_path)

    looking, old = desk.looking, wish()
    for newer, at_once in ((wish(kind="pour"), False), (wish(start=1.0), True)):
        looking._wish = newer  # without waking the thread
        assert looking.overtaken(old, between=True)
        assert looking.overtaken(old, between=False) == at_once
    looking._wish = None


def test_every_preset_can_be_made_and_no_other(desk, monkeypatch):
    from fluidlift.config import PRESETS

    asked = []
    monkeypatch.setattr(desk.making, "start", lambda job: asked.append(job.preset) or True)
    desk.open("stream.mp4")
    assert desk.state()["presets"] == list(PRESETS)
    for preset in desk.state()["presets"]:
        desk.make(preset)
    assert asked == ["draft", "standard", "hero", "paper"]
    with pytest.raises(InputRejected, match="'best'"):
        desk.make("best")


def test_learned_models_of_a_studio_count_in_looks_and_makes(desk, monkeypatch, tmp_path):
    seen = []

    def taken(config, inputs, asked):
        seen.append(asked)
        learned = replace(config.motion, method="sea-raft")
        return Chosen(replace(config, segment=replace(config.segment, method="sam2"), motion=learned), ("masks by x",))

    monkeypatch.setattr("fluidlift.pipeline.models.with_models", taken)
    wish = ModelWish("x", "research")
    look = look_config(ClipHints(), wish)
    assert (look.segment.method, look.motion.method) == ("sam2", LOOK_FLOW)  # flow of pairs is what a look has time for
    assert look.generate.use == "research" and seen == ["x"]
    job = MakeJob(tmp_path / "a.mp4", None, tmp_path / "a.fluid", "draft", tmp_path, wish)
    assert job.arguments()[-2:] == ["x", "research"] and len(job.arguments()) == len(signature(making).parameters)


def test_a_studio_with_a_model_that_is_not_there_is_not_opened(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FLUIDLIFT_MODELS", str(tmp_path / "cache"))
    assert main(["studio", str(tmp_path), "--no-browser", "--models", "depth-pro"]) == REJECTED
    assert "fluidlift models get depth-pro" in capsys.readouterr().err


def test_colours_of_the_flow_tell_directions_apart():
    way = np.zeros((4, 8, 2), np.float32)
    way[:, :4, 0], way[:, 4:, 0] = 2.0, -2.0
    picture = flow_picture(way)
    assert np.abs(picture[0, 0].astype(int) - picture[0, 7].astype(int)).max() > 100


def test_stages_without_a_picture_leave_none(tmp_path):
    pictures = StagePictures(tmp_path / "making")
    pictures.told("fit", object())
    assert list((tmp_path / "making").iterdir()) == []


def test_a_wrong_place_is_rejected_on_the_command_line(tmp_path, capsys):
    from fluidlift.cli import _run

    assert _run(["studio", str(tmp_path / "nothing.mp4"), "--no-browser"]) == 3
    assert "no such clip or folder" in capsys.readouterr().err


def test_the_shelf_copies_discards_and_restores(finished_tank_copy):
    shelf = Shelf(finished_tank_copy, finished_tank_copy / ".room")
    (entry,) = shelf.entries()
    assert entry["name"] == "tank.fluid" and entry["bytes"] > 1000 and entry["verdict"]
    assert shelf.duplicate("tank.fluid") == "tank-copy.fluid"
    thrown = shelf.discard("tank.fluid")
    assert [e["name"] for e in shelf.entries()] == ["tank-copy.fluid"] and shelf.trashed() == [thrown]
    assert shelf.restore(thrown) == "tank.fluid" and shelf.trashed() == []


@pytest.fixture
def finished_tank_copy(tmp_path):
    """A folder with a small asset."""
    from small_asset import small_asset

    from fluidlift.io.asset_folder import save_asset

    save_asset(tmp_path / "tank.fluid", small_asset())
    return tmp_path


@pytest.mark.parametrize("name", ["../tank.fluid", "none.fluid", "", "tank"])
def test_the_shelf_knows_its_own_assets_only(finished_tank_copy, name):
    with pytest.raises(InputRejected):
        Shelf(finished_tank_copy, finished_tank_copy / ".room").path(name)


def test_a_linked_asset_is_not_on_the_shelf(finished_tank_copy, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "real.fluid"
    shutil.move(finished_tank_copy / "tank.fluid", elsewhere)
    (finished_tank_copy / "link.fluid").symlink_to(elsewhere)
    shelf = Shelf(finished_tank_copy, finished_tank_copy / ".room")
    assert shelf.entries() == []
    with pytest.raises(InputRejected):
        shelf.path("link.fluid")
