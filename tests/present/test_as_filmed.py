"""Every asset says how near it stays to its clip, or why that is not known."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.io.asset_folder import read_manifest, update_manifest
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.present.as_filmed import Reel, card_of, card_of_run, certainty, why_not
from fluidlift.scene.footage import Footage
from fluidlift.types import PixelLabels, VideoClip

WELL = (DONE, WITH_WARNINGS)
FRAMES = 10


@pytest.fixture
def asset(made, tmp_path):
    return shutil.copytree(made.folder, tmp_path / "stream.fluid")


def test_make_leaves_a_card_in_the_manifest_and_in_the_report(made):
    manifest = read_manifest(made.folder)
    card = card_of(manifest)
    assert not isinstance(card, str), card
    assert (card.frames, card.beyond) == (FRAMES, 0)
    assert card["level"].value > 0.5  # the fluid is somewhere near where it was filmed
    page = (made.folder / "report.html").read_text(encoding="utf-8")
    assert page.index("<h2>As filmed</h2>") < page.index("<h2>Input and re-simulation</h2>")


def test_what_does_not_hold_is_a_warning_of_the_asset(made):
    manifest = read_manifest(made.folder)
    card = card_of(manifest)
    assert (card.warning() is not None) == ("not-as-filmed" in manifest["warning_codes"])
    assert (card.warning() in manifest["simulation"]["warnings"]) == (card.warning() is not None)


def test_evaluate_prints_the_card_and_gives_it_as_json(made, capsys):
    assert main(["evaluate", str(made.folder)]) in WELL
    said = capsys.readouterr().out
    assert "as filmed: " in said and "level" in said and "floor" in said
    assert main(["evaluate", str(made.folder), "--json"]) in WELL
    manifest, told = read_manifest(made.folder), json.loads(capsys.readouterr().out)
    stored, certain = manifest["simulation"]["as_filmed"], manifest["metrics"]["certainty"]
    assert set(certain) == {"mask", "kind", "tilt"}  # nobody gave them
    assert certain["kind"] == pytest.approx(manifest["metrics"]["kind_scores"][manifest["kind"]], abs=1e-3)
    assert {k: v for k, v in told["figures"].items() if not k.startswith("right_")} == stored["figures"]
    assert {k: told["figures"][f"right_{k}"]["value"] for k in certain} == certain
    assert (told["frames"], told["notes"]) == (stored["frames"], stored["notes"])


def test_what_a_person_gave_is_certain_and_a_tilt_of_little_evidence_is_not():
    def lift(*, source: str = "evidence", error: float = 6.0, drawn: bool = False):
        evidence = SimpleNamespace(scores={"stream": 0.4, "pour": 0.35})
        geometry = SimpleNamespace(
            kind="stream", kind_source=source, kind_evidence=evidence, up=SimpleNamespace(error=error)
        )
        return SimpleNamespace(geometry=geometry, segmentation=SimpleNamespace(user_mask=drawn, likely_overlap=0.9))

    found = certainty(lift())
    assert found["kind"] == 0.4 and found["mask"] > 0.8
    assert found["tilt"] == pytest.approx(0.8176, abs=1e-4)  # within 8 degrees, of a spread of 6
    assert certainty(lift(error=20.0))["tilt"] < 0.35
    assert certainty(lift(source="user", error=0.0, drawn=True)) == {}


@pytest.mark.parametrize("wrong", [{"kind": "sure"}, ["kind"], 3, {"kind": None}])
def test_a_manifest_whose_certainty_is_broken_is_told_and_not_raised(made, wrong):
    manifest = read_manifest(made.folder)
    found = card_of(manifest | {"metrics": manifest["metrics"] | {"certainty": wrong}})
    assert isinstance(found, str) and "fluidlift sim" in found


def test_evaluate_says_why_there_is_no_card_and_what_to_do(asset, capsys):
    done = read_manifest(asset)["simulation"]
    update_manifest(asset, simulation=done | {"as_filmed": {"none": "the scene is edited (obstacles): run it again"}})
    assert main(["evaluate", str(asset)]) == REJECTED
    said = capsys.readouterr().err
    assert "the scene is edited (obstacles)." in said and "Do: run it again." in said
    for broken in (None, {"figures": {"level": {"value": 1.0}}}):
        update_manifest(asset, simulation=done | {"as_filmed": broken} if broken else {"as_filmed": {"figures": 3}})
        assert main(["evaluate", str(asset)]) == REJECTED
        assert "fluidlift sim" in capsys.readouterr().err


def test_other_footage_of_the_same_camera_is_compared(made, capsys):
    code = main(["evaluate", str(made.folder), "--clip", str(made.clip), "--start", "0.12", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert code in WELL and found["frames"] == FRAMES - 3
    own = read_manifest(made.folder)["simulation"]["as_filmed"]
    # the same clip, three frames later: where the fluid stands is the same to a few pixels of its edge
    assert found["figures"]["level"]["value"] == pytest.approx(own["figures"]["level"]["value"], abs=0.05)


@pytest.mark.parametrize(
    "options",
    [("--start", "1"), ("--truth", "case", "--clip", "a.mp4"), ("--clip", "absent.mp4")],
    ids=["a time of nothing", "two things at once", "no footage"],
)
def test_what_cannot_be_compared_is_refused(made, options, capsys):
    assert main(["evaluate", str(made.folder), *options]) == REJECTED
    assert capsys.readouterr().err.startswith("fluidlift: ")


def test_footage_of_another_shape_is_refused(made, clip_file, pictures, tmp_path, capsys):
    other = clip_file(tmp_path / "square.mp4", pictures(size=(64, 64)))
    assert main(["evaluate", str(made.folder), "--clip", str(other)]) == REJECTED
    assert "the same camera" in capsys.readouterr().err


def test_a_fluid_that_is_elsewhere_at_another_time_is_not_compared(made, monkeypatch, capsys):
    monkeypatch.setattr("fluidlift.evaluate.as_filmed.comparable", lambda masks, longer, *, fills: 0)
    assert main(["evaluate", str(made.folder), "--clip", str(made.clip), "--start", "0.12"]) == REJECTED
    assert "its fluid moves, grows or shrinks in the picture" in capsys.readouterr().err


def a_footage(frames: int, height: int = 48, width: int = 64) -> Footage:
    """Still grey water in the middle of a still picture."""
    fluid = np.zeros((frames, height, width), bool)
    fluid[:, 16:32] = True
    pictures = np.full((frames, height, width, 3), 90, np.uint8)
    labels = PixelLabels(fluid.astype(np.uint8), np.ones(fluid.shape, np.float16))
    plate, rocks = pictures[0], np.zeros((height, width), bool)
    return Footage(VideoClip(pictures, 0.04 * np.arange(frames), "still"), labels, plate, 0, rocks)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"overlap": 3}, "a loop"), ({"changes": ("density",)}, "other parameters"), ({"reshaped": True}, "terrain"),
        ({"extended": 1.0}, "a longer channel"), ({"inflow": InflowSchedule(((0.0, 2.0),))}, "another inflow"),
        ({"interval": 0.02}, "another rate"), ({"frames": 4}, "4 where 6 are needed"),
    ],
)  # fmt: skip
def test_why_a_scene_cannot_be_held_against_its_clip(channel, change, said):
    footage = a_footage(8)
    assert why_not(channel(8), footage, preview=True) is None
    assert said in why_not(replace(channel(8), **change), footage, preview=True)
    assert "clip is not at hand" in why_not(channel(8), None, preview=True)
    assert "preview" in why_not(channel(8), footage, preview=False)


def test_a_run_that_floods_its_banks_warns_and_one_that_broke_down_says_so(channel):
    footage = a_footage(8)
    frames, everywhere = footage.clip.frames, np.ones_like(footage.labels.fluid)
    found = card_of_run(channel(8), footage, True, frames, everywhere)
    assert found.as_filmed["verdict"] == "does not hold" and "level" in found.warnings[0]
    assert card_of_run(channel(8), footage, True, frames, footage.labels.fluid).warnings == ()
    short = card_of_run(channel(8), footage, True, frames[:2], everywhere[:2])
    assert "2 where 6 are needed" in short.as_filmed["none"]


def test_a_reel_gives_back_what_it_was_given_and_leaves_no_file(tmp_path):
    reel = Reel(tmp_path)
    assert len(reel.array()) == 0
    pictures = np.arange(2 * 3 * 4 * 3, dtype=np.uint8).reshape(2, 3, 4, 3)
    for picture in pictures:
        reel.append(picture[:, ::-1])
    np.testing.assert_array_equal(reel.array(), pictures[:, :, ::-1])
    assert list(tmp_path.iterdir()) == []
