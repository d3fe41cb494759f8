"""A finished asset is drawn from other places."""

import json
import shutil

import cv2
import numpy as np
import pytest

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.errors import InputRejected
from fluidlift.evaluate import arrays_of_run
from fluidlift.io.asset_folder import read_manifest
from fluidlift.io.exr import read_channels
from fluidlift.io.video import read_clip
from fluidlift.pipeline.render import RenderRequest, _beyond_clip, render_asset
from fluidlift.present.frames import _placed
from fluidlift.types import PinholeCamera

WELL = (DONE, WITH_WARNINGS)


def render(made, out, *options):
    return main(["render", str(made.folder), "-o", str(out), *options])


def picture(path):
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return found


def test_the_input_view_shows_what_the_preview_shows(made, tmp_path):
    assert render(made, tmp_path / "out") in WELL
    frames = read_manifest(made.folder)["simulation"]["frames"]
    assert [p.name for p in sorted((tmp_path / "out").iterdir())] == [f"{1001 + k}.png" for k in range(frames)]
    stored = arrays_of_run(made.folder, read_manifest(made.folder))["resim_frames"]
    drawn = picture(tmp_path / "out" / "1002.png")[..., 2::-1].astype(int)
    # the same splats before the same plate; rounding alone differs
    assert np.abs(drawn - stored[1]).max() <= 1


def test_a_transparent_picture_covers_the_fluid_alone(made, tmp_path):
    options = ("--view", "side", "--background", "none", "--frames", "1001-1001", "--size", "120x80")
    assert render(made, tmp_path / "out", *options) in WELL
    alpha = picture(tmp_path / "out" / "1001.png")[..., 3]
    assert alpha.shape == (80, 120)
    assert alpha[0].max() == 0 and 0.02 < (alpha > 200).mean() < 0.6


def test_exr_holds_linear_premultiplied_colours_and_depth_in_metres(made, tmp_path):
    options = ("--view", "side", "--background", "none", "--frames", "1001-1001", "--size", "120x80")
    render(made, tmp_path / "png", *options)
    assert render(made, tmp_path / "exr", *options, "--format", "exr") in WELL
    channels = read_channels(tmp_path / "exr" / "1001.exr")
    png = picture(tmp_path / "png" / "1001.png").astype(float) / 255
    sure = channels["A"] > 0.99
    assert sure.sum() > 50
    srgb = np.where(channels["G"] <= 0.0031308, 12.92 * channels["G"], 1.055 * channels["G"] ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(srgb[sure], png[..., 1][sure], atol=1.5 / 255 + 0.01)  # 8 bits, and 1 % of alpha
    assert channels["Z"][sure].min() > 0 and (channels["G"] <= channels["A"] + 1e-6).all()


def test_a_turn_is_a_film_of_the_frame_rate_of_the_asset(made, tmp_path):
    film = tmp_path / "turn.mp4"
    assert render(made, film, "--view", "turn", "--size", "96x64", "--frames", "1001-1004") in WELL
    clip = read_clip(film)
    assert len(clip) == 4 and clip.interval == pytest.approx(0.04, rel=1e-3)
    assert np.abs(clip.frames[0].astype(int) - clip.frames[2]).mean() > 3  # half around: another picture


def test_keyed_views_move_the_camera(made, tmp_path):
    view = tmp_path / "view.json"
    keys = [
        {"frame": 1001, "eye": [0, -3, 2], "target": [0, 0, 0]},
        {"frame": 1003, "eye": [2, -3, 2], "target": [0, 0, 0]},
    ]
    view.write_text(json.dumps({"keys": keys}))
    assert render(made, tmp_path / "out", "--view", str(view), "--size", "96x64", "--frames", "1001-1003") in WELL
    first, last = (picture(tmp_path / "out" / f"{n}.png").astype(int) for n in (1001, 1003))
    assert np.abs(first - last).mean() > 2


def test_a_wider_picture_shows_more_and_stretches_nothing_and_says_so(made, tmp_path, capsys):
    for name, size in (("a", "96x64"), ("b", "128x64")):
        assert render(made, tmp_path / name, "--size", size, "--frames", "1001-1001") in WELL
        beyond = "show more left and right than the clip, 96 x 64 px" in "".join(capsys.readouterr())
        assert beyond == (name == "b")
    narrow, wide = (picture(tmp_path / n / "1001.png")[..., :3].astype(int) for n in "ab")
    np.testing.assert_allclose(wide[:, 16:112], narrow, atol=1)


def test_only_pictures_of_another_shape_from_the_clips_camera_go_beyond_it():
    told = [_beyond_clip((960, 540), RenderRequest(view=view, size=size))
            for view, size in (("input", None), ("input", (1920, 1080)), ("side", (100, 100)), ("input", (100, 100)),
                               ("input", (1920, 800)))]  # fmt: skip
    assert [len(t) for t in told] == [0, 0, 0, 1, 1]
    assert "above and below" in told[3][0] and "left and right" in told[4][0]


def test_beyond_its_edges_a_plate_goes_on_as_in_a_mirror_and_its_rocks_do_not():
    source = PinholeCamera.from_fov(50, (60, 40))
    camera = PinholeCamera(source.focal, (50.0, 20.0), (100, 40), source.camera_from_world)  # 20 px more on each side
    plate = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    wide = _placed(plate, source, camera)
    np.testing.assert_allclose(wide, np.pad(plate, ((0, 0), (20, 20), (0, 0)), mode="symmetric") / 255.0, atol=1e-6)
    assert np.abs(np.diff(wide[:, :20], axis=1)).mean() > 0.2  # no streaks of one pixel's colour
    rocks = _placed(plate, source, camera, goes_on=False)
    assert (rocks[:, :20] == 0).all() and (rocks[:, 80:] == 0).all()
    np.testing.assert_array_equal(rocks[:, 20:80], wide[:, 20:80])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--view", "sidd"), "did you mean side"),
        (("--view", "side", "--background", "plate"), "a plate is a flat picture"),
        (("--size", "big"), "1920x1080"),
        (("--size", "4x4"), "16 to 8192"),
        (("--frames", "1-3"), "numbers from 1001"),
        (("--frames", "1004-1002"), "numbers from 1001"),
    ],
)
def test_what_cannot_be_drawn_is_refused(made, tmp_path, capsys, options, words):
    assert render(made, tmp_path / "out", *options) == REJECTED
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_background_that_there_is_not_is_refused_before_anything_is_read(tmp_path):
    with pytest.raises(InputRejected, match="auto, plate, terrain, none"):
        render_asset(tmp_path / "no asset", tmp_path / "out", RenderRequest(background="sky"))


def test_a_target_that_cannot_hold_the_pictures_is_refused(made, tmp_path, capsys):
    assert render(made, tmp_path / "one.png") == REJECTED
    assert render(made, tmp_path / "film.mp4", "--view", "side", "--background", "none") == REJECTED
    (tmp_path / "file").write_text("mine")
    assert render(made, tmp_path / "file") == REJECTED
    assert (tmp_path / "file").read_text() == "mine"
    said = capsys.readouterr().err
    assert "a folder" in said and "no alpha" in said


def test_without_its_work_folder_an_asset_is_drawn_on_its_terrain(made, tmp_path, capsys):
    bare = shutil.copytree(made.folder, tmp_path / "bare.fluid", ignore=shutil.ignore_patterns("work"))
    options = ["-o", str(tmp_path / "out"), "--frames", "1001-1001"]
    assert main(["render", str(bare), *options]) in WELL
    assert main(["render", str(bare), *options, "--background", "plate"]) == REJECTED
    assert "no longer at hand" in capsys.readouterr().err


def test_an_asset_without_frames_says_how_to_get_them(made, tmp_path, capsys):
    bare = shutil.copytree(made.folder, tmp_path / "bare.fluid", ignore=shutil.ignore_patterns("frames"))
    assert main(["render", str(bare), "-o", str(tmp_path / "out")]) == REJECTED
    assert "fluidlift sim" in capsys.readouterr().err
