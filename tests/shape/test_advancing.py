"""A fluid that moves through the picture stands out from the still scene behind it."""

from types import SimpleNamespace

import numpy as np

from fluidlift.shape.advancing import median_over_time
from fluidlift.shape.background import colour_histogram, filled_in, quiet_fluid, smooth_ground, without_background


def test_the_median_over_time_drops_a_single_frame():
    odds = np.zeros((5, 2, 2), np.float32)
    odds[2] = 9.0
    smooth = list(median_over_time(iter(odds)))
    assert len(smooth) == 5 and not np.any(smooth)
    for frames in (1, 2):
        assert np.array_equal(list(median_over_time(iter(odds[:frames]))), odds[:frames])


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
    evidence = SimpleNamespace(
        pictures=picture[None].repeat(3, axis=0), activity=activity, level=1.5, noise=np.ones((40, 40), np.float32)
    )
    ground = smooth_ground(evidence, picture, known, lambda colours: np.zeros(colours.shape[:-1]))
    expected = np.zeros((40, 40), bool)
    expected[30:, 15:25] = True
    assert np.array_equal(ground, expected)
    activity[10:, 15:25] = 3.0  # as lively as the fluid: nothing is taken away
    assert not smooth_ground(evidence, picture, known, lambda colours: np.zeros(colours.shape[:-1])).any()
