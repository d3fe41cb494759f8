"""What enters looks like the body downstream, mirrored: no seam, no single colour for long, as fine as the body."""

import numpy as np
import pytest

from fluidlift.look.inflow import ENDS, InflowLook, columns_of, surface_level
from fluidlift.types import Gaussians

ALONG = np.array([1.0, 0.0, 0.0])


def line():
    x = np.linspace(0.0, 1.0, 101)
    return Gaussians.isotropic(np.stack([x, 0 * x, 0 * x], axis=1), 0.01, np.full((101, 3), 0.5))


def looked_up(speed, times):
    """Where the look of what enters at the first place that is mirrored comes from."""
    look = InflowLook(line(), ALONG, speed, 0.005)
    return np.array([0.01 * look(ENDS[0] * ALONG[None], t).source[0] for t in times])


def pond():
    """Fine splats on a surface that falls by 0.1 per metre, coarse ones below it."""
    fine = np.stack(np.meshgrid(np.arange(0.0, 2.0, 0.02), np.arange(0.0, 1.0, 0.02), [0.0], indexing="ij"), -1)
    coarse = np.stack(
        np.meshgrid(np.arange(0.05, 2.0, 0.1), np.arange(0.05, 1.0, 0.1), [-0.1, -0.2], indexing="ij"), -1
    )
    means = np.concatenate([fine.reshape(-1, 3), coarse.reshape(-1, 3)])
    means[:, 2] -= 0.1 * means[:, 0]
    return Gaussians.isotropic(means, 0.02, np.full((len(means), 3), 0.5))


def test_the_pattern_moves_upstream_at_the_speed_of_the_inflow():
    np.testing.assert_allclose(
        looked_up(0.5, [0.4, 0.8, 1.2]), np.array([0.2, 0.4, 0.6]) + ENDS[0], atol=0.0051
    )  # of 0.01 apart


def test_at_the_end_it_turns_back_without_a_jump():
    times = np.arange(0.0, 8.0, 0.05)
    steps = np.abs(np.diff(looked_up(0.5, times)))
    # 0.5 * 0.05 per step, rounded to Gaussians 0.01 apart
    assert steps.max() <= 0.036
    # all that lies between the ends, and nothing beyond them; to half a Gaussian
    assert looked_up(0.5, times).min() == pytest.approx(ENDS[0], abs=0.0051)
    assert looked_up(0.5, times).max() == pytest.approx(ENDS[1], abs=0.0051)


def test_still_water_keeps_one_look():
    assert np.ptp(looked_up(0.0, [0.0, 1.0, 5.0])) == 0.0


def test_a_place_at_the_surface_takes_all_splats_of_its_box():
    body = pond()
    look = InflowLook(body, ALONG, 1.0, 0.1, lying=True)
    places = np.stack([np.full(8, 0.05), np.arange(0.15, 0.9, 0.1), np.full(8, -0.005)], axis=1)
    for time in (0.0, 0.73):
        new = look(places, time)
        # 25 fine ones lie in a box of 0.1 where they stand 0.02 apart; borders count with either neighbour
        assert np.bincount(new.place).min() >= 16
        at = places[new.place] + new.offset
        # on the surface, whose slope is turned within a box, and whose level is that of the highest point of a column:
        # each is off by the slope over the length of a box at most
        np.testing.assert_allclose(at[:, 2], -0.1 * at[:, 0], atol=0.02)
        assert np.abs(new.offset[:, :2]).max() <= 0.05 + 1e-6
        assert (new.source < 100 * 50).all()  # the fine ones


def test_deep_places_take_one_and_places_above_the_surface_none():
    look = InflowLook(pond(), ALONG, 1.0, 0.1, lying=True)
    new = look(np.array([[0.05, 0.5, 0.2], [0.05, 0.5, -0.2], [0.05, 0.5, -0.3]]), 0.3)
    assert new.place.tolist() == [1, 2]
    assert not new.offset.any()


def test_what_may_not_lend_its_look_does_not():
    body = pond()
    usable = body.means[:, 1] > 0.5
    look = InflowLook(body, ALONG, 1.0, 0.1, usable=usable, lying=True)
    places = np.stack([np.full(9, 0.05), np.arange(0.05, 0.9, 0.1), np.full(9, -0.005)], axis=1)
    assert usable[look(places, 0.4).source].all()


def test_the_level_is_the_highest_point_of_a_column_and_the_nearest_one_beside():
    level = surface_level(np.array([[0.1, 0.1, 1.0], [0.15, 0.1, 2.0], [5.0, 0.1, 3.0]]), 0.5)
    np.testing.assert_array_equal(level(np.array([[0.2, 0.2], [4.0, 0.0], [-3.0, 0.0]])), [2.0, 3.0, 2.0])


def test_a_body_without_splats_is_refused():
    with pytest.raises(ValueError, match="without Gaussians"):
        InflowLook(Gaussians.empty(), ALONG, 1.0, 0.1)


def test_columns_are_those_that_rows_sorted_one_by_one_give():
    rng = np.random.default_rng(3)
    for points in (rng.normal(0, 4, (3000, 3)), np.array([[0.0, 0, 0], [1e17, -1e17, 0], [0.05, 0.01, 2]])):
        cell, of = columns_of(points, 0.3)
        expected, which = np.unique(np.floor(points[:, :2] / 0.3), axis=0, return_inverse=True)
        np.testing.assert_array_equal(cell, expected)
        np.testing.assert_array_equal(of, which.reshape(-1))
    assert columns_of(np.zeros((0, 3)), 0.3)[0].shape == (0, 2)
