"""The command line: what is rejected, what is warned about, and what the smaller commands say."""

import errno
import json
import os

import av
import numpy as np
import pytest
import yaml
from catalogue import plume_pictures

from fluidlift import __version__
from fluidlift.cli import DONE, FAILED, REJECTED, USAGE, WITH_WARNINGS, main
from fluidlift.evaluate import arrays_of_run
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.images import write_png
from fluidlift.io.video import read_clip
from fluidlift.messages import code_of
from fluidlift.types import PinholeCamera


def rejected(capsys, *arguments):
    """What the command line said when it rejected its input."""
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == REJECTED
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    assert said.err.splitlines()[-1].startswith("fluidlift: ")
    return said.err


@pytest.fixture
def out(tmp_path):
    """An asset folder that does not exist, and must not exist after a rejection."""
    folder = tmp_path / "out" / "x.fluid"
    yield folder
    assert not folder.exists()


# clips that are none --------------------------------------------------------------------------------------------


def sound_only(path):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        for k in range(20):
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.rate, frame.pts = 44100, 1024 * k
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


@pytest.fixture
def clips(tmp_path, stream_clip, pictures, clip_file):
    """Makes a clip of a named fault."""

    def make(fault):
        path = tmp_path / f"{fault}.mp4"
        whole = stream_clip.read_bytes()
        if fault == "text":
            path.write_text("Dear reader, this is a letter and no video.\n" * 20)
        elif fault == "empty":
            path.write_bytes(b"")
        elif fault == "script":
            path.write_text(f"ffconcat version 1.0\nfile {stream_clip}\n")
        elif fault == "playlist":
            path.write_text(f"#EXTM3U\n#EXTINF:1,\n{stream_clip}\n")
        elif fault == "header":
            path.write_bytes(whole[:100])
        elif fault == "noise":
            path.write_bytes(np.random.default_rng(0).bytes(5000))
        elif fault == "sound":
            return sound_only(tmp_path / "sound.m4a")
        elif fault == "single":
            clip_file(path, pictures(1))
        elif fault == "still":
            clip_file(path, np.repeat(pictures(1), 10, axis=0))
        elif fault == "folder":
            path.mkdir()
        return path

    return make


@pytest.mark.parametrize(
    ("fault", "word"),
    [
        ("absent", "no such"), ("text", "text"), ("empty", "empty"), ("script", "script"), ("playlist", "playlist"),
        ("header", "header.mp4"), ("noise", "noise.mp4"), ("sound", "audio"), ("single", "two frames"),
        ("still", "nothing moves"), ("folder", "folder"),
    ],
)  # fmt: skip
def test_what_is_no_clip_of_a_fluid_is_rejected(clips, out, capsys, hasty, fault, word):
    said = rejected(capsys, "make", clips(fault), "-o", out, *hasty)
    assert word in said
    assert "Needed: " in said


def cut_off(clip, place, share):
    """The first part of a file."""
    data = clip.read_bytes()
    part = place / "part.mp4"
    part.write_bytes(data[: int(share * len(data))])
    return part


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_a_clip_that_breaks_off_before_its_second_frame_is_rejected(stream_clip, tmp_path, out, capsys, hasty, share):
    said = rejected(capsys, "make", cut_off(stream_clip, tmp_path, share), "-o", out, *hasty)
    assert "part.mp4" in said and "two frames" in said


def test_a_clip_that_breaks_off_later_is_used_as_far_as_it_goes(stream_clip, tmp_path, hasty):
    folder = tmp_path / "x.fluid"
    code = main(["make", str(cut_off(stream_clip, tmp_path, 0.95)), "-o", str(folder), "--size", "2", *hasty])
    assert code in (DONE, WITH_WARNINGS)
    assert 2 <= json.loads((folder / "manifest.json").read_text())["frame_count"] < 10


def test_a_clip_that_breaks_off_is_warned_about(stream_clip, tmp_path):
    clip = read_clip(cut_off(stream_clip, tmp_path, 0.95))
    assert "file-cut-off" in map(code_of, clip.warnings)


@pytest.mark.parametrize("fault", ["text", "script", "sound"])
def test_inspect_rejects_the_same_clips(clips, capsys, fault):
    assert "Needed: " in rejected(capsys, "inspect", clips(fault))


def test_a_similar_name_is_suggested(stream_clip, out, capsys):
    assert "stream.mp4" in rejected(capsys, "make", stream_clip.with_name("steam.mp4"), "-o", out)


# options that do not fit ----------------------------------------------------------------------------------------


def test_an_empty_mask_is_rejected(stream_clip, tmp_path, out, capsys, hasty):
    mask = tmp_path / "mask.png"
    write_png(mask, np.zeros((64, 96), np.uint8))
    said = rejected(capsys, "make", stream_clip, "-o", out, "--mask", mask, *hasty)
    assert "mask.png" in said and "empty" in said


def test_a_mask_of_another_shape_is_rejected(stream_clip, tmp_path, out, capsys, hasty):
    mask = tmp_path / "mask.png"
    write_png(mask, np.full((64, 64), 255, np.uint8))
    said = rejected(capsys, "make", stream_clip, "-o", out, "--mask", mask, *hasty)
    assert "aspect" in said and "Do: " in said


@pytest.mark.parametrize("kind", ["stream", "pour"])
def test_a_mask_of_a_single_pixel_is_rejected(stream_clip, tmp_path, out, capsys, hasty, kind):
    mask, pixels = tmp_path / "mask.png", np.zeros((64, 96), np.uint8)
    pixels[40, 40] = 255
    write_png(mask, pixels)
    said = rejected(capsys, "make", stream_clip, "-o", out, "--mask", mask, "--kind", kind, *hasty)
    assert "fluid pixels" in said and "--max-size" in said


def test_a_body_that_is_lost_in_its_grid_is_rejected(stream_clip, out, capsys, hasty):
    """Two cells high, the river would be all inlet as smoke."""
    said = rejected(capsys, "make", stream_clip, "-o", out, "--kind", "plume", *hasty, "--set", "shape.cells=4")
    assert "no cell" in said and "shape.cells" in said


def test_a_limit_is_named_by_its_setting_and_may_be_given_as_the_option_that_it_was(stream_clip, out, capsys, hasty):
    assert "--set read.max_pixels=" in rejected(capsys, "make", stream_clip, "-o", out, "--max-pixels=1000", *hasty)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--set", "shape.cell=3"], "shape.cell"), (["--set", "shape.cells"], "section.name=value"),
        (["--set", "shape.cells=0"], "shape.cells"), (["--set", "shape.size=[1"], "[1"), (["--start", "99"], "--start"),
        (["--fov", "0"], "shape.fov"), (["--max-size", "3"], "read.max_size"), (["--size", "-2"], "shape.size"),
        (["--start", "-1"], "read.start"), (["--force", "segmentation"], "segmentation"),
        (["--max-frames", "0"], "read.max_frames"),
        (["--config", "nowhere.yaml"], "nowhere.yaml"), (["--mask", "nowhere.png"], "nowhere.png"),
        (["--camera", "nowhere.json"], "nowhere.json"), (["--depth", "nowhere.exr"], "nowhere.exr"),
        (["--geometry-from", "nowhere"], "nowhere"), (["--seed", "-1"], "seed"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)  # fmt: skip
def test_options_that_make_no_sense_are_rejected_by_name(stream_clip, out, capsys, hasty, options, word):
    assert word in rejected(capsys, "make", stream_clip, "-o", out, *hasty, *options)


@pytest.mark.parametrize(
    ("name", "content"),
    [("--config", "shape: [1, 2"), ("--config", "shapes: {cells: 3}"), ("--camera", "{}"), ("--camera", "{ no json"),
     ("--camera", '{"width": 96, "height": 64}')],
)  # fmt: skip
def test_files_that_cannot_be_understood_are_rejected(stream_clip, tmp_path, out, capsys, hasty, name, content):
    file = tmp_path / "given.txt"
    file.write_text(content)
    said = rejected(capsys, "make", stream_clip, "-o", out, name, file, *hasty)
    assert "Needed: " in said


def test_a_camera_file_without_k_says_what_it_lacks(stream_clip, tmp_path, out, capsys, hasty):
    file = tmp_path / "camera.json"
    file.write_text('{"width": 96, "height": 64}')
    assert "K" in rejected(capsys, "make", stream_clip, "-o", out, "--camera", file, *hasty)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_other_peoples_things_are_not_overwritten(stream_clip, tmp_path, capsys, hasty, kind):
    place = tmp_path / "thesis"
    if kind == "file":
        place.write_text("ten years of work")
    else:
        place.mkdir()
        (place / "chapter.txt").write_text("ten years of work")
    said = rejected(capsys, "make", stream_clip, "-o", place, *hasty)
    assert "thesis" in said and "-o" in said
    assert (place if kind == "file" else place / "chapter.txt").read_text() == "ten years of work"
    assert kind == "file" or [p.name for p in place.iterdir()] == ["chapter.txt"]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EROFS], ids=["full", "forbidden", "read-only"])
def test_a_disk_that_takes_nothing_is_said_as_such(stream_clip, out, capsys, hasty, monkeypatch, code):
    replace = os.replace

    def fails(source, target, **options):
        if str(out) in str(target):
            raise OSError(code, os.strerror(code))
        return replace(source, target, **options)

    monkeypatch.setattr(os, "replace", fails)
    said = rejected(capsys, "make", stream_clip, "-o", out, *hasty)
    assert ("disk full" if code == errno.ENOSPC else "cannot be written") in said
    assert "Do: " in said


def test_too_little_room_is_told_before_the_long_work_and_nothing_is_half_written(
    stream_clip, tmp_path, capsys, hasty, monkeypatch
):
    import shutil
    from collections import namedtuple

    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9 - 1000, 1000))
    out = tmp_path / "full.fluid"
    said = rejected(capsys, "make", stream_clip, "-o", out, *hasty)
    assert "MB free" in said
    # whole stage results are kept for the next run; no frame, no manifest, nothing under a temporary name
    assert not list(out.rglob("*.ply")) and not (out / "manifest.json").exists()
    assert {p.suffix for p in out.rglob("*") if p.is_file()} <= {".npz", ".npy", ".json", ""}


# warnings -------------------------------------------------------------------------------------------------------


def warnings_of(folder, code):
    assert code == WITH_WARNINGS
    return " | ".join(json.loads((folder / "manifest.json").read_text())["warnings"])


def test_an_unknown_size_is_warned_about(stream_clip, tmp_path, capsys, hasty):
    folder = tmp_path / "x.fluid"
    code = main(["make", str(stream_clip), "-o", str(folder), *hasty])
    assert "--size" in warnings_of(folder, code)
    assert "warning: the size" in capsys.readouterr().err
    assert "the size of the fluid is unknown" in (folder / "report.html").read_text(encoding="utf-8")


def test_a_simulation_with_too_many_particles_stops_and_says_so(stream_clip, tmp_path, hasty):
    folder = tmp_path / "x.fluid"
    few = ("--set", "simulate.max_particles=100")
    code = main(["make", str(stream_clip), "-o", str(folder), "--size", "2", *hasty, *few])
    assert "stopped after 1 of 2 frames" in warnings_of(folder, code)
    assert [p.name for p in (folder / "frames" / "splats").iterdir()] == ["1001.flsp"]


def test_after_a_cut_the_rest_is_left_out_and_said_so(pictures, clip_file, tmp_path, hasty):
    other = 255 - np.roll(pictures(5), 40, axis=2)
    clip = clip_file(tmp_path / "cut.mp4", np.concatenate([pictures(10), other]))
    folder = tmp_path / "cut.fluid"
    said = warnings_of(folder, main(["make", str(clip), "-o", str(folder), "--size", "2", *hasty]))
    assert "cut" in said and "only frames 0 to 9 are used" in said
    assert json.loads((folder / "manifest.json").read_text())["frame_count"] == 10


def test_a_camera_that_moves_far_is_taken_out_and_that_is_said(pictures, clip_file, tmp_path, hasty):
    size = (192, 128)  # room for the picture to move
    wide = pictures(10, size=size)
    shift = 14 * np.array([[0, 0], [1, 0], [0, 1], [1, 1], [0, 0], [1, 1], [0, 1], [1, 0], [0, 0], [1, 1]])
    frames = np.stack([f[y : y + 112, x : x + 176] for f, (x, y) in zip(wide, shift)])
    clip = clip_file(tmp_path / "shake.mp4", frames)
    folder = tmp_path / "shake.fluid"
    said = warnings_of(folder, main(["make", str(clip), "-o", str(folder), "--size", "2", *hasty]))
    assert "the camera moves" in said and "taken out" in said


# other journeys -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["fall", "pour"])
def test_the_user_decides_the_kind(stream_clip, tmp_path, hasty, kind):
    folder = tmp_path / "x.fluid"
    code = main(["make", str(stream_clip), "-o", str(folder), "--size", "2", "--kind", kind, *hasty])
    assert code in (DONE, WITH_WARNINGS)
    assert json.loads((folder / "manifest.json").read_text())["kind"] == kind
    assert main(["validate", str(folder)]) == DONE


def test_smoke_that_rises_becomes_a_plume(tmp_path, clip_file, hasty):
    folder = tmp_path / "x.fluid"
    clip = clip_file(tmp_path / "smoke.mp4", plume_pictures())
    code = main(["make", str(clip), "-o", str(folder), "--size", "1", *hasty, "--set", "shape.cells=24"])
    assert code in (DONE, WITH_WARNINGS)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["kind"] == "plume"
    with np.load(folder / "rest" / "terrain.npz") as terrain:
        assert terrain["mainstream"][2] > 0.7  # upwards
    assert main(["validate", str(folder)]) == DONE


def test_a_surveyed_camera_and_its_world_are_kept(stream_clip, tmp_path, hasty):
    known = PinholeCamera.looking((1.0, -3.0, 2.5), (0.5, 0.0, 0.0), 50.0, (96, 64))
    file, folder = tmp_path / "camera.json", tmp_path / "x.fluid"
    file.write_text(json.dumps(known.to_dict() | {"water_level_z": 0.25}))
    assert main(["make", str(stream_clip), "-o", str(folder), "--camera", str(file), *hasty]) in (DONE, WITH_WARNINGS)
    asset = load_asset(folder)
    np.testing.assert_allclose(asset.camera.position, known.position, atol=1e-9)
    np.testing.assert_allclose(asset.camera.camera_from_world.rotation, known.camera_from_world.rotation, atol=1e-9)
    # the water stands where the camera file says
    top = np.percentile(asset.rest.means[:, 2], 98)
    assert top == pytest.approx(0.25, abs=asset.grid.spacing)


def test_a_given_depth_is_in_metres(stream_clip, tmp_path, hasty):
    depth = np.tile(np.linspace(4.0, 2.0, 64, dtype=np.float32)[:, None], (1, 96))
    file, folder = tmp_path / "depth.npz", tmp_path / "x.fluid"
    np.savez(file, depth=depth)
    assert main(["make", str(stream_clip), "-o", str(folder), "--depth", str(file), *hasty]) in (DONE, WITH_WARNINGS)
    seen = arrays_of_run(folder, read_manifest(folder))["front_depth"]
    where = seen > 0
    np.testing.assert_allclose(seen[where], depth[where], rtol=1e-3)


def test_a_part_of_a_clip_is_enough(stream_clip, tmp_path, hasty):
    folder = tmp_path / "x.fluid"
    part = ("--start", "0.1", "--duration", "0.15", "--size", "2")
    assert main(["make", str(stream_clip), "-o", str(folder), *part, *hasty]) in (DONE, WITH_WARNINGS)
    # frames at 0.12, 0.16, 0.20 and 0.24 s lie in 0.1 s to 0.25 s
    assert json.loads((folder / "manifest.json").read_text())["frame_count"] == 4


@pytest.mark.parametrize("kind", ["portrait", "two frames"])
def test_unusual_clips_work_too(pictures, clip_file, tmp_path, hasty, kind):
    frames = pictures(2) if kind == "two frames" else np.ascontiguousarray(np.swapaxes(pictures(6), 1, 2))
    clip, folder = clip_file(tmp_path / "clip.mp4", frames), tmp_path / "x.fluid"
    assert main(["make", str(clip), "-o", str(folder), "--size", "2", *hasty]) in (DONE, WITH_WARNINGS)
    assert main(["validate", str(folder)]) == DONE


# other commands -------------------------------------------------------------------------------------------------


def test_inspect_tells_what_a_clip_is(stream_clip, capsys):
    assert main(["inspect", str(stream_clip), "--json"]) == DONE
    info = json.loads(capsys.readouterr().out)
    assert (info["size"], info["frame_count"], info["fps"]) == ([96, 64], 10, pytest.approx(25.0))
    assert main(["inspect", str(stream_clip)]) == DONE
    assert "frame count" in capsys.readouterr().out


def test_inspect_warns_of_what_make_warns_of_in_the_frames(stream_clip, tmp_path, capsys, clip_file):
    frames = read_clip(stream_clip).frames
    cut = clip_file(tmp_path / "cut.mp4", np.concatenate([frames, 255 - frames[:, ::-1]]))
    assert main(["inspect", str(cut), "--json"]) == WITH_WARNINGS
    info = json.loads(capsys.readouterr().out)
    assert "clip-cut-short" in info["warning_codes"] and info["camera"].startswith("the camera ")
    assert main(["inspect", str(cut), "--header-only"]) == DONE
    assert "clip-cut-short" not in capsys.readouterr().out
    long = clip_file(tmp_path / "long.mp4", np.tile(frames, (61, 1, 1, 1)))
    assert main(["inspect", str(long)]) == WITH_WARNINGS
    assert "stand for it" in capsys.readouterr().out
    still = clip_file(tmp_path / "still.mp4", frames[:1])
    assert main(["inspect", str(still)]) == WITH_WARNINGS
    assert "make would not take it as it is" in capsys.readouterr().out


def test_mask_writes_pictures_that_make_accepts(stream_clip, tmp_path, capsys, hasty):
    found = tmp_path / "found"
    assert main(["mask", str(stream_clip), "-o", str(found)]) in (DONE, WITH_WARNINGS)
    assert len(list((found / "mask").glob("*.png"))) == len(list((found / "overlay").glob("*.png"))) == 10
    assert "--mask" in capsys.readouterr().out
    folder = tmp_path / "x.fluid"
    code = main(["make", str(stream_clip), "-o", str(folder), "--mask", str(found / "mask"), *hasty])
    assert code in (DONE, WITH_WARNINGS)
    assert "given by the user" in (folder / "report.html").read_text(encoding="utf-8")


def test_validate_tells_every_check_and_fails_with_the_first_bad_one(made, tmp_path, capsys):
    import shutil

    assert main(["validate", str(made.folder)]) == DONE
    assert "FAILED" not in capsys.readouterr().out
    assert main(["validate", str(made.folder), "--json"]) == DONE
    assert all(f["passed"] for f in json.loads(capsys.readouterr().out))
    bad = shutil.copytree(made.folder, tmp_path / "bad.fluid")
    (bad / "frames" / "splats" / "1002.flsp").unlink()
    assert main(["validate", str(bad)]) == FAILED
    assert "FAILED  splat frames" in capsys.readouterr().out


def test_what_is_no_asset_is_rejected_by_validate(tmp_path, capsys):
    for place in (tmp_path / "nowhere", tmp_path):
        assert "not a fluidlift asset" in rejected(capsys, "validate", place)


def test_the_settings_are_printed_without_touching_the_clip(tmp_path, capsys):
    assert main(["make", "absent.mp4", "--preset", "hero", "--size", "3", "--print-config"]) == DONE
    settings = yaml.safe_load(capsys.readouterr().out)
    assert settings["preset"] == "hero" and settings["shape"]["size"] == 3.0


def test_what_a_config_file_says_counts_unless_an_option_says_otherwise(tmp_path, capsys):
    file = tmp_path / "job.yaml"
    settings = {"preset": "standard", "seed": 5, "shape": {"size": 2.0, "kind": "fall"}, "read": {"max_frames": 99}}
    file.write_text(yaml.safe_dump(settings))
    assert main(["make", "absent.mp4", "--config", str(file), "--size", "3", "--print-config"]) == DONE
    found = yaml.safe_load(capsys.readouterr().out)
    assert (found["preset"], found["seed"], found["read"]["max_frames"]) == ("standard", 5, 99)
    assert (found["shape"]["size"], found["shape"]["kind"], found["shape"]["cells"]) == (3.0, "fall", 96)


def test_what_the_machine_can_do_is_told(capsys):
    assert main(["doctor", "--json"]) == DONE
    assert json.loads(capsys.readouterr().out)
    assert main(["doctor"]) == DONE


def test_the_version_is_told(capsys):
    assert main(["--version"]) == DONE
    assert __version__ in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments", [[], ["fly"], ["make"], ["make", "x.mp4", "--colour", "red"], ["make", "x.mp4", "--size", "big"],
                  ["make", "x.mp4", "--kind", "lava"]],
)  # fmt: skip
def test_wrong_usage_exits_with_two(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == USAGE


def test_progress_is_plain_lines_where_there_is_no_terminal(stream_clip, tmp_path, capsys, hasty):
    folder = tmp_path / "x.fluid"
    main(["make", str(stream_clip), "-o", str(folder), "--size", "2", *hasty])
    said = capsys.readouterr()
    assert "[1/10] reading the clip ..." in said.err and "[10/10]" in said.err
    assert "\x1b" not in said.err + said.out and "\r" not in said.err
    assert str(folder) in said.out
    main(["make", str(stream_clip), "-o", str(folder), "--size", "2", *hasty])
    assert capsys.readouterr().err.count("already done") == 10


def test_pictures_in_a_folder_are_a_clip_too(stream_clip, tmp_path, hasty):
    frames = tmp_path / "frames"
    for t, frame in enumerate(read_clip(stream_clip).frames):
        write_png(frames / f"{t:04d}.png", frame)
    folder = tmp_path / "x.fluid"
    assert main(["make", str(frames), "-o", str(folder), "--fps", "10", "--size", "2", *hasty]) in (DONE, WITH_WARNINGS)
    assert json.loads((folder / "manifest.json").read_text())["frame_interval"] == pytest.approx(0.1)
