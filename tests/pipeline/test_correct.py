"""Regions that a person drew, over the labels that were found."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.pipeline.stages.correct import correct
from fluidlift.pipeline.work import Work
from fluidlift.types import Label, PixelFlow, PixelLabels, VideoClip
from fluidlift.types.hints import Region
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
