"""What falls gains speed on its way, what spreads loses it: motions whose law is known."""

import numpy as np
import pytest

from fluidlift.shape.spreading import FEWEST, energy_kept, spreading

H, W = 120, 160
ROW, COL = np.mgrid[:H, :W]
POOL = ((ROW - 60) / 50.0) ** 2 + ((COL - 80) / 70.0) ** 2 < 1
SOURCE = np.array([80.0, 15.0])


def flow(fluid, speed, direction=(0.0, 1.0)):
    """Mask, displacement and confidence of a fluid that moves down at a speed."""
    move = np.where(fluid, speed, 0.0)[..., None] * np.asarray(direction)
    return fluid, move, np.where(fluid, 1.0, 0.0)


def spread(power=1.0):
    """From a source at the far side of a pool, within 27 degrees of straight down, as 1 / r^power."""
    away = np.stack([COL, ROW], axis=-1) - SOURCE
    r = np.maximum(np.linalg.norm(away, axis=-1), 10.0)
    fan = POOL & (np.abs(away[..., 0]) < 0.5 * away[..., 1])
    return flow(POOL, np.where(fan, 4.0 * (10.0 / r) ** power, 0.0), away / r[..., None])


def test_energy_under_gravity_grows_along_a_line_and_falls_to_a_quarter_at_twice_the_radius():
    s = np.linspace(0.0, 1.0, 1001)
    ones = np.ones_like(s)
    low, high = np.percentile(s, [2, 98])
    assert energy_kept(s, 1.0 + 2 * 9.81 * s, ones) == pytest.approx((1 + 19.62 * high) / (1 + 19.62 * low))
    r = 1.0 + s  # of 1 / r^2 a line takes the curvature away: 0.18 to 0.25
    assert 0.15 < energy_kept(s, r**-2.0, ones) < 0.25
    assert energy_kept(s, 0.0 * s, ones) == np.inf


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_what_spreads_in_a_pool_is_told(power):
    """Of even depth, and of one that grows or a fluid that is viscous."""
    assert spreading(*spread(power)) > 0.9


def test_what_keeps_its_speed_in_a_pool_may_fall():
    assert spreading(*spread(0.0)) == 0.0


@pytest.mark.parametrize("half", [6, 45])
def test_a_jet_and_a_curtain_under_gravity_do_not_spread(half):
    fluid = (np.abs(COL - 80) < half) & (ROW > 10) & (ROW < 110)
    assert spreading(*flow(fluid, np.sqrt(0.5 + 0.1 * np.maximum(ROW - 10.0, 0.0)))) == 0.0


def test_a_fall_into_a_pool_that_is_slower_does_not_spread():
    falls = (np.abs(COL - 80) < 15) & (ROW > 5) & (ROW < 60)
    pool = (ROW >= 60) & (ROW < 110)
    speed = np.where(falls, np.sqrt(0.5 + 0.1 * np.maximum(ROW - 5.0, 0.0)), np.where(pool, 0.4, 0.0))
    assert spreading(*flow(falls | pool, speed)) == 0.0


def test_a_jet_that_only_seems_to_slow_down_has_air_on_both_sides():
    """It moves by more than its own pattern between two frames."""
    jet = (np.abs(COL - 80) < 8) & (ROW > 10) & (ROW < 100)
    assert spreading(*flow(jet, 4.0 * np.exp(-(ROW - 10.0) / 20.0))) == 0.0


def test_too_little_tells_nothing():
    few = (np.abs(COL - 80) < 3) & (ROW > 50) & (ROW < 50 + FEWEST // 10)
    assert spreading(*flow(POOL, np.where(few, 2.0, 0.0))) == 0.0
    assert spreading(*flow(np.zeros((H, W), bool), 1.0)) == 0.0
    assert spreading(*flow(POOL, 0.0)) == 0.0
