"""Frames that repeat are found, named and left out; a fluid that is merely slow is not touched."""

import cv2
import numpy as np
import pytest

from fluidlift.motion.cadence import examine_cadence, source_rate, without_duplicates
from fluidlift.types import VideoClip


def drifting(frames: int, step: float = 3.0, noise: float = 1.5, seed: int = 0) -> np.ndarray:
    """A texture that moves by `step` px per frame to the right, with camera noise."""
    rng = np.random.default_rng(seed)
    wide = cv2.GaussianBlur(rng.uniform(0, 255, (72, 128 + int(frames * abs(step)) + 2)).astype(np.float32), (0, 0), 2)
    wide = (wide - wide.mean()) * 4 + 128
    out = []
    for t in range(frames):
        shift = np.array([[1, 0, -t * step], [0, 1, 0]], np.float32)
        grey = cv2.warpAffine(wide, shift, (128, 72), borderMode=cv2.BORDER_REFLECT) + rng.normal(0, noise, (72, 128))
        out.append(np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, -1))
    return np.stack(out)


def recoded(frames: np.ndarray, seed: int = 1) -> np.ndarray:
    """Each picture a little different, as a second coding leaves it."""
    rng = np.random.default_rng(seed)
    return np.clip(frames.astype(np.int16) + rng.integers(-1, 2, frames.shape), 0, 255).astype(np.uint8)


def clip_of(frames: np.ndarray, fps: float = 30.0) -> VideoClip:
    return VideoClip(frames, np.arange(len(frames)) / fps, "clip.mp4")


@pytest.mark.parametrize(("source", "display"), [(24.0, 30.0), (25.0, 30.0), (12.0, 30.0), (10.0, 25.0)])
def test_a_frame_rate_conversion_is_undone_and_its_source_rate_found(source, display):
    real = drifting(int(source * 2))
    shown = np.minimum(np.arange(int(2 * display)) * source / display + 1e-9, len(real) - 1).astype(int)
    clip = clip_of(recoded(real[shown]), display)
    report = examine_cadence(clip.frames, clip.times)
    assert report.duplicates == tuple(np.flatnonzero(np.diff(shown) == 0) + 1)
    # the rate is read from display instants, each up to one interval off, over two seconds
    assert report.source_rate == pytest.approx(source, rel=0.02)
    mended = without_duplicates(clip, report)
    assert len(mended) == len(np.unique(shown))
    # equal intervals again, which floating point keeps to a nanosecond
    assert np.ptp(np.diff(mended.times)) < 1e-9
    assert not report.frozen
    assert f"{report.duplicates[0]}" in report.warnings[0]


def test_frames_that_repeat_without_a_beat_are_left_out_at_their_own_times():
    real = drifting(40)
    shown = np.arange(40)
    shown[[5, 6, 7]] = 4  # a hiccup: three repeats, then it goes on where it would have been
    shown[20] = 19
    clip = clip_of(real[shown])
    report = examine_cadence(clip.frames, clip.times)
    assert report.duplicates == (5, 6, 7, 20)
    assert report.source_rate is None
    mended = without_duplicates(clip, report)
    assert np.array_equal(mended.times, np.delete(clip.times, [5, 6, 7, 20]))


def test_a_frozen_stretch_is_named_and_the_longest_live_part_kept():
    real = drifting(60)
    shown = np.concatenate([np.arange(15), np.full(25, 14), np.arange(15, 60)])
    clip = clip_of(real[shown])
    report = examine_cadence(clip.frames, clip.times)
    assert report.frozen == ((14, 39),)
    assert report.kept == tuple(range(39, 85))
    assert "frames 14 to 39" in report.warnings[0]
    assert len(without_duplicates(clip, report)) == 46


@pytest.mark.parametrize("step", [0.05, 0.3, 3.0])
def test_a_slow_or_steady_motion_has_no_repeats(step):
    clip = clip_of(drifting(30, step))
    report = examine_cadence(clip.frames, clip.times)
    assert report.duplicates == () and report.kept == tuple(range(30))
    assert without_duplicates(clip, report) is clip


def test_a_flash_does_not_make_the_rest_pass_for_a_still():
    frames = drifting(30, 0.05)
    frames[12] = np.clip(frames[12].astype(int) + 90, 0, 255).astype(np.uint8)
    assert examine_cadence(frames, np.arange(30) / 30).duplicates == ()


def test_the_motion_that_begins_after_a_still_keeps_its_first_picture():
    real = drifting(40)
    shown = np.concatenate([np.zeros(30, int), np.arange(1, 40)])
    report = examine_cadence(real[shown], np.arange(69) / 30)
    assert report.frozen == ((0, 29),)
    assert report.kept == tuple(range(29, 69))


def test_a_report_of_another_clip_is_refused():
    real = drifting(20)
    shown = np.repeat(np.arange(20), 2)
    report = examine_cadence(real[shown], np.arange(40) / 30)
    with pytest.raises(ValueError, match="another clip"):
        without_duplicates(clip_of(real), report)


def test_a_beat_needs_frames_enough_to_be_heard():
    assert source_rate(np.array([0, 2, 4]), np.arange(6) / 30) is None
