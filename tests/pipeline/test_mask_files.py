"""`fluidlift mask`: masks as pictures that a person can correct and give back."""

import json
import shutil

import numpy as np
import pytest

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.io.kept_values import kept_value
from fluidlift.io.pictures import read_picture, write_png
from fluidlift.motion import optical_flow
from fluidlift.pipeline.mask_facts import MASK_FACTS, require_unchanged
from fluidlift.pipeline.stages import flow
from fluidlift.types import PinholeCamera
from fluidlift.types.stages import Segmentation

FRAMES = 10


def pictures_in(folder):
    return np.stack([read_picture(p) for p in sorted(folder.glob("*.png"))])


@pytest.fixture(scope="module")
def found(stream_clip, tmp_path_factory):
    folder = tmp_path_factory.mktemp("mask") / "look"
    assert main(["mask", str(stream_clip), "-o", str(folder)]) in (DONE, WITH_WARNINGS)
    return folder


@pytest.fixture
def copy(found, tmp_path):
    return shutil.copytree(found, tmp_path / "look")


def test_there_is_one_black_and_white_mask_per_frame_from_1001(found):
    names = sorted(p.name for p in (found / "mask").glob("*.png"))
    assert names == [f"{1001 + t}.png" for t in range(FRAMES)]
    assert set(np.unique(pictures_in(found / "mask"))) == {0, 255}
    assert pictures_in(found / "overlay").shape == (FRAMES, 64, 96, 3)


def test_the_masks_show_the_stream_and_not_its_banks(found):
    masks = pictures_in(found / "mask")
    assert (masks[:, 26:44, 8:40] == 255).mean() > 0.95
    assert (masks[:, :10] == 255).mean() < 0.02


def test_a_second_run_finds_everything_done_and_says_how_to_go_on(found, stream_clip, capsys):
    before = {p: p.stat().st_mtime_ns for p in (found / "mask").iterdir()}
    capsys.readouterr()
    assert main(["mask", str(stream_clip), "-o", str(found), "--json"]) in (DONE, WITH_WARNINGS)
    told = json.loads(capsys.readouterr().out)
    assert all(stage["cached"] for stage in told["stages"].values())
    assert (told["frames"], told["size"], told["first_number"]) == (FRAMES, [96, 64], 1001)
    assert {p: p.stat().st_mtime_ns for p in (found / "mask").iterdir()} == before
    main(["mask", str(stream_clip), "-o", str(found)])
    said = capsys.readouterr().out
    assert f"--mask {found / 'mask'}" in said and "--roi" in said


def test_a_corrected_mask_fits_make_and_is_taken_as_it_is(found, copy, stream_clip, tmp_path, hasty):
    corrected = read_picture(copy / "mask" / "1003.png")
    corrected[:20] = 255
    write_png(copy / "mask" / "1003.png", corrected)
    folder = tmp_path / "x.fluid"
    options = ["--size", "2", "--mask", str(copy / "mask"), *hasty]
    assert main(["make", str(stream_clip), "-o", str(folder), *options]) in (DONE, WITH_WARNINGS)
    (facts,) = (folder / "work" / "segment").glob("*.json")
    labels = kept_value(folder, "segment", facts.stem, Segmentation)[0].labels.labels
    np.testing.assert_array_equal(labels == 1, pictures_in(copy / "mask") == 255)


def test_masks_that_a_person_has_changed_are_not_written_over(copy, stream_clip, capsys):
    corrected = np.full((64, 96), 255, np.uint8)
    write_png(copy / "mask" / "1001.png", corrected)
    again = ["mask", str(stream_clip), "-o", str(copy), "--roi", "0,0,96,40"]
    assert main(again) == REJECTED
    said = capsys.readouterr().err
    assert "changed" in said and "--force masks" in said
    np.testing.assert_array_equal(read_picture(copy / "mask" / "1001.png"), corrected)
    assert main([*again, "--force", "masks"]) in (DONE, WITH_WARNINGS)
    assert not read_picture(copy / "mask" / "1001.png")[41:].any()


def test_fluid_is_only_looked_for_inside_the_region(stream_clip, tmp_path):
    folder = tmp_path / "look"
    assert main(["mask", str(stream_clip), "-o", str(folder), "--roi", "0,0,48,64"]) in (DONE, WITH_WARNINGS)
    masks = pictures_in(folder / "mask")
    assert masks[:, :, :46].any() and not masks[:, :, 50:].any()


def test_a_place_that_is_said_to_be_no_fluid_is_none_and_the_other_way_round(found, stream_clip, tmp_path):
    """The evidence has an answer for the rock in the stream; a person says the opposite."""
    before = pictures_in(found / "mask")
    x, y = 58, 35  # the rock
    water = before[5, y, x] == 255
    option = "--not-here" if water else "--click"
    assert main(["mask", str(stream_clip), "-o", str(tmp_path / "look"), option, f"{x},{y}"]) in (DONE, WITH_WARNINGS)
    after = pictures_in(tmp_path / "look" / "mask")
    assert (after[5, y, x] == 255) != water


@pytest.mark.parametrize(
    ("option", "value"), [("--roi", "1,2,3"), ("--roi", "a,b,c,d"), ("--click", "5"), ("--not-here", "1,nan")]
)
def test_places_that_are_no_numbers_are_rejected(stream_clip, tmp_path, capsys, option, value):
    assert main(["mask", str(stream_clip), "-o", str(tmp_path / "look"), option, value]) == REJECTED
    assert option in capsys.readouterr().err
    assert not (tmp_path / "look").exists()


def test_a_mask_of_straightened_pictures_is_not_straightened_again(stream_clip, tmp_path, hasty):
    """With a lens that distorts, the mask written by `mask --camera` comes out of make as it went in."""
    camera = PinholeCamera.looking((1.0, -3.0, 2.5), (0.5, 0.0, 0.0), 50.0, (96, 64)).to_dict()
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(camera | {"distortion_k1_k2_p1_p2": [-0.3, 0.0, 0.0, 0.0], "water_level_z": 0.0}))
    look, folder = tmp_path / "look", tmp_path / "x.fluid"
    assert main(["mask", str(stream_clip), "-o", str(look), "--camera", str(file)]) in (DONE, WITH_WARNINGS)
    options = ["--camera", str(file), "--mask", str(look / "mask"), *hasty]
    assert main(["make", str(stream_clip), "-o", str(folder), *options]) in (DONE, WITH_WARNINGS)
    (facts,) = (folder / "work" / "segment").glob("*.json")
    labels = kept_value(folder, "segment", facts.stem, Segmentation)[0].labels.labels
    np.testing.assert_array_equal(labels == 1, pictures_in(look / "mask") == 255)


def test_a_folder_with_other_things_is_left_alone(stream_clip, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["mask", str(stream_clip), "-o", str(tmp_path)]) == REJECTED
    assert "other things" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options",
    [
        ["mask", "--click", "9999,20"],
        ["mask", "--roi", "0,0,0,0"],
        ["mask", "--set", "segment.method=sam2"],
        ["motion", "--mask", "text.png"],
        ["motion", "--depth", "text.exr"],
    ],
)
def test_what_cannot_be_used_is_refused_before_the_flow_is_computed(stream_clip, tmp_path, options, monkeypatch):
    for name in ("text.png", "text.exr"):
        (tmp_path / name).write_text("no picture")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(optical_flow, "estimate_flow", lambda *_, **__: pytest.fail("the flow was computed"))
    assert main([options[0], str(stream_clip), "-o", "out", *options[1:]]) == REJECTED
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["mask", "motion"])
def test_a_setting_that_changes_nothing_is_refused(stream_clip, tmp_path, capsys, command):
    code = main([command, str(stream_clip), "-o", str(tmp_path / "out"), "--set", "fit.max_work=3"])
    assert code == REJECTED and "fit.max_work=3" in capsys.readouterr().err


def test_a_missing_package_leaves_no_folder_behind(stream_clip, tmp_path, monkeypatch, capsys):
    def missing(*_, **__):
        raise MissingPackage("torchvision is not installed")

    monkeypatch.setattr(flow, "make_estimator", missing)
    code = main(["mask", str(stream_clip), "-o", str(tmp_path / "out"), "--set", "motion.method=raft"])
    assert code == 1 and "torchvision" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("frames", [10**12, -1, 3.5, "7", None, [1], True])
def test_facts_of_masks_with_another_number_of_frames_say_that_something_was_changed(copy, frames):
    facts = json.loads((copy / "mask" / MASK_FACTS).read_text())
    (copy / "mask" / MASK_FACTS).write_text(json.dumps(facts | {"frames": frames}))
    with pytest.raises(InputRejected, match="were changed"):
        require_unchanged(copy / "mask", "masks")
