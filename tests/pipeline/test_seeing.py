"""What the first stages see of a clip, and that it does not depend on how it was cut into parts."""

from dataclasses import dataclass, replace
from fractions import Fraction

import av
import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.io.hashes import file_hash
from fluidlift.messages import code_of
from fluidlift.motion.optical_flow import estimate_flow, mean_flow
from fluidlift.motion.steady_flow import mean_motion, pairs_of, spans_of
from fluidlift.pipeline.hints import NO_HINTS, MaskHints
from fluidlift.pipeline.inputs import GivenFile
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import FlowSettings, ReadSettings, SegmentSettings
from fluidlift.pipeline.stages import segment as segmenting
from fluidlift.pipeline.stages.flow import estimated_flow
from fluidlift.pipeline.stages.read import read
from fluidlift.pipeline.stages.segment import segment
from fluidlift.pipeline.work import Work
from fluidlift.seams import Segmenter, Silence
from fluidlift.types import Label, PixelFlow, PixelLabels
from fluidlift.types.fluid_masks import FluidMasks, parts_of
from fluidlift.types.stages import Flow, Read


@dataclass(frozen=True)
class Watched:
    """A clip that is read and whose flow is measured."""

    runner: Runner
    read: Read
    flow: Flow

    @property
    def clip(self):
        return self.read.clip

    def motion(self, mask):
        return mean_motion(self.clip, self.flow.flow, mask)

    def pairs(self, first, last):
        return pairs_of(self.clip, self.flow.flow)(first, last)


def opened(clip, folder, *overrides):
    """A runner that has read a clip, what it has read, and the settings."""
    runner, config = Runner(folder, ("read", "flow"), progress=Silence()), build_config(overrides=overrides)
    given = GivenFile(clip, file_hash(clip))
    return runner, runner.run("read", read, given, None, ReadSettings.of(config)), config


def watched(clip, folder, *overrides):
    """A clip with its flow."""
    runner, found, config = opened(clip, folder, *overrides)
    return Watched(runner, found, runner.run("flow", estimated_flow, found, FlowSettings.of(config)))


@pytest.fixture(scope="module")
def seen(stream_clip, tmp_path_factory):
    """The small clip with its flow."""
    return watched(stream_clip, tmp_path_factory.mktemp("seen") / "x")


@pytest.mark.parametrize("method", ["multiframe", "farneback"])
def test_the_flow_on_disk_is_that_of_the_estimator_in_half_precision(stream_clip, tmp_path, method):
    found = watched(stream_clip, tmp_path / "x", f"motion.method={method}")
    frames, flow = np.asarray(found.clip.frames), found.flow.flow
    shape = (len(frames) - 1, *frames.shape[1:3])
    expected = np.empty((*shape, 2), np.float16), np.empty(shape, np.float16)
    estimate_flow(frames, method=method, out=expected)
    np.testing.assert_array_equal(flow.displacement, expected[0])
    np.testing.assert_array_equal(flow.confidence, expected[1])
    assert isinstance(flow.displacement, np.memmap)


UNEVEN = np.cumsum([0, 1, 1, 2, 1, 3, 1, 1, 1, 2, 1])
"""ticks of 0.04 s at which frames are shown"""


@pytest.fixture
def uneven(pictures, tmp_path):
    """A stream of steady speed, 2 px per tick to the right, whose frames are not shown at every tick."""
    clip = written_at(tmp_path / "uneven.mp4", pictures(int(UNEVEN[-1]) + 1)[UNEVEN], UNEVEN)
    return watched(clip, tmp_path / "x")


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
    flow, spans = uneven.pairs(0, len(UNEVEN) - 1), np.diff(UNEVEN)
    np.testing.assert_allclose(spans_of(uneven.clip), spans, rtol=1e-6)
    middle = flow.displacement[:, 26:44, 8:40, 0]
    np.testing.assert_allclose(np.median(middle, axis=(1, 2)), 2.0, atol=0.5)
    between = np.median(np.asarray(uneven.flow.flow.displacement, float)[:, 26:44, 8:40, 0], axis=(1, 2))
    np.testing.assert_allclose(between, 2.0 * spans, atol=0.5 * spans.max())


def test_the_mean_motion_is_that_of_a_steady_frame_rate(uneven):
    mean, _ = uneven.motion(np.ones((64, 96), bool))
    assert np.median(mean[26:44, 8:40, 0]) == pytest.approx(2.0, abs=0.2)  # px: averaged over ten pairs


def test_times_that_are_only_rounded_do_not_change_the_flow(seen):
    """A container with milliseconds shows 30 frames per second as steps of 33 and 34 ms."""
    clip = replace(seen.clip, times=np.round(np.arange(10) / 30, 3))
    assert (spans_of(clip) == 1).all()


def test_the_mean_motion_in_bands_is_that_of_the_whole_picture(seen):
    flow, mask = seen.flow.flow, np.ones(seen.clip.frames.shape[1:3], bool)
    expected = mean_flow(PixelFlow(flow.displacement.astype(np.float32), flow.confidence.astype(np.float32)), mask)
    for found, whole in zip(seen.motion(mask), expected):
        np.testing.assert_allclose(found, whole, atol=1e-6)  # float32 sums


def test_pairs_are_read_as_they_were_stored(seen):
    part = seen.pairs(3, 5)
    assert part.displacement.dtype == np.float32
    np.testing.assert_array_equal(part.displacement, seen.flow.flow.displacement[3:5])
    np.testing.assert_array_equal(part.confidence, seen.flow.flow.confidence[3:5])


def test_what_lies_on_disk_is_mapped_after_a_second_look(seen, stream_clip):
    runner, found, _ = opened(stream_clip, seen.runner.folder)
    assert runner.timings["read"]["cached"]
    assert isinstance(found.clip.frames, np.memmap)


def test_repeated_frames_are_left_out_and_named(pictures, clip_file, tmp_path):
    """Every third frame twice, as a film at 24 frames per second is shown at 30 or so."""
    order = [0, 1, 1, 2, 3, 3, 4, 5, 5, 6, 7, 7, 8, 9, 9]
    clip = clip_file(tmp_path / "telecine.mp4", pictures(10)[order])
    runner, found, _ = opened(clip, tmp_path / "x")
    assert found.dropped == [2, 5, 8, 11, 14]
    assert found.kept.tolist() == [0, 1, 3, 4, 6, 7, 9, 10, 12, 13]
    assert len(found.clip) == 10
    assert "repeated-frames" in map(code_of, runner.warnings)


def test_frames_after_a_cut_are_named_as_in_the_file(pictures, clip_file, tmp_path):
    other = 255 - np.roll(pictures(12), 40, axis=2)
    clip = clip_file(tmp_path / "cut.mp4", np.concatenate([pictures(6), other]))
    runner, found, _ = opened(clip, tmp_path / "x")
    assert found.kept.tolist() == list(range(6, 18))
    assert any("only frames 6 to 17 are used" in w for w in runner.warnings)
    assert [code_of(w) for w in runner.warnings].count("clip-cut-short") == 1


def test_steadying_can_be_left_out(stream_clip, tmp_path):
    _, found, _ = opened(stream_clip, tmp_path / "x", "read.stabilise=false")
    assert len(found.clip) == 10 and found.stabilised is False


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
    hints = MaskHints.of("1,2,30,40", ["5,6", "7.5,8"], ["9,10"])
    assert hints.roi == (1, 2, 30, 40)
    assert hints.points == ((5, 6, True), (7.5, 8, True), (9, 10, False))
    assert MaskHints.of(None, [], []) == NO_HINTS
    with pytest.raises(InputRejected, match="--not-here"):
        MaskHints.of(None, [], ["here"])


def test_flow_by_a_learned_method_needs_its_weights(seen, tmp_path):
    config = FlowSettings.of(build_config(overrides=["motion.method=sea-raft"]))
    with pytest.raises(InputRejected, match="weights"):
        estimated_flow(seen.read, config, work=Work.alone(tmp_path))


def fails(read: Read, *, work: Work) -> Flow:
    """A stage that is stopped while its flow is on the way to disk."""
    work.scratch.array("displacement", (3, 4), np.float16)
    raise InputRejected("no", "yes")


def test_a_stage_that_fails_leaves_no_large_file_behind(stream_clip, tmp_path):
    runner, found, _ = opened(stream_clip, tmp_path / "x")
    with pytest.raises(InputRejected):
        runner.run("flow", fails, found)
    assert not list((tmp_path / "x" / "work" / "flow").glob(".*"))
    assert runner.timings.keys() == {"read"} and isinstance(found, Read)


class Recorder(Segmenter):
    """Stands for SAM 2: says what its first guess says."""

    def __init__(self, guess):
        self.guess = guess

    def segment(self, clip, flow, *, out=None):
        labels, confidence = out
        found = self.guess(clip, flow)
        labels[:], confidence[:] = found.labels, found.confidence
        return PixelLabels(labels, confidence)


@pytest.fixture
def fluid(seen, tmp_path):
    """What is fluid in the small clip, found by a method with hints."""

    def find(method, hints=NO_HINTS):
        config = SegmentSettings.of(build_config(overrides=[f"segment.method={method}"]))
        found = segment(seen.read, seen.flow, None, config, hints, work=Work.alone(tmp_path))
        return found.labels.labels == Label.FLUID

    return find


def test_hints_reach_a_learned_method_through_its_first_guess(fluid, monkeypatch):
    monkeypatch.setattr(segmenting, "make_segmenter", lambda name, choice, *, guess, **_: Recorder(guess))
    whole, found = fluid("sam2"), fluid("sam2", MaskHints.of("0,0,48,64", [], []))
    assert whole[:, 26:44, 70:].any() and found[:, 26:44, 8:40].any() and not found[:, :, 50:].any()


def test_a_method_that_goes_by_words_takes_no_hints(fluid):
    with pytest.raises(InputRejected, match="sam3"):
        fluid("sam3", MaskHints.of("0,0,48,64", [], []))
