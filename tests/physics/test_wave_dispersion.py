"""Frequency and wavenumber of waves belong together as theory says."""

import numpy as np
import pytest

from fluidlift.physics.wave_dispersion import WaveMedium

WATER = WaveMedium()


def test_long_waves_on_deep_water_are_gravitys():
    k = np.array([0.1, 1.0, 5.0])
    assert WATER.frequency(k) == pytest.approx(np.sqrt(9.81 * k), rel=1e-3)
    assert WATER.group_speed(k) == pytest.approx(0.5 * np.sqrt(9.81 / k), rel=1e-3)


def test_long_waves_on_shallow_water_are_as_fast_as_its_depth_says():
    shallow = WaveMedium(depth=0.05)
    assert shallow.frequency(0.5) / 0.5 == pytest.approx(np.sqrt(9.81 * 0.05), rel=1e-3)


def test_the_slowest_wave_on_water_is_17_mm_long_and_runs_at_23_cm_a_second():
    k = np.geomspace(10, 3000, 5000)
    speed = WATER.frequency(k) / k
    assert speed.min() == pytest.approx(0.231, abs=0.002)
    assert 2 * np.pi / k[speed.argmin()] == pytest.approx(0.0171, abs=0.0005)


@pytest.mark.parametrize("speed", [0.3, 1.0, 3.0])
def test_a_wave_stands_against_a_current_as_fast_as_it_is(speed):
    k = WATER.standing(speed)
    assert k is not None
    assert WATER.frequency(k) == pytest.approx(k * speed, rel=1e-6)
    if speed >= 1.0:
        assert k == pytest.approx(9.81 / speed**2, rel=0.01)


def test_none_stands_where_all_are_faster_or_slower_than_the_current():
    assert WATER.standing(0.1) is None
    assert WATER.standing(0.0) is None
    assert WaveMedium(depth=0.05).standing(1.0) is None


def test_a_depth_of_nothing_is_refused():
    with pytest.raises(ValueError, match="depth 0"):
        WaveMedium(depth=0.0)
