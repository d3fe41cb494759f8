"""Clips and flows that are not as they should be, through the command line: mended or refused, and the frame said."""

import json
from fractions import Fraction

import av
import numpy as np
import pytest

from fluidlift.cli import REJECTED, WITH_WARNINGS, main
from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.io.exr_write import write_channels
from fluidlift.io.flow_files import write_flow
from fluidlift.io.pictures import read_picture, write_png
from fluidlift.messages import code_of
from fluidlift.pipeline import Inputs
from fluidlift.pipeline import make as make_asset
from fluidlift.pipeline.find import read_alone

TELECINE = [t + d for t in range(0, 12, 4) for d in (0, 1, 1, 2, 3)]
"""four frames shown in five, as a film at 24 frames per second is at 30"""
GAPPED = [0, 1, 2, 3, 5, 6, 7, 10, 11, 12]
"""ticks of 0.04 s at which frames are shown"""


@pytest.fixture
def write(tmp_path):
    """Write pictures as a video that keeps them nearly as they are, shown at given ticks of 0.04 s."""

    def written(pictures, ticks=None):
        path = tmp_path / "clip.mp4"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=25)
            stream.height, stream.width, stream.pix_fmt = *pictures.shape[1:3], "yuv444p"
            stream.options = {"crf": "4"}
            for picture, tick in zip(pictures, range(len(pictures)) if ticks is None else ticks):
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), "rgb24")
                frame.pts, frame.time_base = int(tick), Fraction(1, 25)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return path

    return written


@pytest.fixture
def look(tmp_path, capsys):
    """What `fluidlift mask` says of a clip, and the facts that it prints."""

    def looked(clip, *options):
        capsys.readouterr()
        code = main(["mask", str(clip), "-o", str(tmp_path / "look"), "--json", *options])
        said = capsys.readouterr()
        return code, said.err, json.loads(said.out) if said.out else {}

    return looked


def woven(pictures):
    """Frames whose even rows show one instant and whose odd rows the next."""
    frames = pictures[::2].copy()
    frames[:, 1::2] = pictures[1::2, 1::2]
    return frames


def test_an_interlaced_clip_is_read_by_one_field_and_said(write, look, pictures):
    code, said, facts = look(write(woven(pictures(20, size=(192, 128)))))
    assert code == WITH_WARNINGS and "interlaced" in said
    assert facts["frames"] == 10


def test_a_variable_frame_rate_is_said_with_the_frame_of_the_longest_gap(write, look, pictures):
    code, said, facts = look(write(pictures(13)[GAPPED], GAPPED))
    assert code == WITH_WARNINGS and "variable frame rate: 40.0 to 120.0 ms" in said and "after frame 6" in said
    assert facts["frames"] == len(GAPPED)


def test_a_telecined_clip_is_freed_of_its_repeats_which_are_named(write, look, pictures):
    code, said, facts = look(write(pictures(12)[TELECINE]))
    assert code == WITH_WARNINGS and "left out: frame 2, 7, 12" in said
    assert facts["frames"] == 12


def test_a_frozen_stretch_is_left_out_and_its_frames_are_named(write, look, pictures):
    moving = pictures(30)
    frozen = np.concatenate([moving[:12], np.repeat(moving[12:13], 18, axis=0), moving[13:]])
    code, said, facts = look(write(frozen))
    assert code == WITH_WARNINGS and "frames 12 to 29 show one picture" in said and "frames 29 to 46 are used" in said
    assert facts["frames"] == 18


def test_of_a_clip_with_a_cut_the_longest_shot_is_used_and_the_frame_is_named(write, look, pictures):
    other = 255 - np.roll(pictures(12), 40, axis=2)
    code, said, facts = look(write(np.concatenate([pictures(6), other])))
    assert code == WITH_WARNINGS and "at frame 6" in said and "frames 6 to 17" in said
    assert facts["frames"] == 12


def test_a_picture_that_stands_all_the_time_is_refused(write, look, pictures, tmp_path):
    code, said, _ = look(write(np.repeat(pictures(1), 12, axis=0)))
    assert code == REJECTED and "Needed" in said
    assert not (tmp_path / "look").exists()


def measured(clip, flow, folder, *options):
    return main(["motion", str(clip), "-o", str(folder), "--flow", str(flow), "--set", "shape.cells=16", *options])


def test_the_third_flow_of_another_shape_is_refused_with_its_frame(stream_clip, tmp_path, capsys):
    for t in range(9):
        shape = (60, 60, 2) if t == 3 else (64, 96, 2)
        write_flow(tmp_path / "flow", t, np.ones(shape, np.float32), None, "flo")
    assert measured(stream_clip, tmp_path / "flow", tmp_path / "out") == REJECTED
    said = capsys.readouterr().err
    assert "frame 3" in said and "60 x 60" in said
    assert not (tmp_path / "out").exists()


def test_a_damaged_flow_file_is_refused_by_its_name(stream_clip, tmp_path, capsys):
    for t in range(9):
        write_flow(tmp_path / "flow", t, np.ones((64, 96, 2), np.float32), None, "flo")
    whole = (tmp_path / "flow" / "flow.1005.flo").read_bytes()
    (tmp_path / "flow" / "flow.1005.flo").write_bytes(whole[:-100])
    assert measured(stream_clip, tmp_path / "flow", tmp_path / "out") == REJECTED
    assert "flow.1005.flo" in capsys.readouterr().err


def test_what_the_numbers_of_a_flow_mean_can_be_said(stream_clip, tmp_path):
    """2 px to the right and 1 down per frame at 25 per second, in px per second with v up, in channels of its own."""
    size = np.ones((64, 96), np.float32)
    for t in range(9):
        write_channels(tmp_path / "flow" / f"flow.{t:03d}.exr", {"motion.a": 50 * size, "motion.b": -25 * size})
    folder, layout = tmp_path / "out", ("motion.flow_channels=motion.a,motion.b", "motion.flow_scale=0.04")
    options = [word for text in (*layout, "motion.flow_v_up=true") for word in ("--set", text)]
    assert measured(stream_clip, tmp_path / "flow", folder, "--raw", "--format", "npz", *options) != REJECTED
    with np.load(folder / "raw_flow" / "flow.1004.npz") as stored:
        np.testing.assert_allclose(stored["displacement"][20, 30], [2.0, 1.0], rtol=1e-3)  # float16


@pytest.mark.parametrize("setting", ["motion.flow_channels=R", "motion.flow_scale=0"])
def test_a_layout_that_means_nothing_is_refused(stream_clip, tmp_path, capsys, setting):
    write_flow(tmp_path / "flow", 0, np.ones((64, 96, 2), np.float32), None, "flo")
    assert measured(stream_clip, tmp_path / "flow", tmp_path / "out", "--set", setting) == REJECTED
    assert setting.partition("=")[0] in capsys.readouterr().err


def test_files_of_uneven_frames_hold_displacements_and_speeds_follow_the_times(write, pictures, tmp_path):
    """A stream of steady speed: the flow of a pair that spans three ticks is three times as long, not the velocity."""
    clip, folder = write(pictures(13)[GAPPED], GAPPED), tmp_path / "out"
    options = ["--format", "npz", "--raw", "--set", "shape.cells=16", "--kind", "stream", "--size", "2"]
    assert main(["motion", str(clip), "-o", str(folder), *options]) == WITH_WARNINGS
    facts, spans = json.loads((folder / "motion.json").read_text()), np.diff(GAPPED)
    for name in ("flow", "raw_flow"):
        for t, span in enumerate(spans):
            mask = read_picture(folder / "mask" / f"{1001 + t}.png") == 255
            mask[:26], mask[44:], mask[:, :8], mask[:, 40:] = False, False, False, False
            with np.load(folder / name / f"flow.{1001 + t}.npz") as stored:
                # a quarter: the estimator's own error, more where pairs of unlike span are neighbours
                assert np.median(stored["displacement"][mask][:, 0]) == pytest.approx(2.0 * span, rel=0.25), (name, t)
    speeds = [row["surface_speed_median"] for row in facts["per_frame"]]
    np.testing.assert_allclose(speeds, np.median(speeds), rtol=0.25)


@pytest.fixture
def letterboxed(write, pictures):
    """A clip with black bars of 24 rows above and below its 96, and its pictures without them."""
    frames = pictures(10, size=(160, 96))
    return write(np.pad(frames, ((0, 0), (24, 24), (0, 0), (0, 0)))), frames


def test_bars_are_cut_off_where_nothing_but_the_clip_is_given(letterboxed, tmp_path):
    clip, frames = letterboxed
    found = read_alone(Inputs(clip), tmp_path / "read", build_config(None, None, (), {}))
    assert [code_of(w) for w in found.warnings if "bars" in w] == ["bars-cut-off"]
    assert found.clip.size == (160, 94)
    assert np.abs(found.clip.frames[0].astype(int) - frames[0, 1:-1]).mean() < 3


def test_a_setting_keeps_the_bars(letterboxed, tmp_path):
    config = build_config(None, None, (), {"read.crop": "none"})
    found = read_alone(Inputs(letterboxed[0]), tmp_path / "read", config)
    assert [code_of(w) for w in found.warnings if "bars" in w] == ["bars-stay"]
    assert found.clip.size == (160, 144)


def test_masks_are_those_of_the_whole_picture_so_that_they_can_be_given_back(letterboxed, look):
    _, said, facts = look(letterboxed[0])
    assert facts["size"] == [160, 144] and "black bars" in said


@pytest.mark.parametrize(("given", "crop"), [({}, "auto"), ({"mask": True}, "none")])
def test_make_cuts_bars_off_only_where_no_file_holds_for_the_whole_picture(
    letterboxed, tmp_path, monkeypatch, given, crop
):
    clip, _ = letterboxed
    mask = tmp_path / "mask.png"
    write_png(mask, np.full((144, 160), 255, np.uint8))
    read_with = []

    def stop(runner, given_clip, config):
        read_with.append(config.read.crop)
        raise InputRejected("enough", "no more")

    monkeypatch.setattr("fluidlift.pipeline.begin.windows", stop)
    with pytest.raises(InputRejected, match="enough"):
        make_asset(Inputs(clip, mask=mask if given else None), tmp_path / "asset", build_config(None, None, (), {}))
    assert read_with == [crop]
