"""Fields, curves and captions as pictures."""

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.look.pictures import caption, colour_map, curve, velocity_slices

EMPTY = (40, 40, 40)


def test_what_is_masked_or_not_finite_is_dark_grey():
    values = np.linspace(0, 1, 12).reshape(3, 4)
    values[0, 0] = np.nan
    mask = np.ones((3, 4), bool)
    mask[2, 3] = False
    picture = colour_map(values, mask)
    assert tuple(picture[0, 0]) == EMPTY and tuple(picture[2, 3]) == EMPTY
    assert picture.dtype == np.uint8 and picture.shape == (3, 4, 3)


@pytest.mark.parametrize("values", [np.full((3, 4), np.nan), np.full((3, 4), np.inf)])
def test_a_field_of_nothing_is_dark_grey(values):
    assert (colour_map(values) == 40).all()


def test_larger_values_are_brighter():
    brightness = colour_map(np.linspace(0, 1, 9)[None]).astype(int).sum(-1)[0]
    assert (np.diff(brightness) >= 0).all() and brightness[-1] > brightness[0]


def test_a_constant_field_has_one_colour():
    assert len(np.unique(colour_map(np.full((4, 4), 3.0)).reshape(-1, 3), axis=0)) == 1


def test_given_limits_hold():
    wide, narrow = (colour_map(np.array([[0.5]]), low=0.0, high=h) for h in (10.0, 0.5))
    np.testing.assert_array_equal(narrow, colour_map(np.array([[7.0]]), low=0.0, high=0.5))  # clipped
    assert not np.array_equal(wide, narrow)


def test_slices_show_speed_from_above_along_and_across():
    velocity = np.zeros((6, 5, 4, 3))
    velocity[3:, ..., 0] = 2.0
    wet = np.zeros((6, 5, 4), bool)
    wet[:, 1:4, :3] = True
    picture = velocity_slices(velocity, wet, scale=2)
    # three panels of 6, 6 and 5 cells, two pixels per cell, 8 px apart; as high as the highest (5 cells)
    assert picture.shape == (10, 2 * (6 + 6 + 5) + 24, 3)
    above = picture[:10, :12]
    assert tuple(above[0, 0]) == EMPTY  # dry
    slow, fast = above[5, 1], above[5, 10]
    assert not np.array_equal(slow, fast)


def test_a_dry_grid_makes_a_picture_too():
    assert velocity_slices(np.zeros((3, 3, 3, 3)), np.zeros((3, 3, 3), bool)).shape[2] == 3


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize(
    "values",
    [[3.0, 2.0, 1.0], [np.nan, 1.0], [0.0, -1.0], np.geomspace(1, 1e-6, 50)],
    ids=["few", "nan", "negative", "many"],
)
def test_curves_of_any_values_can_be_drawn(values, log):
    picture = curve(values, title="loss", x="iteration", y="loss", log=log)
    assert picture.dtype == np.uint8 and picture.ndim == 3
    assert (picture < 128).any()  # at least its frame is drawn


def test_a_curve_without_values_is_an_empty_frame():
    assert (curve([], title="", x="", y="") < 255).any()


def test_a_curve_that_falls_is_drawn_falling():
    picture = curve(np.linspace(1, 0, 50), title="", x="", y="").astype(int)
    line = np.abs(picture - [0x1F, 0x6F, 0x8B]).sum(-1) < 30
    rows, cols = np.where(line)
    assert np.corrcoef(rows, cols)[0, 1] > 0.9  # downwards to the right


def test_a_caption_leaves_the_frame_itself_alone():
    frame = np.full((60, 120, 3), 128, np.uint8)
    labelled = caption(frame, "input")
    assert (frame == 128).all()
    assert not np.array_equal(labelled, frame)
    assert (labelled[40:] == 128).all()  # a small label in the upper part


@pytest.mark.parametrize("width", [96, 300, 512, 1200])
def test_a_caption_is_white_with_a_dark_edge_around_each_letter(width):
    labelled = caption(np.full((80, width, 3), 128, np.uint8), "re-simulation").astype(int)
    white, black = (labelled > 200).all(-1), (labelled < 60).all(-1)
    assert white.any() and black.any()
    # the edge is a pixel wide; strokes that are smoothed below white leave it up to two more away
    assert ndimage.distance_transform_edt(~white)[black].max() <= 3.5


def test_a_caption_is_cut_where_the_frame_ends():
    assert caption(np.zeros((10, 12, 3), np.uint8), "a long caption").shape == (10, 12, 3)
