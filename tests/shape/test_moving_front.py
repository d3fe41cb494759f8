"""A fluid that moves through the picture stands out from the still scene behind it."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from fluidlift.shape.background import (
    _told_apart,
    colour_histogram,
    filled_in,
    fluid_colour,
    own_tint,
    quiet_fluid,
    smooth_ground,
    steady_fluid,
    without_background,
)
from fluidlift.shape.moving_front import median_of_three, without_strays
from fluidlift.shape.segment import segment
from fluidlift.types.clip import Label, VideoClip


def test_the_median_over_time_drops_a_single_frame():
    odds = np.zeros((5, 2, 2), np.float32)
    odds[2] = 9.0
    smooth = list(median_of_three(iter(odds)))
    assert len(smooth) == 5 and not np.any(smooth)
    for frames in (1, 2):
        assert np.array_equal(list(median_of_three(iter(odds[:frames]))), odds[:frames])


def test_background_that_shows_between_the_fluid_is_taken_out_of_its_colours():
    around = np.zeros((4, 4, 4), np.float32)
    around[0, 0, 0] = 1000.0
    mixed = np.zeros_like(around)
    mixed[0, 0, 0], mixed[3, 3, 3] = 200.0, 50.0
    own = without_background(mixed, around)
    assert own[0, 0, 0] == 0.0 and own[3, 3, 3] == 50.0


def test_what_is_known_is_kept_and_the_rest_lies_between_its_neighbours():
    rng = np.random.default_rng(0)
    picture = rng.uniform(20.0, 60.0, (37, 50, 3)).astype(np.float32)
    known = rng.random((37, 50)) < 0.7
    known[5:30, 10:35] = False
    full = filled_in(np.where(known[..., None], picture, 1e4), known)
    assert np.array_equal(full[known], picture[known])
    # means of the known: nothing of what stood in the hole comes through
    assert picture[known].min() - 1e-3 <= full.min() and full.max() <= picture[known].max() + 1e-3


def test_a_hole_in_a_slope_is_filled_along_the_slope():
    slope = np.repeat(np.linspace(0.0, 63.0, 64, dtype=np.float32)[None, :, None], 64, axis=0).repeat(3, axis=2)
    known = np.ones((64, 64), bool)
    known[20:44, 24:40] = False
    # no slope is kept inside the hole, 16 px wide: at its rim the guess is off by half its width at most
    assert np.abs(filled_in(slope, known) - slope).max() < 8.0
    assert not filled_in(slope, np.zeros_like(known)).any()


def test_a_calm_part_of_the_plume_joins_by_its_colour_only_where_it_stirs_or_nothing_else_has_that_colour():
    picture = np.full((30, 40, 3), 20.0, np.float32)
    picture[5:25, 10:30, 0] = 200.0
    domain = np.zeros((30, 40), bool)
    domain[5:15, 10:30] = True
    moving = colour_histogram(picture[domain])
    around = colour_histogram(picture[~domain])  # a sixth of it is the calm part itself
    stirred = np.zeros((30, 40), bool)
    assert not quiet_fluid(picture, domain, moving, around, stirred).any()
    stirred[:, :25] = True
    found = quiet_fluid(picture, domain, moving, around, stirred)
    assert found[15:25, 10:25].all() and not found[:, 25:][~domain[:, 25:]].any()
    assert not found[:, :10].any()


def test_ground_that_flickers_in_the_light_of_a_plume_is_no_plume_and_its_quiet_column_is():
    picture = np.full((40, 40, 3), 150.0, np.float32)
    picture[:30, 15:25, 0] = 200.0  # the column: its outline is an edge, the flickering ground below has none
    known = np.ones((40, 40), bool)
    known[:40, 15:25] = False
    activity = np.full((40, 40), 0.5, np.float32)
    activity[:, 15:25] = 1.6  # doubtful, by a third of the spread of still things
    activity[:10, 15:25] = 3.0
    evidence = SimpleNamespace(typical=picture, activity=activity, level=1.5, noise=np.ones((40, 40), np.float32))
    ground = smooth_ground(evidence, picture, known, lambda colours: np.zeros(colours.shape[:-1]))
    expected = np.zeros((40, 40), bool)
    expected[30:, 15:25] = True
    assert np.array_equal(ground, expected)
    activity[10:, 15:25] = 3.0  # as lively as the fluid: nothing is taken away
    assert not smooth_ground(evidence, picture, known, lambda colours: np.zeros(colours.shape[:-1])).any()


SKY, FLOOR = np.float32([170, -14, 0]), np.float32([180, 7, 0])
SMOKE = np.float32([137, -6, 0])
"""opponent colours: grey smoke is less blue than the sky and bluer than the floor"""


def test_the_colour_of_smoke_is_that_of_its_thickest_part():
    ground = np.broadcast_to(SKY, (20, 40, 3))
    thick = np.tile(np.linspace(0.2, 1.0, 40, dtype=np.float32)[:, None], (20, 1, 1))
    picture = ground + thick * (SMOKE - SKY)
    found = fluid_colour(picture[None], np.ones((1, 20, 40), bool), ground)
    assert np.abs(found - SMOKE).max() < 4.0  # 0.9 of the way of 33; the median of all is 13 short
    assert not fluid_colour(picture[None], np.zeros((1, 20, 40), bool), ground).any()


def test_the_tint_of_smoke_is_told_before_the_floor_but_says_nothing_before_a_sky_of_nearly_its_shade():
    ground = np.zeros((60, 40, 3), np.float32)
    ground[:30], ground[30:] = SKY, FLOOR
    smoke, shade = own_tint(np.broadcast_to(SMOKE, ground.shape), ground, SMOKE), own_tint(0.6 * ground, ground, SMOKE)
    assert np.allclose(smoke, 1.0, atol=1e-3)
    assert np.allclose(shade[36:], 0.0, atol=1e-3) and np.allclose(shade[:24], 1.0, atol=1e-3)
    half = own_tint(0.5 * (ground + SMOKE), ground, SMOKE)[36:]
    assert 0.4 < half.min() and half.max() < 0.6


@pytest.mark.parametrize(
    ("ground", "fluid", "shadow"), [(FLOOR, SMOKE, 0.72), (np.float32([90, 5, 0]), np.float32([160, 2, 0]), 0.6)]
)
def test_a_column_that_stands_still_is_fluid_and_its_shadow_is_not(ground, fluid, shadow):
    picture = np.tile(ground, (60, 80, 1))
    picture[:45, 40:50] = fluid
    picture[38:45, 5:40] *= shadow  # as rare a colour, and it touches the column
    domain, rare = np.zeros((60, 80), bool), np.zeros((60, 80), bool)
    domain[:10, 40:50] = rare[:45, 40:50] = rare[38:45, 5:40] = True
    found = steady_fluid(picture, rare, domain, ground=np.tile(ground, (60, 80, 1)), fluid=fluid)
    assert found[:45, 39:51].all() and not found[:, :35].any()  # with its thin rim
    assert not steady_fluid(picture, rare, np.zeros_like(domain), ground=picture, fluid=fluid).any()


def mushroom(rng: np.random.Generator, *, frames: int = 30) -> tuple[VideoClip, np.ndarray]:
    """Smoke as grey as the sky is blue, before it and a mottled floor: a cap that rises and rolls on a stem that was
    there from the start and stands still, with a shadow that lies on the floor; the clip and true masks."""
    height, width = 160, 120
    sky, floor, smoke = np.float32([157, 171, 186]), np.float32([190, 182, 176]), np.float32([132, 138, 144])
    grain = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), 2.0)
    grain /= grain.std()
    scene = np.tile(sky, (height, width, 1))
    scene[115:] = floor + 12.0 * grain[115:, :, None]
    scene[134:142, 5:52] *= 0.6
    rows, columns = np.mgrid[:height, :width]
    pictures, masks = [], []
    for t in range(frames):
        middle = 72.0 - 1.6 * t
        cap = ((rows - middle) / 18.0) ** 2 + ((columns - 60) / 20.0) ** 2 < 1.0
        mask = cap | ((np.abs(columns - 60) < 9) & (rows > middle) & (rows < 142))
        thick = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.5)[..., None]
        rolling = 9.0 * np.roll(grain, -3 * t, axis=0)[..., None] * cap[..., None]
        picture = (1.0 - thick) * scene + thick * (smoke + rolling)
        pictures.append(picture + rng.normal(size=picture.shape))
        masks.append(mask)
    clip = VideoClip(np.clip(np.stack(pictures), 0, 255).round().astype(np.uint8), np.arange(frames) / 25.0)
    return clip, np.stack(masks)


def test_the_steady_stem_of_a_plume_is_fluid_and_its_shadow_on_a_mottled_floor_is_not():
    clip, truth = mushroom(np.random.default_rng(5))
    still = np.zeros((*clip.frames.shape[1:3], 2), np.float32), np.ones(clip.frames.shape[1:3], np.float32)
    fluid = segment(clip, lambda t: still).fluid
    for t in (2, 12, 20, 28):  # 0.27 to 0.40 without the stem; an outline of 250 px known to 1 px is 0.88
        assert (fluid[t] & truth[t]).sum() / (fluid[t] | truth[t]).sum() > 0.85, t
    assert fluid[:, 134:142, 5:45].mean() < 0.02


def test_what_came_over_a_place_and_lies_still_is_no_background_of_it_and_shade_that_came_is():
    ground, dark, shade = (np.float32(colour) for colour in ((150.0, 10.0, 0.0), (40.0, 12.0, 4.0), (120.0, 8.0, 0.0)))
    before = np.broadcast_to(ground, (4, 6, 3)).copy()
    after = before.copy()
    after[:, :2], after[:, 2:4] = dark, shade  # a heap of chocolate; its shadow; nothing
    before[3], after[3] = dark, ground  # a row that it has left

    def like_fluid(colours: np.ndarray) -> np.ndarray:
        return np.where(colours[..., 0] < 60.0, 3.0, -3.0)

    often = np.full((4, 6), 10.0, np.float32)
    found, count = _told_apart([(before, often), (after, often)], np.full((4, 6), 5.0, np.float32), like_fluid)
    assert np.allclose(found[:3, :2], ground) and np.allclose(found[3], ground)
    assert np.allclose(found[:3, 2:4], 0.5 * (ground + shade)) and np.allclose(found[:3, 4:], ground)
    assert (count[:, :2] == 10.0).all() and (count[:3, 2:] == 20.0).all()


def moving_discs(*ways, frames=20, size=(60, 80)):
    """u8 [T,H,W]: discs of 1, each a radius and its place (u, v) per frame, None where it is not there."""
    v, u = np.mgrid[: size[0], : size[1]]
    labels = np.zeros((frames, *size), np.uint8)
    for radius, place in ways:
        for t in range(frames):
            if (at := place(t)) is not None:
                labels[t][np.hypot(u - at[0], v - at[1]) < radius] = Label.FLUID
    return labels


@pytest.mark.parametrize(
    ("place", "stays"),
    [
        (lambda t: (65, 15) if t < 6 else None, False),  # a light on the rim of a jug
        (lambda t: (30 + 2 * t, 40) if t < 9 else None, True),  # a drop that has come off it
        (lambda t: (65 - 2 * (t - 8), 40) if 8 <= t < 18 else None, True),  # one that comes to it
        (lambda t: (65, 15), True),  # a second jet, from first to last
    ],
)
def test_what_hangs_together_with_nothing_and_does_not_last_is_no_part_of_one_fluid(place, stays):
    main = (14.0, lambda t: (22, 40))
    labels, alone = moving_discs(main, (4.0, place)), moving_discs(main)
    before = labels.copy()
    cleared = without_strays(labels)
    assert np.array_equal(labels, before if stays else alone)
    assert cleared == (before != labels).sum() and (cleared > 0) != stays


def test_of_two_that_are_alike_neither_is_a_stray_and_nothing_has_none():
    labels = moving_discs((10.0, lambda t: (15, 15) if t < 8 else None), (10.0, lambda t: (60, 40) if t > 12 else None))
    assert without_strays(labels) == 0 and without_strays(np.zeros((3, 8, 8), np.uint8)) == 0
