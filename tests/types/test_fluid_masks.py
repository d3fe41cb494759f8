"""What masks of a clip say as a whole."""

import numpy as np
import pytest

from fluidlift.types.clip import Label
from fluidlift.types.fluid_masks import STAYS, FluidMasks, outline_grows, share_that_stays


def rising(first: int, last: int, frames: int = 10) -> np.ndarray:
    """Columns of water whose level goes from one row to another, counted from below."""
    levels = np.linspace(first, last, frames)
    rows = np.arange(40)[::-1]
    return np.repeat((rows[None, :] < levels[:, None])[..., None], 8, axis=2)


def test_an_outline_that_stays_does_so_in_both_halves():
    assert share_that_stays(rising(20, 20)) == 1.0
    flicker = rising(20, 20)
    flicker[::3, :, 0] = False  # a third of the frames
    assert share_that_stays(flicker) == 1.0


def test_a_vessel_that_fills_does_not_stay():
    # the halves have their level in most frames: about 15 (frames 0 to 4) and 25 (5 to 9)
    assert share_that_stays(rising(10, 30)) == pytest.approx(15 / 25, abs=0.1)
    assert share_that_stays(rising(10, 30)) < STAYS < share_that_stays(rising(30, 31))


def test_masks_are_read_from_labels_frame_by_frame():
    masks = rising(10, 30)
    labels = np.where(masks, np.uint8(Label.FLUID), np.uint8(Label.BACKGROUND))
    assert share_that_stays(FluidMasks(labels)) == share_that_stays(masks)
    assert share_that_stays(np.zeros((4, 3, 3), bool)) == 0.0


def test_a_level_that_rises_grows_and_what_sways_flickers_shrinks_or_stays_does_not():
    assert outline_grows(rising(10, 30)) and outline_grows(FluidMasks(np.where(rising(10, 30), Label.FLUID, 0)))
    assert not outline_grows(rising(30, 10)) and not outline_grows(rising(20, 20))
    assert not outline_grows(rising(30, 31)), "by less than two people differ"
    sways = np.zeros((20, 40, 40), bool)
    for t, frame in enumerate(sways):
        frame[:, 10 + t // 2 : 14 + t // 2] = True
    assert share_that_stays(sways) < 0.5 and not outline_grows(sways)
    fills = sways.copy()
    for t, frame in enumerate(fills):
        frame[38 - 2 * t // 3 :, 5:35] = True
    assert outline_grows(fills), "what a jet that sways fills"
