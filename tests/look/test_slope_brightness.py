"""How much brighter water gets as it slopes."""

import numpy as np
import pytest

from fluidlift.look.slope_brightness import BODY, brightness_of_slope, gain_and_range, level_brightness, mirrored_share


def test_water_seen_from_above_says_nothing_of_its_slope():
    assert brightness_of_slope(0.0, BODY[1]) < 0.02
    assert brightness_of_slope(1.2, BODY[1]) > 2.0


@pytest.mark.parametrize("incidence", [0.8, 1.1, 1.3])
def test_it_is_the_derivative_of_level_waters_brightness(incidence):
    step = 1e-3
    beside = np.log(level_brightness(np.array([incidence - step, incidence + step])))
    assert brightness_of_slope(incidence, BODY[1]) == pytest.approx((beside[1] - beside[0]) / (2 * step), rel=0.01)


def test_muddy_water_and_a_dark_horizon_take_from_it():
    clear, usual, muddy = (brightness_of_slope(1.2, body) for body in BODY)
    assert clear > usual > muddy
    assert brightness_of_slope(1.2, BODY[1], horizon=0.6) < usual


def test_a_slope_comes_with_a_range_around_one_and_a_mirrored_shore_raises_the_gain():
    gain, (low, high) = gain_and_range(1.2)
    assert low < 1.0 < high
    shore, (_, far) = gain_and_range(1.2, 20.0)
    assert shore == pytest.approx(np.hypot(gain, 20.0))
    assert far > high


def test_more_is_mirrored_at_a_flatter_angle():
    shares = [mirrored_share(a) for a in (0.2, 0.9, 1.3, 1.5)]
    assert shares == sorted(shares)
    assert 0 < shares[0] < 0.5 < shares[-1] < 1
