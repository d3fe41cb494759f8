"""A batch whose assets belong on a store that fsspec reaches."""

import json
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import fsspec
import pytest

from fluidlift.cli import REJECTED, main
from fluidlift.errors import MissingPackage
from fluidlift.farm import local
from fluidlift.farm.engine import Limits
from fluidlift.farm.local import LocalEngine
from fluidlift.farm.store import Store, is_url


@pytest.fixture(params=["memory", "file"])
def store(request, tmp_path) -> Store:
    """One in memory, which keys alone name, and one of files."""
    memory = fsspec.filesystem("memory")
    for path in memory.find("/"):
        memory.rm_file(path)
    url = "memory://bucket/assets" if request.param == "memory" else f"file://{tmp_path}/there"
    return Store(url, tmp_path / "scratch")


@pytest.fixture
def stand_in(limits, monkeypatch) -> Limits:
    """Every make of the command line is the stand-in."""
    whole = local.make_shot

    def make_shot(shot, folder, bounds, *rest):
        return whole(shot, folder, replace(bounds, program=limits.program), *rest)

    monkeypatch.setattr(local, "make_shot", make_shot)
    return limits


def place(store: Store):
    return fsspec.core.url_to_fs(store.url)


def names(store: Store) -> set[str]:
    """Of all that lies there."""
    fs, root = place(store)
    return {path.removeprefix(root + "/") for path in fs.find(root)}


def made(store: Store, shots, limits) -> dict:
    store.require()
    store.pull()
    engine = LocalEngine(2, store)
    return {o.name: o for o in engine.shots(shots, store.folder, limits, lambda text: None, lambda text: None)}


def test_assets_lie_there_and_nothing_is_made_twice(store, limits, shot, runs):
    shots = [shot("a"), shot("w", "wrong")]
    first = made(store, shots, limits)
    assert {n: o.outcome for n, o in first.items()} == {"a": "done", "w": "rejected"}
    assert first["a"].asset == f"{store.url}/a.fluid" and not (store.folder / "a.fluid").exists()
    assert names(store) == {"a.fluid/manifest.json", "a.log", "a.state.json", "w.log", "w.state.json"}
    for old in store.folder.glob("*.state.json"):  # as another machine, which knows of nothing
        old.unlink()
    assert made(store, shots, limits)["a"] == first["a"]
    assert (runs(store.folder, "a"), runs(store.folder, "w")) == (1, 2)


def test_an_asset_of_other_options_takes_the_place_of_the_one_before(store, limits, shot, runs):
    made(store, [shot("a")], limits)
    fs, root = place(store)
    fs.makedirs(f"{root}/a.fluid/frames", exist_ok=True)
    fs.pipe_file(f"{root}/a.fluid/frames/1002.ply", b"of the one before")
    fs.pipe_file(f"{root}/b.txt", b"somebody's")
    assert made(store, [shot("a", size=0.1)], limits)["a"].well and runs(store.folder, "a") == 2
    assert names(store) == {"a.fluid/manifest.json", "a.log", "a.state.json", "b.txt"}


def test_an_asset_that_is_there_in_part_is_made_again(store, limits, shot, runs):
    made(store, [shot("a")], limits)
    fs, root = place(store)
    fs.pipe_file(f"{root}/a.fluid/manifest.json", b"{}")  # another batch's, which was killed before its state
    assert made(store, [shot("a")], limits)["a"].well and runs(store.folder, "a") == 2
    fs.rm_file(f"{root}/a.state.json")
    assert made(store, [shot("a")], limits)["a"].well and runs(store.folder, "a") == 3


def test_what_strangers_put_there_counts_as_absent(store, limits, shot, runs, tmp_path):
    made(store, [shot("a")], limits)
    fs, root = place(store)
    state = fs.cat_file(f"{root}/a.state.json")
    for bad in (b"{", state.replace(b'"a"', b'"b"', 1), state + b" " * (1 << 20), b"[]"):
        fs.pipe_file(f"{root}/a.state.json", bad)
        fs.pipe_file(f"{root}/..evil.state.json", state)
        store.pull()
        assert not list(store.folder.glob("*.state.json")) and store.finished(shot("a")) is None
    if store.url.startswith("file"):
        (tmp_path / "else.json").write_bytes(state)
        fs.rm_file(f"{root}/a.state.json")
        Path(root, "a.state.json").symlink_to(tmp_path / "else.json")
        store.pull()
        assert not list(store.folder.glob("*.state.json")) and store.finished(shot("a")) is None


def test_no_link_is_followed_on_the_way_there(store, limits, shot, tmp_path):
    (tmp_path / "secret").write_text("key")
    script = Path(limits.program[1])
    script.write_text(
        script.read_text().replace("told = {", f"(out / 'x').symlink_to({str(tmp_path / 'secret')!r})\ntold = {{")
    )
    outcome = made(store, [shot("a")], limits)["a"]
    assert outcome.outcome == "failed" and "is a link" in outcome.reason and "a.fluid/x" not in names(store)
    if store.url.startswith("file"):  # nor is what lies behind one there removed
        outside = tmp_path / "outside"
        outside.mkdir()
        (outside / "kept.txt").write_text("kept")
        Path(place(store)[1], "b.fluid").mkdir(parents=True)
        Path(place(store)[1], "b.fluid", "frames").symlink_to(outside)
        script.write_text(script.read_text().replace("(out / 'x')", "(out.parent / 'y')"))
        assert "is a link" in made(store, [shot("b")], limits)["b"].reason
        assert (outside / "kept.txt").exists()


def test_a_store_that_breaks_down_fails_the_shot_and_the_next_try_puts_it_there(store, limits, shot, runs, monkeypatch):
    fs, _ = place(store)
    with monkeypatch.context() as broken:
        broken.setattr(type(fs), "put_file", lambda *a, **k: (_ for _ in ()).throw(ConnectionError("reset")))
        outcome = made(store, [shot("a")], limits)["a"]
    assert (outcome.outcome, outcome.failure) == ("failed", "crash") and "reset" in outcome.reason
    assert (store.folder / "a.fluid").exists() and not any(n.startswith("a.fluid") for n in names(store))
    assert made(store, [shot("a")], limits)["a"].well


def test_the_command_says_how_far_a_store_is_and_what_it_cannot_do(store, stand_in, shot, capsys, runs, tmp_path):
    clip = shot("a").clip
    there = ["-o", store.url, "--scratch", str(store.scratch)]
    assert main(["batch", str(clip), *there, "--csv"]) == 0
    said = capsys.readouterr().out
    assert f"summary: {store.url}/batch.json" in said and "locks do not reach" in said
    assert {"batch.json", "batch.csv", "shots.json", "a.fluid/manifest.json"} <= names(store)
    assert main(["batch", str(clip), *there, "--warnings-ok"]) == 0 and runs(store.folder, "a") == 1
    capsys.readouterr()
    assert main(["batch", "--status", "--json", "-o", store.url, "--scratch", str(tmp_path / "elsewhere")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["done"] == 1 and found["shots"][0]["asset"] == f"{store.url}/a.fluid"
    for option in (["--plan", "slurm"], ["--status", "--html"]):
        assert main(["batch", str(clip), *there, *option]) == REJECTED
        assert "fetch the assets, or mount the store" in capsys.readouterr().err


def test_what_is_wrong_with_a_store_is_said_before_work_starts(tmp_path, shot, capsys):
    clip = str(shot("a").clip)
    for url, said in {
        "nothing://bucket/x": "cannot be written", "s3://user:pass@bucket/x": "password",
        "simplecache::memory://x": "", "memory://": "whole store", "file:///proc/none/there": "cannot be written",
    }.items():  # fmt: skip
        if is_url(url):
            assert main(["batch", clip, "-o", url, "--scratch", str(tmp_path)]) == REJECTED
            assert said in capsys.readouterr().err
    assert main(["batch", clip, "-o", str(tmp_path / "out"), "--scratch", str(tmp_path)]) == REJECTED
    assert not list(tmp_path.rglob("*.log"))


def test_what_reaches_a_store_and_is_not_installed_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(MissingPackage, match=r"fluidlift\[store\].*gcsfs"):
        Store("gs://bucket/x", tmp_path).require()


def test_two_batches_at_a_time_leave_assets_that_are_whole(store, limits, shot, tmp_path):
    """From two machines, whose locks do not meet: what one of them left, or what is made again."""
    other = Store(store.url, tmp_path / "other")
    shots = [shot(n, size=0.2) for n in "abc"]
    beside = threading.Thread(target=made, args=(other, shots, limits))
    beside.start()
    time.sleep(0.1)
    made(store, shots, limits)
    beside.join()
    found = made(store, shots, limits)
    assert all(o.well for o in found.values()) and all(store.finished(s) for s in shots)
