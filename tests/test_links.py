"""Links inside an asset lead nowhere: nothing outside is read, written or deleted, and what is wrong is said."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
from catalogue import write_clip
from fuzz.trial import Watched
from small_asset import random_gaussians, small_asset

from fluidlift.cli import REJECTED, main
from fluidlift.errors import InputRejected
from fluidlift.io.asset_folder import save_asset, update_manifest
from fluidlift.io.asset_lock import editing, writing
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.checkpoint import Checkpoint, write_checkpoint
from fluidlift.io.stage_cache import Scratch, load_stage, save_stage
from fluidlift.scene.splat_files import checkpoint_file, frame_file, frame_files, write_frame

PLACES = (
    "frames", "frames/splats", "frames/splats/1002.flsp", "work", "work/simulate", "work/checkpoint",
    "work/checkpoint/simulation.npz", "work/simulate/k.json", "rest", "rest/velocity.npz", "edits", "scene.yaml",
    "manifest.json", "preview.mp4", "mask",
)  # fmt: skip
COMMANDS = {
    "sim": ("sim", "{asset}"),
    "sim again": ("sim", "{asset}", "--restart"),
    "sim on": ("sim", "{asset}", "--resume"),
    "fit": ("fit", "{asset}"),
    "edit": ("edit", "{asset}", "--set", "parameters.density=900"),
    "undo": ("edit", "{asset}", "--undo"),
    "validate": ("validate", "{asset}"),
    "render": ("render", "{asset}", "--out", "{out}"),
    "export": ("export", "{asset}", "--to", "splats", "--out", "{out}"),
    "evaluate": ("evaluate", "{asset}"),
    "make": ("make", "{clip}", "--out", "{asset}"),
    "mask": ("mask", "{clip}", "--out", "{asset}"),
    "motion": ("motion", "{clip}", "--out", "{asset}"),
}


@pytest.fixture(scope="module")
def watched():
    """One for all: a hook of Python's cannot be taken back."""
    return Watched()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A small asset with files of every sort, and a clip."""
    place = tmp_path_factory.mktemp("whole")
    folder = save_asset(place / "a.fluid", small_asset())
    for number in (1001, 1002):
        ids, moving = np.arange(20), np.zeros((20, 3), np.float32)
        write_frame(folder, number, random_gaussians(20), ids=ids, velocities=moving)
    (folder / "frames/splats/notes.json").write_text("{}")
    save_stage(folder, "simulate", "k", {"a": np.ones(3)}, {})
    held = Checkpoint(2, {"grid": "ab"}, {"x": np.ones(3)}, {"volume": np.ones(2)})
    write_checkpoint(folder / "work/checkpoint/simulation.npz", held)
    for name in ("edits/history.jsonl", "preview.mp4", "mask/1001.png", "work/velocities/k.rows"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"x")
    update_manifest(folder, simulation={"frames": 2, "frame_interval": 0.04})
    write_clip(place / "a.mp4", np.zeros((4, 32, 48, 3), np.uint8))
    return place


@pytest.fixture
def linked(whole, tmp_path):
    """Puts a link in the place of one part of the asset; gives the asset, what the part was, and all that it holds."""

    def link(name: str):
        asset, part = tmp_path / "a.fluid", tmp_path / "elsewhere" / "part"
        shutil.copytree(whole / "a.fluid", asset)
        part.parent.mkdir()
        (asset / name).rename(part)
        (asset / name).symlink_to(part)
        return asset, part

    return link


def held(part):
    files = [part, *part.rglob("*")] if part.is_dir() else [part]
    return {p: (p.stat().st_mtime_ns, p.stat().st_ino, p.read_bytes() if p.is_file() else b"") for p in files}


@pytest.mark.parametrize("name", PLACES)
def test_no_command_goes_through_a_link(whole, linked, watched, tmp_path, capsys, name):
    asset, part = linked(name)
    before = held(part)
    for command, words in COMMANDS.items():
        given = [w.format(asset=asset, out=tmp_path / "out", clip=whole / "a.mp4") for w in words]
        with watched.only(asset):
            code = main(given)
        said = capsys.readouterr().err
        assert code == REJECTED, (command, said)
        assert f"'{name}' in 'a.fluid' is a link to '{part}'" in said and "Do: " in said, (command, said)
        assert not [path for path in watched.found if path.startswith(str(part.parent))], command
        assert held(part) == before, command
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "do"),
    [
        ("work", lambda folder: save_stage(folder, "simulate", "k", {"a": np.ones(3)}, {})),
        ("work/simulate", lambda folder: save_stage(folder, "simulate", "k", {"a": np.ones(3)}, {})),
        ("work/simulate", lambda folder: load_stage(folder, "simulate", "k")),
        ("work/simulate", lambda folder: Scratch(folder, "simulate").array("a", (3,), np.float32)),
        ("work", lambda folder: writing(folder, "a test").__enter__()),
        ("edits", lambda folder: editing(folder).__enter__()),
        ("rest", lambda folder: save_asset(folder, small_asset())),
        ("manifest.json", lambda folder: update_manifest(folder, warnings=[])),
        ("frames", lambda folder: frame_files(folder)),
        ("frames/splats/1002.flsp", lambda folder: frame_files(folder)),
        ("frames/splats", lambda folder: asset_file(folder, "frames/splats/1001.flsp")),
    ],
)
def test_no_function_goes_through_a_link(linked, name, do):
    asset, part = linked(name)
    before = held(part)
    with pytest.raises(InputRejected, match="is a link"):
        do(asset)
    assert held(part) == before


def test_a_pipe_in_an_asset_holds_up_nobody(whole, tmp_path, capsys):
    shutil.copytree(whole / "a.fluid", tmp_path / "a.fluid")
    os.mkfifo(tmp_path / "a.fluid" / "work" / "simulate" / "owner")
    assert main(["sim", str(tmp_path / "a.fluid")]) == REJECTED
    assert "'work/simulate/owner' in 'a.fluid' is a pipe or a device" in capsys.readouterr().err


def test_an_asset_may_itself_be_reached_through_a_link(whole, tmp_path, capsys):
    (tmp_path / "b.fluid").symlink_to(whole / "a.fluid")
    assert main(["edit", str(tmp_path / "b.fluid"), "--diff"]) != REJECTED, capsys.readouterr().err


@pytest.mark.parametrize("name", ["frames", "frames/splats", "frames/splats/1001.flsp", "work", "work/checkpoint"])
def test_the_simulation_has_its_paths_from_the_same_place(linked, name):
    asset, _ = linked(name)
    with pytest.raises(InputRejected, match="is a link"):
        frame_file(asset, 1001) if name.startswith("frames") else checkpoint_file(asset)


@pytest.mark.parametrize("name", ["../a", "/etc/passwd", "a/../../b", "C:\\a", "", "a\0b", "n" * 256, "a\ud800"])
def test_names_that_lead_out_or_that_no_file_can_have_are_refused(tmp_path, name):
    with pytest.raises(InputRejected, match="the asset names the file") as refused:
        asset_file(tmp_path, name)
    str(refused.value).encode()  # it can be printed
