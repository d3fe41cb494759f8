"""A long clip is made of the part of it that is most like the whole."""

import json

import numpy as np
import pytest
from catalogue import stream_pictures, write_clip

from fluidlift.config import build_config
from fluidlift.io.video import frame_times, frames_before, read_clip
from fluidlift.messages import code_of
from fluidlift.pipeline import Inputs, begin
from fluidlift.pipeline.find import read_alone
from fluidlift.pipeline.inputs import GivenFiles
from fluidlift.pipeline.runner import Runner
from fluidlift.seams import Silence


def part(clip, folder, *settings):
    """What stands for a clip, as settings, and what was told."""
    config = build_config(None, None, settings, {})
    runner = Runner(folder, ("read",), progress=Silence())
    found = begin.within(runner, GivenFiles.of(Inputs(clip)).clip, config)
    return found.read, runner


def end_of(read) -> float:
    """s, of a part with a duration."""
    return read.start + (read.duration or 0.0)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """80 frames of a stream: its light is odd in the first 30, and it stands still in the last 20."""
    frames = stream_pictures(80).astype(float)
    frames[:30] *= 0.5
    frames[60:] = frames[60]
    return write_clip(tmp_path_factory.mktemp("film") / "film.mp4", frames.astype(np.uint8))


def test_the_window_is_where_picture_and_motion_are_as_usual(film, tmp_path):
    read, runner = part(film, tmp_path, "read.max_frames=16")
    # pieces are of two frames: the last one may hold one that stands still
    assert 30 / 25 <= read.start + 0.02 and end_of(read) <= 62 / 25
    clip = read_clip(film, start=read.start, duration=read.duration)
    assert len(clip) == 16
    (told,) = runner.warnings
    assert code_of(told) == "window-of-a-long-clip" and "has 80 frames: the 16 from" in told


def test_it_is_chosen_once_and_again_for_another_length(film, tmp_path):
    first, _ = part(film, tmp_path, "read.max_frames=16")
    again, runner = part(film, tmp_path, "read.max_frames=16")
    assert again == first and runner.timings["window"]["cached"]
    assert part(film, tmp_path, "read.max_frames=24")[0].duration == pytest.approx(24 / 25, abs=1e-3)


def test_within_a_trim_it_stays_within_it_and_a_short_one_is_left_alone(film, tmp_path):
    read, _ = part(film, tmp_path, "read.max_frames=10", "read.start=0.4", "read.duration=0.8")
    assert 0.4 <= read.start and end_of(read) <= 1.2 + 1e-6
    alone, runner = part(film, tmp_path, "read.max_frames=20", "read.start=0.4", "read.duration=0.8")
    assert (alone.start, alone.duration) == (0.4, 0.8) and not runner.timings and runner.stages == ("read",)


def test_of_a_clip_with_cuts_it_lies_in_one_shot(film, tmp_path):
    first, last = stream_pictures(24, seed=3), 255 - stream_pictures(40, seed=4)[:, :, ::-1]
    clip = write_clip(tmp_path / "two.mp4", np.concatenate([first, last]))
    read, runner = part(clip, tmp_path / "work", "read.max_frames=30")
    assert read.start >= 0.94 and "longest shot" in runner.warnings[0]
    found = read_alone(Inputs(clip), tmp_path / "alone", build_config(None, None, ("read.max_frames=30",), {}))
    assert len(found.clip) == 30 and not found.cuts


def test_times_are_told_by_the_stamps_alone(film):
    times = frame_times(film, 25.0)
    assert len(times) == 80 and np.allclose(np.diff(times), 0.04) and frames_before(film, 0.4, 25.0) == 10


def test_an_asset_of_a_long_clip_says_so(film, tmp_path, hasty):
    from fluidlift.cli import WITH_WARNINGS, main

    folder = tmp_path / "long.fluid"
    assert main(["make", str(film), "-o", str(folder), "--size", "2", *hasty, "--max-frames", "12"]) == 4
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["provenance"]["config"]["read"]["duration"] == pytest.approx(12 / 25, abs=1e-3)
    assert "window-of-a-long-clip" in json.dumps(manifest) and WITH_WARNINGS == 4
