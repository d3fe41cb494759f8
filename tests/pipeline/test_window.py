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
from fluidlift.pipeline.other_times import same_view
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


STEPS = np.repeat((2, 2, 3, 2), 60)
"""px per frame of a stream whose third minute, as it were, is faster"""


@pytest.fixture(scope="module")
def uneven(tmp_path_factory):
    """240 frames of a stream with these steps."""
    first, last = stream_pictures(2, step=128)  # two halves of one texture, the rock and the banks with each
    still = (first == last).all(axis=-1, keepdims=True)
    texture = np.concatenate([last, first], axis=1)
    frames = [np.where(still, first, np.roll(texture, s, axis=1)[:, : first.shape[1]]) for s in np.cumsum(STEPS)]
    return write_clip(tmp_path_factory.mktemp("uneven") / "uneven.mp4", np.stack(frames))


def quarter(start: float) -> int:
    """Of that clip; a part begins half a frame before its first."""
    return int(25 * start + 0.75) // 60


def test_other_times_lie_apart_in_the_clip_and_beside_the_window(uneven, tmp_path):
    config = build_config(None, None, ("read.max_frames=24", "motion.targets=4"), {})
    runner = Runner(tmp_path, ("read",), progress=Silence())
    made, others = begin.windows(runner, GivenFiles.of(Inputs(uneven)).clip, config)
    parts = sorted((c.read.start, end_of(c.read)) for c in (made, *others))
    assert len(others) == 3 and all(a[1] <= b[0] + 1e-6 for a, b in zip(parts, parts[1:]))
    assert {quarter(start) for start, _ in parts} == {0, 1, 2, 3}  # one in each quarter
    assert [round(25 * (c.read.duration or 0)) for c in others] == [20, 20, 20]


def test_a_stretch_is_of_the_same_view_where_the_ground_lies_in_its_place(uneven, tmp_path):
    whole = read_clip(uneven).frames
    clips = [write_clip(tmp_path / "a.mp4", whole[:12]), write_clip(tmp_path / "b.mp4", whole[150:162]),
             write_clip(tmp_path / "c.mp4", np.roll(whole[150:162], 4, axis=2))]  # fmt: skip
    config = build_config(None, None, (), {})
    a, b, c = (read_alone(Inputs(clip), tmp_path / clip.stem, config) for clip in clips)
    assert same_view(a, b) and not same_view(a, c)


def test_a_long_clip_is_fitted_to_several_times_of_it(uneven, tmp_path, hasty, capsys):
    from fluidlift.cli import WITH_WARNINGS, main

    folder = tmp_path / "long.fluid"
    more = [
        "--kind",
        "stream",
        "--size",
        "2",
        "--set",
        "read.max_frames=24",
        "--set",
        "motion.targets=2",
        "--set",
        "fit.max_seconds=120",
    ]
    assert main(["make", str(uneven), "-o", str(folder), *hasty, *more]) == WITH_WARNINGS
    manifest = json.loads((folder / "manifest.json").read_text())
    times = manifest["metrics"]["elsewhere"]
    assert len(times) == 3 and all(t["targets"] == 2 for t in times)
    fast = [t["apart"] for t in times if quarter(t["start"]) == 2]
    usual = [t["apart"] for t in times if quarter(t["start"]) != 2]
    # three px per frame are half as much again as two; what is measured of them is off by a tenth
    assert len(fast) == 1 and 0.35 < fast[0] < 0.65 and max(usual) < 0.15
    assert manifest["metrics"]["fit_extra"]["windows"] == 4
    assert "other times" in " ".join(manifest["metrics"]["fit"]["notes"])
    capsys.readouterr()
    assert main(["fit", str(folder), "--json"]) in (0, WITH_WARNINGS)
    assert json.loads((folder / "manifest.json").read_text())["metrics"]["fit_extra"]["windows"] == 4
