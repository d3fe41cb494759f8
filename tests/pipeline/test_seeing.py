"""What the first stages see of a clip, and that it does not depend on how it was cut into parts."""

from dataclasses import replace
from fractions import Fraction

import av
import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.io.stage_cache import Scratch, parts_of
from fluidlift.motion.optical_flow import estimate_flow, mean_flow
from fluidlift.pipeline import reading, seeing
from fluidlift.pipeline.reading import Inputs, clip_of, spans_of
from fluidlift.pipeline.seeing import NO_HINTS, FluidMasks, Hints, flow_of, mean_motion, pairs_of
from fluidlift.pipeline.story import Result, Silence, Story
from fluidlift.seams import Segmenter
from fluidlift.types import Label, PixelFlow, PixelLabels


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


@pytest.mark.parametrize("method", ["multiframe", "farneback"])
def test_the_flow_on_disk_is_that_of_the_estimator_in_half_precision(stream_clip, tmp_path, method):
    story, config = told(stream_clip, tmp_path / "x", f"motion.method={method}")
    story.run("flow", lambda: seeing.flow(story, Inputs(stream_clip), config), settings=None, after=("read",))
    frames, found = np.asarray(clip_of(story).frames), flow_of(story)
    shape = (len(frames) - 1, *frames.shape[1:3])
    expected = np.empty((*shape, 2), np.float16), np.empty(shape, np.float16)
    estimate_flow(frames, method=method, out=expected)
    np.testing.assert_array_equal(found.displacement, expected[0])
    np.testing.assert_array_equal(found.confidence, expected[1])
    assert isinstance(story["flow"].arrays["displacement"], np.memmap)


UNEVEN = np.cumsum([0, 1, 1, 2, 1, 3, 1, 1, 1, 2, 1])
"""ticks of 0.04 s at which frames are shown"""


@pytest.fixture
def uneven(pictures, tmp_path):
    """A stream of steady speed, 2 px per tick to the right, whose frames are not shown at every tick."""
    clip = written_at(tmp_path / "uneven.mp4", pictures(int(UNEVEN[-1]) + 1)[UNEVEN], UNEVEN)
    story, config = told(clip, tmp_path / "x")
    story.run("flow", lambda: seeing.flow(story, Inputs(clip), config), settings=None, after=("read",))
    return story


def written_at(path, frames, ticks, rate=25):
    """A video whose frames are shown at given ticks of 1 / rate s."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.height, stream.width, stream.pix_fmt, stream.options = *frames.shape[1:3], "yuv444p", {"crf": "6"}
        for picture, tick in zip(frames, ticks):
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            frame.pts, frame.time_base = int(tick), Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_frames_that_lie_farther_apart_do_not_make_the_fluid_faster(uneven):
    """The middle of the channel moves by 2 px per tick; half a pixel is what the estimator errs by on 6 px steps."""
    flow, spans = pairs_of(uneven)(0, len(UNEVEN) - 1), np.diff(UNEVEN)
    np.testing.assert_allclose(spans_of(clip_of(uneven)), spans, rtol=1e-6)
    middle = flow.displacement[:, 26:44, 8:40, 0]
    np.testing.assert_allclose(np.median(middle, axis=(1, 2)), 2.0, atol=0.5)
    between = np.median(np.asarray(flow_of(uneven).displacement, float)[:, 26:44, 8:40, 0], axis=(1, 2))
    np.testing.assert_allclose(between, 2.0 * spans, atol=0.5 * spans.max())


def test_the_mean_motion_is_that_of_a_steady_frame_rate(uneven):
    mean, _ = mean_motion(uneven, np.ones((64, 96), bool))
    assert np.median(mean[26:44, 8:40, 0]) == pytest.approx(2.0, abs=0.2)  # px: averaged over ten pairs


def test_times_that_are_only_rounded_do_not_change_the_flow(seen):
    """A container with milliseconds shows 30 frames per second as steps of 33 and 34 ms."""
    clip = replace(clip_of(seen), times=np.round(np.arange(10) / 30, 3))
    assert (spans_of(clip) == 1).all()


def test_the_mean_motion_in_bands_is_that_of_the_whole_picture(seen):
    flow, mask = flow_of(seen), np.ones(clip_of(seen).frames.shape[1:3], bool)
    expected = mean_flow(PixelFlow(flow.displacement.astype(np.float32), flow.confidence.astype(np.float32)), mask)
    for found, whole in zip(mean_motion(seen, mask), expected):
        np.testing.assert_allclose(found, whole, atol=1e-6)  # float32 sums


def test_pairs_are_read_as_they_were_stored(seen):
    part = pairs_of(seen)(3, 5)
    assert part.displacement.dtype == np.float32
    np.testing.assert_array_equal(part.displacement, flow_of(seen).displacement[3:5])
    np.testing.assert_array_equal(part.confidence, flow_of(seen).confidence[3:5])


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


class Recorder(Segmenter):
    """Stands for SAM 2: says what its first guess says."""

    def __init__(self, guess):
        self.guess = guess

    def segment(self, clip, flow, *, out=None):
        labels, confidence = out
        found = self.guess(clip, flow)
        labels[:], confidence[:] = found.labels, found.confidence
        return PixelLabels(labels, confidence)


def test_hints_reach_a_learned_method_through_its_first_guess(seen, stream_clip, monkeypatch):
    monkeypatch.setattr(seeing, "make_segmenter", lambda name, choice, *, guess, **_: Recorder(guess))
    config = build_config(overrides=["segment.method=sam2"])
    seen.scratch = Scratch(seen.folder, "segment")
    whole = seeing.segment(seen, Inputs(stream_clip), config).arrays["labels"] == Label.FLUID
    seen.scratch = Scratch(seen.folder, "segment")
    hints = Hints.of("0,0,48,64", [], [])
    found = seeing.segment(seen, Inputs(stream_clip), config, hints).arrays["labels"] == Label.FLUID
    assert whole[:, 26:44, 70:].any() and found[:, 26:44, 8:40].any() and not found[:, :, 50:].any()


def test_a_method_that_goes_by_words_takes_no_hints(seen, stream_clip):
    with pytest.raises(InputRejected, match="sam3"):
        seeing.segment(
            seen, Inputs(stream_clip), build_config(overrides=["segment.method=sam3"]), Hints.of("0,0,48,64", [], [])
        )
