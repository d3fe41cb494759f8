"""Regions that a person drew, over the labels that were found."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.messages import code_of
from fluidlift.pipeline.hints import laid_on, time_laid_on
from fluidlift.pipeline.stages.correct import correct, nothing_found
from fluidlift.pipeline.work import Work
from fluidlift.shape.fluid_found import likely_overlap
from fluidlift.types import Label, PixelFlow, PixelLabels, VideoClip
from fluidlift.types.hints import Click, ClipHints, ClipIdentity, Region
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


def shaken():
    """A clip whose second frame looks 6 px to the right of the first and 2 px below it, laid on the first."""
    path = np.array([[0.0, 0.0], [6.0, 2.0], [0.0, 0.0]])
    return replace(seen()[0], stabilised=True, path=path)


@pytest.mark.parametrize(("time", "lies"), [(0.1, (11.0, 9.0)), (0.0, (5.0, 7.0)), (None, (5.0, 7.0))])
def test_a_point_lies_where_the_frame_that_it_was_drawn_on_was_laid(time, lies):
    w, h = SIZE
    hints = ClipHints(ClipIdentity("made", (2 * w, 2 * h), time=time), clicks=(Click((10.0, 14.0), True),))
    drawn, said = laid_on(hints, shaken())
    assert drawn.clicks[0].at == lies and not said
    assert laid_on(hints, replace(shaken(), stabilised=False))[0].clicks[0].at == (5.0, 7.0)


def test_points_of_a_frame_that_is_not_in_use_are_told_where_the_camera_moves():
    hints = ClipHints(ClipIdentity("made", SIZE, time=7.0), clicks=(Click((10.0, 14.0), True),))
    assert code_of(laid_on(hints, shaken())[1]) == "hints-of-another-part"
    assert not laid_on(replace(hints, clicks=()), shaken())[1] and not laid_on(hints, seen()[0])[1]


def test_the_frame_that_others_are_laid_on_is_known_by_its_time():
    assert time_laid_on(shaken()) == 0.0 and time_laid_on(seen()[0]) is None


def test_a_region_counts_as_given_in_all_frames(tmp_path):
    found = corrected(tmp_path, ROCK)
    assert (found.labels.labels[:, 13, 13] == Label.SOLID).all()
    assert (found.labels.confidence[:, 13, 13] == 1.0).all() and found.labels.confidence[0, 20, 2] == 0.5
    assert found.fluid_share < 0.5


def test_what_a_person_drew_raises_how_likely_a_mask_is_right_and_is_all_of_it_where_nothing_was_found(tmp_path):
    read, flow, found = seen()
    found = replace(found, likely_overlap=likely_overlap(found.labels.labels, found.labels.confidence))
    all_of_it = Region("fluid", ((-1.0, 15.0), (60.0, 15.0), (60.0, 60.0), (-1.0, 60.0)))
    drawn = correct(read, flow, found, (all_of_it,), work=Work.alone(tmp_path))
    assert drawn.likely_overlap > found.likely_overlap > 0.5
    (tmp_path / "none").mkdir()
    nothing = nothing_found(read, work=Work.alone(tmp_path / "none"))
    (tmp_path / "alone").mkdir()
    alone = correct(read, flow, nothing, (all_of_it,), work=Work.alone(tmp_path / "alone"))
    assert nothing.likely_overlap is None and alone.likely_overlap is None  # there is no chance to speak of


def test_a_region_is_there_while_it_is_said_to_be(tmp_path):
    fills = replace(ROCK, what="not fluid", begins=0.1, ends=0.2)
    shown = corrected(tmp_path, fills).labels.labels[:, 13, 13]
    assert shown.tolist() == [Label.FLUID, Label.BACKGROUND, Label.FLUID]
    later = replace(ROCK, moves=True, begins=0.1)
    shown = corrected(tmp_path, later).labels.labels
    assert not (shown[0] == Label.SOLID).any() and (shown[1] == Label.SOLID).any()


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
