"""Grain of path-traced pictures, and liquids that rest on the ground; no Mitsuba needed."""

import numpy as np

from fluidlift.backends.mitsuba_denoise import denoised, without_sparks
from fluidlift.backends.mitsuba_renderer import PARTS, _parts, _together

RNG = np.random.default_rng(0)


def test_where_all_parts_agree_nothing_changes():
    picture = RNG.uniform(size=(24, 32, 3))
    same = np.repeat(picture[None], 8, axis=0)
    assert np.abs(denoised(same) - picture).max() < 1e-5  # float32


def test_grain_falls_to_a_third_and_an_edge_stays():
    truth = np.where(np.arange(32)[None, :, None] < 16, 0.2, 0.8) * np.ones((24, 32, 3))
    parts = truth + RNG.normal(0, 0.2, (8, 24, 32, 3))
    before = np.sqrt(((parts.mean(axis=0) - truth) ** 2).mean())
    after = np.sqrt(((denoised(parts) - truth) ** 2).mean())
    # 121 pixels at most to average over, half of them beyond the edge: a third leaves room
    assert after < before / 3


def test_a_spark_in_one_part_goes_and_a_highlight_in_all_stays():
    parts = np.full((8, 16, 16, 3), 0.1)
    parts[3, 8, 8] = 50.0
    parts[:, 2:6, 2:6] = 3.0
    kept = without_sparks(parts)
    assert kept[3, 8, 8].max() < 0.5  # four times what is usual there
    assert np.array_equal(kept[:, 3:5, 3:5], parts[:, 3:5, 3:5])


def test_all_samples_are_drawn_and_weigh_the_same_in_the_plain_mean():
    for samples, most in ((1, 9), (7, 2), (64, 1000), (67, 1000), (67, 3)):
        counts = _parts(samples, most)
        assert sum(counts) == samples and min(counts) > 0 and max(counts) <= most
    counts = [3] * 4 + [2] * 4
    parts = RNG.uniform(size=(PARTS, 4, 5, 4))
    weighed = np.average(parts, axis=0, weights=counts)
    assert np.allclose(_together(parts, counts, denoise=False), weighed)
