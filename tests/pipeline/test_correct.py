"""Hints in the order of the stages: what they reach is done again, and nothing else."""

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.pipeline import Inputs, begin
from fluidlift.pipeline.find import FIND_STAGES, find_hints, identity_of, view
from fluidlift.pipeline.inputs import GivenFiles
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import GivenView
from fluidlift.pipeline.stages.correct import correct
from fluidlift.pipeline.work import Work
from fluidlift.seams import Silence
from fluidlift.types import Label, PixelFlow, PixelLabels, VideoClip
from fluidlift.types.hints import ClipHints, Region, Ruler
from fluidlift.types.stages import Flow, Read, Segmentation

SIZE = (32, 24)
ROCK = Region("rock", ((10.0, 10.0), (16.0, 10.0), (16.0, 16.0), (10.0, 16.0)))


def seen(frames=3):
    """Read, flow and labels of a picture whose lower half is fluid that runs 2 px per frame to the right."""
    w, h = SIZE
    clip = VideoClip(np.zeros((frames, h, w, 3), np.uint8), 0.1 * np.arange(frames), "made")
    displacement = np.zeros((frames - 1, h, w, 2), np.float16)
    displacement[..., 0] = 2.0
    flow = Flow(PixelFlow(displacement, np.ones((frames - 1, h, w), np.float16)), "dis")
    labels = np.full((frames, h, w), Label.BACKGROUND, np.uint8)
    labels[:, h // 2 :] = Label.FLUID
    found = Segmentation(PixelLabels(labels, np.full(labels.shape, 0.5, np.float16)), 0.5, 0.5, 1.0, False)
    return Read(clip, np.arange(frames), frames, 0.0, False), flow, found


def corrected(tmp_path, *regions):
    return correct(*seen(), tuple(regions), work=Work.alone(tmp_path))


def test_a_region_counts_as_given_in_all_frames(tmp_path):
    found = corrected(tmp_path, ROCK)
    assert (found.labels.labels[:, 13, 13] == Label.SOLID).all()
    assert (found.labels.confidence[:, 13, 13] == 1.0).all() and found.labels.confidence[0, 20, 2] == 0.5
    assert found.fluid_share < 0.5


def test_later_regions_lie_over_earlier_ones(tmp_path):
    again = Region("fluid", ROCK.line)
    assert (corrected(tmp_path, ROCK, again).labels.labels[:, 13, 13] == Label.FLUID).all()


def test_a_region_that_moves_goes_with_the_fluid(tmp_path):
    moving = Region("not fluid", ((4.0, 14.0), (8.0, 14.0), (8.0, 20.0), (4.0, 20.0)), time=0.0, moves=True)
    labels = corrected(tmp_path, moving).labels.labels
    gone = [np.flatnonzero(labels[t, 17] == Label.BACKGROUND).min() for t in range(3)]
    assert gone == [gone[0], gone[0] + 2, gone[0] + 4]


def test_regions_that_leave_no_fluid_are_refused_by_number(tmp_path):
    everything = Region("not fluid", ((-5.0, -5.0), (50.0, -5.0), (50.0, 50.0), (-5.0, 50.0)))
    with pytest.raises(InputRejected, match=r"leave no fluid \(region 1"):
        corrected(tmp_path, everything)


def test_a_region_outside_the_picture_is_refused(tmp_path):
    with pytest.raises(InputRejected, match=r"region 1 .rock. lies outside the 32 x 24"):
        corrected(tmp_path, Region("rock", ((100.0, 100.0), (110.0, 100.0), (110.0, 110.0))))


@pytest.fixture(scope="module")
def looked(stream_clip, tmp_path_factory):
    """A folder in which the small clip was looked at once, and its identity."""
    folder = tmp_path_factory.mktemp("look") / "look"
    config = build_config("draft")
    return stream_clip, folder, config, identity_of(stream_clip), find_hints(Inputs(stream_clip), folder, config)


def again(looked, hints):
    """The stages that hints have done again, and the runner's values."""
    clip, folder, config, _, _ = looked
    runner = Runner(folder, begin.stages_of(FIND_STAGES, hints), progress=Silence())
    given = GivenFiles.of(Inputs(clip))
    found = begin.look(runner, given, config, said=hints)
    settings = begin.geometry_settings(found[0], config, hints)
    seen = runner.run("view", view, *found, GivenView.of(given, config), settings)
    return [name for name, t in runner.timings.items() if not t["cached"]], found, seen


def test_only_what_depends_on_a_hint_is_done_again(looked):
    identity = looked[3]
    w, h = identity.size
    level = ClipHints(identity, horizon=((0.0, 0.1 * h), (float(w), 0.1 * h)))
    assert again(looked, level)[0] == ["view"]
    assert again(looked, ClipHints(identity))[0] == []
    area = Region("rock", ((0.4 * w, 0.5 * h), (0.5 * w, 0.5 * h), (0.5 * w, 0.6 * h)))
    assert again(looked, ClipHints(identity, regions=(area,)))[0] == ["correct", "view"]


def test_a_drawn_horizon_and_a_ruler_are_taken(looked):
    identity = looked[3]
    w, h = identity.size
    hints = ClipHints(
        identity, horizon=((0.0, -0.3 * h), (float(w), -0.3 * h)),
        ruler=Ruler((0.3 * w, 0.6 * h), (0.7 * w, 0.6 * h), 2.0),
    )  # fmt: skip
    seen = again(looked, hints)[2]
    half = 0.8 * h * 2 * np.tan(np.radians(25.0)) / max(w, h)
    assert seen.up.pitch == pytest.approx(np.degrees(np.arctan(half)), abs=0.1) and seen.up.source == "user"
    assert seen.scale.source == "ruler" and not seen.scale.warning


def test_what_was_found_is_told_in_px_of_the_clip(looked):
    facts = looked[4].facts()
    (w, h), area = looked[3].size, np.array(facts["mask"][0]["area"])
    assert facts["kind"] == "stream" and facts["flow"]
    assert 0.5 * w < area[:, 0].max() <= w and area[:, 1].max() <= h


def test_a_horizon_and_a_pitch_contradict_each_other(looked):
    clip, _, _, identity, _ = looked
    hints = ClipHints(identity, horizon=((0.0, 1.0), (9.0, 1.0)))
    with pytest.raises(InputRejected, match="two horizons"):
        begin.look(
            Runner(looked[1], FIND_STAGES, progress=Silence()), GivenFiles.of(Inputs(clip)),
            build_config("draft", flat={"shape.pitch": 10.0}), said=hints,
        )  # fmt: skip
