"""Numbers of foam and waves: their intervals hold what an endless film would give, and no more often than they say."""

from dataclasses import replace

import numpy as np
import pytest
from made_foam import filmed, foam_film, surface
from made_waves import DEEP, MadeWaves, window
from scipy import stats
from small_scene import striped_channel

from fluidlift.io.footage_file import write_footage
from fluidlift.look.wave_spectrum import FilmedWaves, waves_in
from fluidlift.numerics.block_bootstrap import Spread, correlation_length, memory_of, resampled, spread_of
from fluidlift.scene.filmed_numbers import NAMES, WatchedFlow, film_estimates, wave_estimates
from fluidlift.scene.simulator import simulator_of
from fluidlift.scene.surface_appearance import SurfaceAppearance
from fluidlift.scene.whitewater import measured
from fluidlift.scene.whitewater_law import LAW, SHARE, foam_estimate, law_estimates, law_of


def of_first_order(seed, count, share):
    """A process whose neighbours share so much, of mean 0 and variance 1."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=count)
    for k in range(1, count):
        x[k] = share * x[k - 1] + np.sqrt(1.0 - share**2) * x[k]
    return x


@pytest.mark.parametrize("share", [0.0, 0.5, 0.8, 0.9])
def test_the_memory_of_a_record_is_found(share):
    length = np.mean([correlation_length(of_first_order(s, 2000, share)) for s in range(5)])
    assert length == pytest.approx((1 + share) / (1 - share), rel=0.3)
    assert correlation_length(np.ones(50)) == 1.0 and correlation_length(np.ones(1)) == 1.0


@pytest.mark.parametrize(("count", "share"), [(40, 0.0), (40, 0.8), (120, 0.9)])
def test_intervals_of_means_hold_the_truth_as_often_as_they_say(count, share):
    held = []
    for seed in range(200):
        record = np.exp(0.3 * of_first_order(seed, count, share))
        memory = memory_of(record)
        spread = spread_of(record[resampled(memory, 100, seed)].mean(axis=1), "logarithm", memory)
        low, high = spread.interval(record.mean(), 0.9)
        held.append(low <= np.exp(0.5 * 0.3**2) <= high)
    assert 0.83 <= np.mean(held) <= 0.97


def test_blocks_are_pieces_of_the_record():
    memory = memory_of(of_first_order(0, 90, 0.9))
    drawn = resampled(memory, 7, 1)
    assert drawn.shape == (7, 90) and memory.block > 5
    steps = np.diff(drawn, axis=1) % 90
    assert (steps == 1).mean() > 1.0 - 1.5 / memory.block
    with pytest.raises(ValueError, match="samples"):
        resampled(memory, 0, 1)


def test_students_distribution_is_that_of_the_textbook():
    low, high = Spread(0.1, 4.0).interval(2.0, 0.9)
    assert np.log(high / 2.0) == pytest.approx(0.1 * stats.t.ppf(0.95, 4.0))
    assert np.log(low / 2.0) == pytest.approx(-np.log(high / 2.0))
    low, high = Spread(3.0, 2.0, "logit").interval(0.3)
    assert 0.0 < low < 0.3 < high < 1.0


def test_the_share_of_foam_of_made_films_lies_in_its_interval():
    held, share = [], 0.12
    for seed in range(10):
        film = filmed(foam_film(seed, share=share, frames=60))
        estimate = foam_estimate(film)
        low, high = foam_estimate(film, 0.9).interval
        held.append(low <= share <= high)
        assert estimate.interval[0] < low < estimate.value < high < estimate.interval[1] and estimate.sigma > 0.005
    assert 0.8 <= np.mean(held) <= 1.0


def test_the_law_of_made_surfaces_lies_in_its_intervals():
    share, frames = 0.12, 25
    truth = law_of(surface(99, 1500, memory=4.0), share, 0.05).numbers
    held = []
    for seed in range(10):
        film = filmed(foam_film(seed, share=share, frames=60))
        found = law_estimates(surface(seed, frames, memory=4.0), film, 0.05, 0.9)
        ends = [found[name].interval for name in LAW]
        held.append([low <= t <= high for (low, high), t in zip(ends, truth)])
    assert (np.mean(held, axis=0) >= 0.7).all() and 0.8 <= np.mean(held) <= 1.0


def test_a_rate_at_the_end_of_its_range_is_not_known():
    film, record = filmed(foam_film(0, share=0.12, frames=40)), surface(0, 20, memory=4.0)
    even = np.ones_like(record.trapped)  # nothing stands out, so nothing breaks
    found = law_estimates(record._replace(trapped=even, crest=even), film, 0.05)
    rate = found["whitewater_rate"]
    assert rate.interval is None and rate.sigma == np.inf and not rate.fitted and "end of its range" in rate.source
    assert found["whitewater_energy"].interval is not None


def test_waves_have_the_error_of_sampling_and_what_is_not_known_of_water_and_sky():
    even = FilmedWaves(
        np.array([[2 * np.pi / 0.5, 0.0]] * 100), np.full(100, 2.5e-5), np.zeros(100, bool), 1.0, (0.5, 10.0)
    )
    known, all_of_it = wave_estimates(even, optics=False), wave_estimates(even)
    assert set(known) == {"wave_length", "wave_slope", "wave_amplitude"}
    assert known["wave_slope"].value == pytest.approx(0.05)
    assert known["wave_length"].value == pytest.approx(0.5)
    # of one length: slope is wavenumber times amplitude over sqrt 2
    assert known["wave_amplitude"].value == pytest.approx(np.sqrt(2) * 0.05 * 0.5 / (2 * np.pi))
    # a hundred places of a spectrum, of which some four are one, and each observed square is twice the expected one
    assert known["wave_slope"].sigma == pytest.approx(0.05 * 0.5 * np.sqrt(0.5 * 3.66 / 100), rel=0.06)
    low, high = all_of_it["wave_slope"].interval
    assert low < 0.5 * 0.05 and high == pytest.approx(0.44 / np.sqrt(2), rel=0.02)  # no steeper than they break
    assert all_of_it["wave_length"].interval == known["wave_length"].interval
    fewer = FilmedWaves(even.wavevectors[:4], even.variance[:4], even.standing[:4], 1.0, (0.5, 10.0))
    assert wave_estimates(fewer, optics=False)["wave_slope"].sigma > known["wave_slope"].sigma


@pytest.mark.parametrize("length", [0.5, 0.3])
def test_made_waves_lie_in_their_intervals(length):
    held, slope = [], 0.05
    for seed in range(8):
        made = MadeWaves.running(length, slope, (0.6, 0.1), 0.0, DEEP, seed=seed)
        found = waves_in([window(made, (0.6, 0.1), frames=60, seed=seed)[0]])
        assert isinstance(found, FilmedWaves)
        low, high = wave_estimates(found, 0.9, optics=False)["wave_slope"].interval
        held.append(low <= slope <= high)
    assert np.mean(held) >= 0.7


@pytest.fixture(scope="module")
def foaming(tmp_path_factory):
    """A channel of 33 frames with a film of drifting foam."""
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    frames = foam_film(3, share=0.1, frames=40, interval=0.04, radius=3.0, speed=27.4, size=(64, 48))  # 0.6 m/s
    write_footage(path, frames, np.ones(frames.shape[:3], bool), 0.04)
    return striped_channel(33, film=path)


def played(scene, white):
    """A simulation's last frame as it is shown."""
    simulator, appearance = simulator_of(scene), SurfaceAppearance(scene, white)
    for k in range(scene.frames):
        if k:
            simulator.advance(scene.interval)
        appearance.advance(simulator.particles, k)
    return appearance.dressed(simulator.particles, scene.frames - 1), appearance


def test_a_simulation_is_watched_on_the_way_and_shown_as_it_is(foaming):
    watch = WatchedFlow.of(foaming)
    assert watch is not None
    shown, appearance = played(foaming, watch)
    bare, _ = played(foaming, None)
    np.testing.assert_array_equal(shown.gaussians.means, bare.gaussians.means)
    np.testing.assert_array_equal(shown.ids, bare.ids)
    assert not any(name.startswith("whitewater") for name in appearance.state())
    found, alone = watch.estimates, measured(foaming)
    assert alone is not None and found == alone.estimates and set(found) == set(LAW)
    for estimate in found.values():
        assert estimate.interval[0] < estimate.value < estimate.interval[1]
        assert estimate.source.startswith("fitted") and "40 frames" in estimate.source


def test_what_went_on_from_a_checkpoint_was_not_seen(foaming):
    watch, simulator = WatchedFlow.of(foaming), simulator_of(foaming)
    assert watch.estimates == {}
    watch.restore({})
    for k in range(1, 12):
        watch.advance(simulator.particles, k)
    assert watch.estimates == {}


def test_scenes_without_foam_or_that_were_edited_are_not_watched(foaming):
    assert WatchedFlow.of(replace(foaming, film=None)) is None
    assert WatchedFlow.of(replace(foaming, changes=("density",))) is None
    assert WatchedFlow.of(replace(foaming, kind="plume")) is None
    honey = replace(foaming, parameters=replace(foaming.parameters, kinematic_viscosity=7e-3))
    assert WatchedFlow.of(honey) is None and film_estimates(honey) == {}
    assert film_estimates(replace(foaming, film=None)) == {} == film_estimates(replace(foaming, kind="plume"))
    found = film_estimates(foaming)
    assert set(found) == {SHARE} and list(NAMES).index(SHARE) == 0
    low, high = found[SHARE].interval
    assert low < 0.1 < high
