"""Depth of water of which only the surface is seen: discharge, banks, rocks."""

import numpy as np
import pytest

from fluidlift.shape.cross_section import (
    CONTINUITY,
    REPOSE,
    ROCK_FLANK,
    STEEPEST,
    STRAIGHT,
    Reach,
    depth_along,
    rock_height,
    swiftness,
    thickness,
    usual_depth,
)

H, WIDTH = 0.05, 1.0


def reach(*, speed=None, fall=0.0, rock=None):
    """4 m of straight channel, 1 m wide in a map 2 m wide."""
    x, y = np.meshgrid((np.arange(80) + 0.5) * H, (np.arange(40) + 0.5) * H - 1.0, indexing="ij")
    wet = np.abs(y) < WIDTH / 2
    stone = np.zeros(wet.shape, bool) if rock is None else np.hypot(x - rock[0], y - rock[1]) < rock[2]
    pace = np.full(wet.shape, np.nan) if speed is None else np.where(wet, speed(x), np.nan)
    return Reach(wet, stone & wet, -fall * x, x, pace, H), x, y


def test_a_stream_of_one_speed_is_as_deep_everywhere():
    water, _, _ = reach(speed=lambda x: 0 * x + 0.7)
    np.testing.assert_allclose(depth_along(water, 0.2, WIDTH, "stream"), 0.2, rtol=1e-6)


def parker(discharge: float, gravel: float) -> tuple[float, float]:
    """Width and mean depth (m) of a river full to its banks, m3/s and m (Parker and others 2007)."""
    q = (discharge**2 / 9.81) ** 0.2
    return 4.63 * q * (discharge / (np.sqrt(9.81 * gravel) * gravel**2)) ** 0.0667, 0.382 * q


@pytest.mark.parametrize("discharge", [5.0, 50.0, 500.0, 5000.0])
def test_a_river_in_metres_is_as_deep_as_gravel_rivers_of_its_width(discharge: float) -> None:
    width, depth = parker(discharge, 0.05)
    assert usual_depth(width, 0.2) == pytest.approx(depth, rel=0.02)
    # sand-like and boulder-like gravel differ by less than what a fifth of the width is off
    for gravel in (0.0125, 0.2):
        width, depth = parker(discharge, gravel)
        assert usual_depth(width, 0.2) == pytest.approx(depth, rel=0.25)
        assert 0.2 * width > 3.0 * depth


def test_small_channels_keep_their_share_and_depth_grows_with_width_without_a_jump() -> None:
    assert usual_depth(0.5, 0.2) == pytest.approx(0.1) and usual_depth(1.0, 0.2) == pytest.approx(0.2)
    widths = np.geomspace(0.2, 300.0, 400)
    depths = np.array([usual_depth(w, 0.2) for w in widths])
    steps = np.diff(np.log(depths)) / np.diff(np.log(widths))
    assert (steps > 0).all() and (steps < 1.0 + 1e-9).all()  # never deeper for its width than a narrower one
    assert usual_depth(20.0, 0.01) == pytest.approx(0.2)  # what is said to be shallow is not made deeper


def test_without_speeds_the_width_alone_decides():
    water, _, _ = reach()
    np.testing.assert_allclose(depth_along(water, 0.2, WIDTH, "stream"), 0.2, rtol=1e-6)


@pytest.mark.parametrize("kind", ["stream", "fall"])
def test_water_is_shallower_where_it_runs_faster(kind):
    water, x, _ = reach(speed=lambda x: np.where(x < 2.0, 0.5, 1.0))
    section = depth_along(water, 0.2, WIDTH, kind)
    slow, fast = section[(x < 0.5) & water.wet].mean(), section[(x > 3.5) & water.wet].mean()
    # half a metre of smoothing is over at the ends; the bed's line takes out a part of a stream's difference
    full = 2.0**CONTINUITY
    if kind == "fall":
        assert slow / fast == pytest.approx(full, rel=0.02)
    else:
        assert 1.0 + (1 - STRAIGHT) * (full - 1.0) * 0.8 < slow / fast < full * 1.3


def test_a_surface_that_falls_over_a_straight_bed_says_where_it_is_shallow():
    # 0.2 m deep at the head and 0.1 m at the foot of a level bed
    water, x, _ = reach(speed=lambda x: 0.2 / (0.2 - 0.025 * x), fall=0.025)
    section = depth_along(water, 0.15, WIDTH, "stream")[:, 20]
    truth = 0.2 - 0.025 * x[:, 0]
    assert np.abs(section - truth).mean() < 0.5 * np.abs(0.15 - truth).mean()


def test_banks_fall_at_their_slope_to_a_flat_bed():
    water, _, y = reach()
    below = thickness(water, np.full(water.wet.shape, 0.2), WIDTH)
    bank = WIDTH / 2 - np.abs(y)
    near = (bank > 0) & (bank < 0.1)
    # distances are to the middle of the first dry column, half a column further than the bank
    assert np.abs(below[near] - REPOSE * (bank[near] + H / 2)).max() < 0.01
    assert below[np.abs(y) < 0.1] == pytest.approx(0.2, rel=0.03)
    assert (below[~water.wet] == 0).all()


def test_beside_water_that_keeps_its_speed_the_bank_is_steep():
    water, _, y = reach(speed=lambda x: 0 * x + 0.7)
    below = thickness(water, np.full(water.wet.shape, 0.2), WIDTH)
    bank = WIDTH / 2 - np.abs(y)
    first = (bank > 0) & (bank < H)
    assert below[first] == pytest.approx(STEEPEST * H / 2, rel=0.05)  # half a column from the bank
    assert below[bank > 3 * H].min() > 0.88 * 0.2  # its foot is rounded: 2^(-1/6) of the depth at the corner


def test_water_that_slackens_to_the_bank_leaves_it_at_its_slope():
    water, _, y = reach(speed=lambda x: 0 * x + 0.7)
    slack = Reach(water.wet, water.rock, water.level, water.along, water.speed * (1.0 - (2 * y / WIDTH) ** 2), H)
    section = np.full(water.wet.shape, 0.2)
    plain = Reach(water.wet, water.rock, water.level, water.along, np.full(water.wet.shape, np.nan), H)
    near = (WIDTH / 2 - np.abs(y) < 2 * H) & water.wet
    here, usual = (thickness(w, section, WIDTH)[near] for w in (slack, plain))
    assert here.max() < 1.3 * usual.max()
    assert (here >= usual - 1e-9).all()


def test_speed_says_nothing_where_it_is_not_known_and_no_scale_counts():
    water, x, _ = reach(speed=lambda x: np.where(x < 2.0, np.nan, 0.3))
    share = swiftness(water, WIDTH)
    assert (share[x < 2.0] == 0).all()
    assert share[(x > 2.0) & water.wet] == pytest.approx(1.0, abs=1e-6)
    faster = Reach(water.wet, water.rock, water.level, water.along, 100 * water.speed, H)
    np.testing.assert_allclose(swiftness(faster, WIDTH), share, atol=1e-9)


def test_a_deep_narrow_section_has_steeper_banks():
    water, _, y = reach()
    below = thickness(water, np.full(water.wet.shape, 0.5), WIDTH)
    assert below[np.abs(y) < H].mean() > 0.9 * 0.5


def test_rocks_have_flanks_under_water_and_stand_out_of_it():
    water, x, y = reach(rock=(2.0, 0.0, 0.2))
    below = thickness(water, np.full(water.wet.shape, 0.2), WIDTH)
    beside = np.hypot(x - 2.0, y) - 0.2
    near = (beside > 0) & (beside < 0.07)
    assert (below[near] <= ROCK_FLANK * (beside[near] + 1.5 * H)).all() and below[near].max() < 0.2
    top = rock_height(water)
    assert (top[water.rock] >= H).all() and (top[~water.rock] == 0).all()
    assert top.max() == pytest.approx(H + 0.7 * 0.2, abs=0.7 * H)  # a radius known to a column


def test_a_rock_stands_higher_in_fast_water():
    slow, _, _ = reach(speed=lambda x: 0 * x, rock=(2.0, 0.0, 0.2))
    fast, _, _ = reach(speed=lambda x: 0 * x + 1.0, rock=(2.0, 0.0, 0.2))
    climb = (rock_height(fast) - rock_height(slow))[fast.rock]
    np.testing.assert_allclose(climb, 1.0 / (2 * 9.81), rtol=1e-9)  # Bernoulli: v^2 / 2g
