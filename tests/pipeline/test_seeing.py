"""What the first stages see of a clip, and that it does not depend on how it was cut into parts."""

import weakref

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.io.stage_cache import parts_of
from fluidlift.motion.optical_flow import estimate_flow, mean_flow
from fluidlift.pipeline import pair_flow, reading, seeing
from fluidlift.pipeline.reading import Inputs, clip_of
from fluidlift.pipeline.seeing import NO_HINTS, FluidMasks, Hints, flow_of, mean_motion, pairs_of
from fluidlift.pipeline.story import Result, Silence, Story
from fluidlift.types import Label, PixelFlow


def told(clip, folder, *overrides):
    """The story of reading a clip."""
    story, config = Story(folder, ("read", "flow"), progress=Silence()), build_config(overrides=overrides)
    story.run("read", lambda: reading.read(story, Inputs(clip), config), settings=[str(clip), overrides], after=())
    return story, config


@pytest.fixture(scope="module")
def seen(stream_clip, tmp_path_factory):
    """The small clip with its flow."""
    story, config = told(stream_clip, tmp_path_factory.mktemp("seen") / "x")
    story.run("flow", lambda: seeing.flow(story, Inputs(stream_clip), config), settings=None, after=("read",))
    return story


@pytest.mark.parametrize("method", ["multiframe", "dis"])
def test_flow_in_windows_is_that_of_the_whole_clip(stream_clip, tmp_path, method, monkeypatch):
    """The halo of each window is longer than this clip, so that every pair has all its neighbours in time."""
    monkeypatch.setattr(pair_flow, "windows", lambda pairs, room: [(t, min(t + 4, pairs)) for t in range(0, pairs, 4)])
    story, config = told(stream_clip, tmp_path / "x", f"motion.method={method}")
    story.run("flow", lambda: seeing.flow(story, Inputs(stream_clip), config), settings=None, after=("read",))
    whole, found = estimate_flow(np.asarray(clip_of(story).frames), method=method), flow_of(story)
    np.testing.assert_array_equal(found.displacement, whole.displacement.astype(np.float16))
    np.testing.assert_array_equal(found.confidence, whole.confidence)


@pytest.mark.parametrize(("pairs", "room"), [(10, 10), (11, 10), (500, 100), (37, 1)])
def test_windows_of_flow_cover_every_pair_once_within_the_room(pairs, room):
    found = pair_flow.windows(pairs, room)
    assert [t for first, last in found for t in range(first, last)] == list(range(pairs))
    assert len(found) == 1 or max(b - a for a, b in found) + 2 * pair_flow.HALO <= max(room, 3 * pair_flow.HALO)


def test_one_window_of_flow_is_in_memory_at_a_time(monkeypatch):
    held = []

    def estimate(frames, **_):
        assert [ref() for ref in held if ref() is not None] == []
        shape = (len(frames) - 1, *frames.shape[1:3])
        found = PixelFlow(np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float16))
        held.append(weakref.ref(found.displacement))
        return found

    monkeypatch.setattr(pair_flow, "estimate_flow", estimate)
    monkeypatch.setattr(pair_flow, "WINDOW_BYTES", 1)
    for last in pair_flow.each_pair(np.zeros((101, 4, 6, 3), np.uint8), "dis"):  # noqa: B007  a reader holds the last one
        pass
    assert len(held) == -(-100 // pair_flow.HALO) and last[0].shape == (4, 6, 2)


def test_the_mean_motion_in_bands_is_that_of_the_whole_picture(seen):
    flow, mask = flow_of(seen), np.ones(clip_of(seen).frames.shape[1:3], bool)
    expected = mean_flow(PixelFlow(flow.displacement.astype(np.float32), flow.confidence.astype(np.float32)), mask)
    for found, whole in zip(mean_motion(seen, mask), expected):
        np.testing.assert_allclose(found, whole, atol=1e-6)  # float32 sums


def test_pairs_are_read_as_they_were_stored(seen):
    part = pairs_of(seen)(3, 5)
    assert part.displacement.dtype == np.float32
    np.testing.assert_array_equal(part.displacement, flow_of(seen).displacement[3:5])


def test_what_lies_on_disk_is_mapped_after_a_second_look(seen, stream_clip):
    story, _ = told(stream_clip, seen.folder)
    assert story.timings["read"]["cached"]
    assert isinstance(story["read"].arrays["frames"], np.memmap)


def test_repeated_frames_are_left_out_and_named(pictures, clip_file, tmp_path):
    """Every third frame twice, as a film at 24 frames per second is shown at 30 or so."""
    order = [0, 1, 1, 2, 3, 3, 4, 5, 5, 6, 7, 7, 8, 9, 9]
    clip = clip_file(tmp_path / "telecine.mp4", pictures(10)[order])
    story, _ = told(clip, tmp_path / "x")
    assert story["read"].meta["dropped_frames"] == [2, 5, 8, 11, 14]
    assert story["read"].arrays["kept"].tolist() == [0, 1, 3, 4, 6, 7, 9, 10, 12, 13]
    assert len(clip_of(story)) == 10
    assert any("repeat the one before" in w for w in story.warnings)


def test_frames_after_a_cut_are_named_as_in_the_file(pictures, clip_file, tmp_path):
    other = 255 - np.roll(pictures(12), 40, axis=2)
    story, _ = told(clip_file(tmp_path / "cut.mp4", np.concatenate([pictures(6), other])), tmp_path / "x")
    assert story["read"].arrays["kept"].tolist() == list(range(6, 18))
    assert any("only frames 6 to 17 are used" in w for w in story.warnings)
    assert sum("cut" in w for w in story.warnings) == 1


def test_steadying_can_be_left_out(stream_clip, tmp_path):
    story, _ = told(stream_clip, tmp_path / "x", "read.stabilise=false")
    assert len(clip_of(story)) == 10 and story["read"].meta["stabilised"] is False


def test_masks_are_the_fluid_of_the_labels():
    labels = np.random.default_rng(0).integers(0, 3, (7, 5, 4)).astype(np.uint8)
    masks = FluidMasks(labels)
    np.testing.assert_array_equal(masks[2], labels[2] == Label.FLUID)
    np.testing.assert_array_equal(masks.any_frame(), (labels == Label.FLUID).any(axis=0))
    np.testing.assert_array_equal(masks.areas(), (labels == Label.FLUID).sum(axis=(1, 2)))
    assert len(masks) == 7 and masks.shape == (7, 5, 4)


@pytest.mark.parametrize("size", [1, 40, 1000])
def test_parts_cover_an_array_once(size):
    array = np.arange(60.0).reshape(15, 4)
    np.testing.assert_array_equal(np.concatenate([array[p] for p in parts_of(array, size=size)]), array)


def test_hints_are_read_from_texts():
    hints = Hints.of("1,2,30,40", ["5,6", "7.5,8"], ["9,10"])
    assert hints.roi == (1, 2, 30, 40)
    assert hints.points == ((5, 6, True), (7.5, 8, True), (9, 10, False))
    assert Hints.of(None, [], []) == NO_HINTS and NO_HINTS.plain() is None
    with pytest.raises(InputRejected, match="--not-here"):
        Hints.of(None, [], ["here"])


def test_flow_by_a_learned_method_needs_its_weights(stream_clip, tmp_path):
    story, _ = told(stream_clip, tmp_path / "x")
    config = build_config(overrides=["motion.method=sea-raft"])
    with pytest.raises(InputRejected, match="weights"):
        seeing.flow(story, Inputs(stream_clip), config)


def test_a_stage_that_fails_leaves_no_large_file_behind(stream_clip, tmp_path):
    story, _ = told(stream_clip, tmp_path / "x")

    def fails():
        story.scratch.array("displacement", (3, 4), np.float16)
        raise InputRejected("no", "yes")

    with pytest.raises(InputRejected):
        story.run("flow", fails, settings=None, after=("read",))
    assert not list((tmp_path / "x" / "work" / "flow").glob(".*"))
    assert story.results.keys() == {"read"} and isinstance(story["read"], Result)
