"""Waves that are played have the film's slope and length, the dispersion of water, and its current under them."""

from dataclasses import replace

import numpy as np
import pytest
from made_waves import DEEP

from fluidlift.look.wave_relief import LIVES, MOST_GROWN, WaveRelief, grown_with
from fluidlift.look.wave_spectrum import FilmedWaves
from fluidlift.physics.wave_dispersion import STEEPEST, WaveMedium

SHAPE, PITCH = (24, 24), 0.25


def filmed(k=12.0, way=0.0, slope=0.05, *, standing=False, bins=0.0):
    vector = k * np.array([[np.cos(way), np.sin(way)]])
    return FilmedWaves(vector, np.array([slope**2]), np.array([standing]), bins, (1.0, 1.0))


def relief(waves, current=(0.0, 0.0), *, growth=None, medium=DEEP, **more):
    flow = np.broadcast_to(current, (*SHAPE, 2)).astype(float)
    return WaveRelief.of(
        waves, medium, (np.zeros(2), PITCH), flow, np.ones(SHAPE) if growth is None else growth, **more
    )


def lattice(count=48, step=0.06):
    return np.stack(np.meshgrid(*[np.arange(count) * step + 1.0] * 2, indexing="ij"), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("k", [3.0, 12.0, 60.0, 400.0])
@pytest.mark.parametrize("current", [(0.0, 0.0), (0.7, 0.2), (-0.4, 0.0)], ids=str)
@pytest.mark.parametrize("medium", [DEEP, WaveMedium(depth=0.05)], ids=["deep", "shallow"])
def test_what_is_played_has_waters_dispersion_within_a_twentieth(k, current, medium):
    played = relief(filmed(k, 0.4), current, medium=medium)
    expected = abs(float(medium.frequency(k)) + k * (current[0] * np.cos(0.4) + current[1] * np.sin(0.4)))
    lasting = replace(played, life=1e5)  # one layer alone
    # the phase is that of the heights at two places a quarter of a wave apart
    ahead = 0.5 * np.pi / k * np.array([np.cos(0.4), np.sin(0.4)])
    places = np.array([[2.0, 3.0], [2.0, 3.0] + ahead])
    times = 0.5 * lasting.life + np.linspace(0.0, 4 * np.pi / expected, 65)
    here, there = np.array([lasting.at(places, t).height for t in times]).T
    turned = np.abs(np.diff(np.unwrap(np.arctan2(there, here)))).sum()
    assert turned / (times[-1] - times[0]) == pytest.approx(expected, rel=0.05)


def test_layers_that_come_and_go_leave_the_frequency_within_a_twentieth():
    played = relief(filmed(12.0), (0.6, 0.0))
    expected = float(DEEP.frequency(12.0)) + 12.0 * 0.6
    step, count = 0.03, 2048  # ten lives
    heights = np.array([played.at(np.array([[2.0, 3.0]]), t * step).height[0] for t in range(count)])
    power = np.abs(np.fft.rfft(heights * np.hanning(count))) ** 2
    omega = 2 * np.pi * np.fft.rfftfreq(count, step)
    middle = float((omega * power).sum() / power.sum())
    assert middle == pytest.approx(expected, rel=0.05)
    assert np.sqrt(((omega - middle) ** 2 * power).sum() / power.sum()) < 2 * np.pi / played.life


def test_crests_run_with_the_wave_and_not_against_it():
    places = np.stack([np.arange(400) * 0.01 + 1.0, np.full(400, 3.0)], axis=1)
    played = relief(filmed(12.0))
    t, dt = 0.5 * played.life, 0.02
    before, after = (played.at(places, t + s).height for s in (0.0, dt))
    moved = [float(np.mean((np.interp(places[:, 0] - s, places[:, 0], before) - after)[50:-50] ** 2))
             for s in (-0.02, 0.0, 0.02)]  # fmt: skip
    assert moved[2] < moved[1] < moved[0]


def test_slope_and_wavelength_are_the_films():
    waves = FilmedWaves(
        np.array([[10.0, 0.0], [14.0, 3.0], [20.0, -4.0]]), 1e-3 * np.array([2.0, 3.0, 1.0]), np.zeros(3, bool), 0.5,
        (1.0, 1.0),
    )  # fmt: skip
    played = relief(waves, (0.3, 0.0), seed=5)
    found = [played.at(lattice(), t) for t in np.linspace(0, 4 * played.life, 41)]
    slope = np.mean([(f.slope**2).sum(axis=1).mean() for f in found])
    height = np.mean([(f.height**2).mean() for f in found])
    assert slope == pytest.approx(waves.slope_variance, rel=0.2)
    assert 2 * np.pi / np.sqrt(slope / height) == pytest.approx(waves.wavelength(), rel=0.2)


def test_slope_and_rate_are_those_of_the_height():
    played, places = replace(relief(filmed(12.0, 0.3, bins=2.0), (0.2, 0.1)), life=1e3), lattice(12)
    t, step = 0.5 * played.life, 1e-4
    now = played.at(places, t)
    for axis in range(2):
        aside = step * np.eye(2)[axis]
        change = (played.at(places + aside, t).height - played.at(places - aside, t).height) / (2 * step)
        assert change == pytest.approx(now.slope[:, axis], abs=1e-4)
    change = (played.at(places, t + step).height - played.at(places, t - step).height) / (2 * step)
    assert change == pytest.approx(now.rate, abs=1e-3)


def test_standing_waves_stay_whatever_flows():
    played, places = relief(filmed(standing=True), (1.0, 0.0)), lattice(12)
    first, later = played.at(places, 0.0), played.at(places, 3.7)
    assert first.height == pytest.approx(later.height)
    assert np.abs(later.rate).max() == 0.0
    assert first.height.std() > 0


def test_a_seed_gives_the_same_waves_and_another_others():
    places = lattice(12)
    one, same, other = (relief(filmed(), seed=s).at(places, 1.3).height for s in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.allclose(one, other)


def test_nothing_jumps_when_a_layer_begins_anew():
    played, places = relief(filmed(), (0.5, 0.0)), lattice(12)
    for t in (0.5 * played.life, played.life, 1.5 * played.life):
        before, after = played.at(places, t - 1e-4).height, played.at(places, t + 1e-4).height
        assert np.abs(before - after).max() < 1e-4


def test_a_sheared_current_has_layers_that_last_less_long():
    flow = np.zeros((*SHAPE, 2))
    calm = relief(filmed())
    flow[..., 0] = 2.0 * np.arange(SHAPE[1]) * PITCH
    sheared = WaveRelief.of(filmed(), DEEP, (np.zeros(2), PITCH), flow, np.ones(SHAPE))
    assert calm.life == LIVES[1]
    assert sheared.life == pytest.approx(1.0)


def test_blur_takes_what_is_shorter_than_it():
    places = lattice(12)
    short, long = relief(filmed(60.0)), relief(filmed(3.0))
    left = [r.at(places, 1.0, blur=0.05).height.std() / r.at(places, 1.0).height.std() for r in (short, long)]
    assert left[0] == pytest.approx(np.exp(-0.5 * 9.0), rel=1e-3)
    assert left[1] > 0.98


def test_they_grow_with_amount_and_current_until_they_break():
    places = lattice(24)

    def steep(**more):
        return float((relief(filmed(), **more).at(places, 1.0).slope ** 2).sum(axis=1).mean())

    usual = steep()
    assert steep(amount=2.0) == pytest.approx(4 * usual)
    assert steep(growth=np.full(SHAPE, 2.0)) == pytest.approx(4 * usual)
    assert steep(amount=100.0) == pytest.approx(usual * 0.5 * STEEPEST**2 / 0.05**2)
    assert steep(amount=0.0) == 0.0


def test_twice_the_current_makes_them_four_times_as_high_and_no_more():
    current = np.full((3, 3, 2), 0.7)
    assert grown_with(current, current) == pytest.approx(np.ones((3, 3)))
    assert grown_with(2 * current, current)[0, 0] == pytest.approx(4.0, rel=0.1)
    assert grown_with(9 * current, current)[0, 0] == MOST_GROWN
    assert grown_with(0 * current, current)[0, 0] < 0.01
    assert grown_with(0 * current, 0 * current)[0, 0] == 1.0


def test_a_current_of_another_map_is_refused():
    with pytest.raises(ValueError, match="currents"):
        WaveRelief.of(filmed(), DEEP, (np.zeros(2), PITCH), np.zeros((2, 2, 2)), np.ones(SHAPE))
