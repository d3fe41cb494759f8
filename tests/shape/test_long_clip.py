"""A clip of any length: a bounded sample tells what is fluid, and memory does not grow."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from fluidlift.shape.frame_pictures import MOST_SAMPLED, FramePictures, sampled_frames
from fluidlift.shape.segment import segment
from fluidlift.types.clip import VideoClip
from fluidlift.types.flow import PixelFlow

HEIGHT, WIDTH = 48, 64


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_a_short_clip_is_looked_at_as_a_whole_and_a_long_one_in_bursts():
    assert np.array_equal(sampled_frames(90, 0.04), np.arange(90))
    for frames, interval in ((400, 0.04), (9000, 1 / 30), (9000, 1 / 240), (3000, 0.1)):
        sampled = sampled_frames(frames, interval)
        assert len(sampled) <= MOST_SAMPLED and sampled[0] == 0 and sampled[-1] == frames - 1
        runs = np.split(sampled, np.flatnonzero(np.diff(sampled) > 1) + 1)
        assert min(len(run) for run in runs) >= 15 and len(runs) >= 3


def test_pairs_of_the_sample_never_reach_from_one_burst_to_the_next():
    frames = np.random.default_rng(0).integers(0, 255, (400, 8, 8, 3), np.uint8)
    pictures = FramePictures(frames, sampled_frames(400, 0.04), 1.0)
    for lag in (1, 5):
        pairs = pictures.pairs(lag)
        assert (np.diff(pictures.sampled[pairs], axis=1) == lag).all() and len(pairs) > 50
    assert np.array_equal(pictures[int(pictures.sampled[40])], pictures.kept[40])


def film(folder: Path, frames: int) -> tuple[VideoClip, PixelFlow, np.ndarray]:
    """A band of water that runs to the right, in files; and its mask."""
    rng = np.random.default_rng(2)
    room = 90.0 + 15.0 * rng.random((HEIGHT, WIDTH, 1))
    pattern = 60.0 * rng.random((HEIGHT, WIDTH, 1)).repeat(3, axis=2)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[18:36] = True
    shape = (frames, HEIGHT, WIDTH, 3)
    pictures = np.memmap(folder / "frames", np.uint8, "w+", shape=shape)
    displacement = np.memmap(folder / "flow", np.float16, "w+", shape=(frames - 1, HEIGHT, WIDTH, 2))
    sure = np.memmap(folder / "sure", np.float16, "w+", shape=(frames - 1, HEIGHT, WIDTH))
    for t in range(frames):
        picture = np.where(mask[..., None], 60.0 + np.roll(pattern, 2 * t, axis=1), room)
        pictures[t] = np.clip(picture + rng.normal(size=picture.shape), 0, 255).round().astype(np.uint8)
    displacement[:, mask, 0], sure[:] = 2.0, 1.0
    return VideoClip(pictures, np.arange(frames) / 25.0), PixelFlow(displacement, sure), mask


def arrays(folder: Path, frames: int) -> tuple[np.ndarray, np.ndarray]:
    shape = (frames, HEIGHT, WIDTH)
    labels = np.memmap(folder / "labels", np.uint8, "w+", shape=shape)
    return labels, np.memmap(folder / "confidence", np.float16, "w+", shape=shape)


def test_memory_does_not_grow_with_the_clip_when_labels_go_to_files(tmp_path):
    peaks = []
    for frames in (300, 900):
        folder = tmp_path / str(frames)
        folder.mkdir()
        clip, flow, mask = film(folder, frames)
        out = arrays(folder, frames)
        tracemalloc.start()
        labels = segment(clip, flow, out=out)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert labels.labels is out[0] and labels.confidence is out[1]
        for t in (0, frames // 2, frames - 1):
            # an outline of 2 x 64 px, off by less than 2 px on a band of 18 px
            assert overlap(labels.fluid[t], mask) > 0.8, t
    # the sample is the same; times and small maps per frame (a few hundred bytes each) may grow
    assert peaks[1] < 1.1 * peaks[0], peaks


def test_arrays_of_another_size_or_type_are_refused(tmp_path):
    clip, flow, _ = film(tmp_path, 12)
    with pytest.raises(ValueError, match="out"):
        segment(clip, flow, out=(np.zeros((12, HEIGHT, WIDTH), bool), np.zeros((12, HEIGHT, WIDTH), np.float16)))
    with pytest.raises(ValueError, match="out"):
        segment(clip, flow, out=arrays(tmp_path, 13))


def test_the_mask_of_the_user_is_written_to_the_arrays_too(tmp_path):
    clip, flow, mask = film(tmp_path, 12)
    out = arrays(tmp_path, 12)
    labels = segment(clip, flow, user_mask=mask, out=out)
    assert labels.labels is out[0] and np.array_equal(labels.fluid[5], mask) and (out[1] == 1).all()
