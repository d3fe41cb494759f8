"""Footage is brought to the rate of the asset that it is held against."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.pipeline.compare import at_rate
from fluidlift.types import VideoClip


def footage(numbers, fps):
    """A clip that shows these pictures, each number another one."""
    drawn = np.random.default_rng(3).integers(0, 255, (max(numbers) + 1, 24, 32, 3)).astype(np.uint8)
    return VideoClip(drawn[list(numbers)], 2.0 + np.arange(len(numbers)) / fps, "made"), drawn


def shown(clip, drawn):
    """The numbers of its pictures."""
    return [int(np.abs(drawn.astype(int) - frame).sum(axis=(1, 2, 3)).argmin()) for frame in clip.frames]


def test_footage_of_the_same_rate_stays_as_it_is():
    clip, drawn = footage(range(20), 25.0)
    found = at_rate(clip, 0.04)
    assert shown(found, drawn) == list(range(20)) and found.times == pytest.approx(clip.times)


def test_of_more_frames_those_nearest_to_the_instants_are_taken():
    clip, drawn = footage(range(40), 50.0)
    assert shown(at_rate(clip, 0.04), drawn) == list(range(0, 40, 2))


def test_frames_that_repeat_the_one_before_are_left_out():
    # 25 frames a second, played at 30: every fifth is shown twice
    clip, drawn = footage([k - k // 6 for k in range(36)], 30.0)
    found = at_rate(clip, 0.04)
    numbers = shown(found, drawn)
    assert np.mean(np.diff(numbers) == 1) > 0.9 and min(np.diff(numbers)) >= 1, numbers
    assert len(found) == pytest.approx(30, abs=1)


def test_fewer_frames_are_refused():
    with pytest.raises(InputRejected, match=r"footage of 12\.5 frames per second and an asset of 25"):
        at_rate(footage(range(12), 12.5)[0], 0.04)
