"""Waves of a film are told from what is carried, what stands and noise; their slope and length come back."""

import numpy as np
import pytest
from made_waves import DEEP, STEP, MadeWaves, brightness, window

from fluidlift.look.surface_map import SurfaceMap
from fluidlift.look.surface_windows import windows_of
from fluidlift.look.wave_spectrum import WHY_NOT, FilmedWaves, SurfaceWindow, waves_in
from fluidlift.numerics.srgb import srgb_from_linear
from fluidlift.physics.wave_dispersion import STEEPEST, WaveMedium
from fluidlift.types import PinholeCamera


@pytest.mark.parametrize(
    ("wavelength", "slope", "current", "frames"),
    [
        (0.5, 0.05, (0.6, 0.1), 90),
        (0.5, 0.02, (0.0, 0.0), 90),
        (0.35, 0.1, (-0.4, 0.3), 90),
        (0.5, 0.05, (0.6, 0.1), 30),
    ],
    ids=["on a current", "low, on water at rest", "against a current", "in 1.2 seconds"],
)
def test_running_waves_come_back_within_a_fifth(wavelength, slope, current, frames):
    made = MadeWaves.running(wavelength, slope, current, 0.0, DEEP, seed=4)
    filmed, truth = window(made, current, frames=frames)
    found = waves_in([filmed])
    assert isinstance(found, FilmedWaves)
    assert found.slope_variance == pytest.approx(truth, rel=0.2)
    assert found.wavelength() == pytest.approx(made.wavelength, rel=0.1)
    assert found.carried and not found.standing.any()
    assert found.factor[0] < 1.0 < found.factor[1]


def test_waves_that_stand_come_back_apart_from_a_bed():
    current = (1.0, 0.0)
    made = MadeWaves.standing(0.06, current, DEEP, seed=2)
    filmed, truth = window(made, current)
    found = waves_in([filmed])
    assert isinstance(found, FilmedWaves)
    assert found.slope_variance == pytest.approx(truth, rel=0.25)
    assert found.wavelength(standing=True) == pytest.approx(2 * np.pi * 1.0**2 / 9.81, rel=0.1)
    assert found.variance[found.standing].sum() > 0.9 * found.slope_variance
    assert (found.wavevectors[found.standing, 0] < 0).all()  # they face the current


def test_in_shallow_water_they_are_longer_for_their_frequency():
    shallow = WaveMedium(depth=0.05)
    made = MadeWaves.running(0.5, 0.05, (0.3, 0.0), 0.0, shallow, seed=1)
    found = waves_in([window(made, (0.3, 0.0), medium=shallow)[0]])
    assert isinstance(found, FilmedWaves)
    assert found.wavelength() == pytest.approx(made.wavelength, rel=0.1)


def test_where_crests_were_taken_for_a_current_their_frequency_tells_their_length():
    made = MadeWaves.running(0.5, 0.05, (0.0, 0.0), 0.0, DEEP, seed=4)
    filmed, truth = window(made, (0.0, 0.0), foam=0.0, measured=(0.88, 0.0))
    found = waves_in([filmed])
    assert isinstance(found, FilmedWaves) and not found.carried
    assert found.wavelength() == pytest.approx(made.wavelength, rel=0.15)
    assert found.slope_variance == pytest.approx(truth, rel=0.35)


@pytest.mark.parametrize(
    "shown",
    [{}, {"foam": 0.3}, {"bed": 0.5}, {"noise": 0.2}, {"foam": 0.3, "frames": 50}],
    ids=["little", "foam", "a bed", "noise", "foam, for two seconds"],
)
@pytest.mark.parametrize("current", [(0.6, 0.1), (1.4, 0.0), (0.05, 0.0)], ids=str)
def test_what_is_carried_or_stands_or_flickers_is_no_wave(shown, current):
    for seed in range(2):
        assert isinstance(waves_in([window(None, current, seed=seed, **shown)[0]]), str)


def test_one_window_of_many_is_chance():
    made = MadeWaves.running(0.5, 0.05, (0.6, 0.1), 0.0, DEEP, seed=4)
    waving, calm = window(made, (0.6, 0.1))[0], window(None, (0.6, 0.1))[0]
    assert waves_in([waving, calm, calm]) == "none"
    both, alone = waves_in([waving, calm]), waves_in([waving])
    assert isinstance(both, FilmedWaves) and isinstance(alone, FilmedWaves)
    assert both.slope_variance == pytest.approx(0.5 * alone.slope_variance)


def test_slopes_are_never_those_of_waves_that_break():
    made = MadeWaves.running(0.5, 0.3, (0.6, 0.1), 0.0, DEEP, seed=4)
    filmed, _ = window(made, (0.6, 0.1), foam=0.0)
    steeper = SurfaceWindow(**{**vars(filmed), "contrast": 3.0 * filmed.contrast})
    found = waves_in([steeper])
    assert isinstance(found, FilmedWaves)
    assert found.slope_variance == pytest.approx(0.5 * STEEPEST**2)


@pytest.mark.parametrize(("changed", "reason"), [({"incidence": 0.2}, "steep"), ({}, "short")], ids=["steep", "short"])
def test_it_is_said_why_there_are_none(changed, reason):
    made = MadeWaves.running(0.5, 0.05, (0.6, 0.1), 0.0, DEEP, seed=4)
    filmed, _ = window(made, (0.6, 0.1), frames=90 if changed else 10)
    assert waves_in([SurfaceWindow(**{**vars(filmed), **changed})]) == reason
    assert reason in WHY_NOT
    assert waves_in([]) == "small"


# --- through a camera -----------------------------------------------------------------------------------------------

CAMERA = PinholeCamera.looking((0.0, -5.5, 2.0), (0.0, 0.6, 0.0), fov_degrees=42.0, size=(288, 176))


def film(waves, frames, *, seed=0):
    """u8 [t,h,w,3] of level water at z = 0, all of the picture, with noise of a level."""
    rng = np.random.default_rng(seed)
    ways = CAMERA.rays(CAMERA.pixel_grid())
    down = np.minimum(ways[..., 2], -1e-3)
    far = -CAMERA.position[2] / down
    places = CAMERA.position[:2] + far[..., None] * ways[..., :2]
    level = np.linalg.norm(ways[..., :2], axis=-1)
    incidence, sight = np.arctan2(level, -down), ways[..., :2] / level[..., None]
    towards = np.zeros((frames, *incidence.shape)) if waves is None else waves.towards(places, sight, STEP, frames)
    rgb = srgb_from_linear(brightness(incidence, towards).astype(np.float32))
    noisy = np.clip(np.rint(255 * rgb + rng.normal(size=rgb.shape)), 0, 255)
    return noisy.astype(np.uint8)[..., None].repeat(3, -1)


def water(current):
    """A level surface of 6 x 6 m at z = 0."""
    shape, pitch = (60, 60), 0.1
    velocity = np.broadcast_to([*current, 0.0], (*shape, 3)).copy()
    return SurfaceMap(np.array([-3.0, -3.0]), pitch, np.ones(shape, bool), np.zeros(shape), velocity)


def through_camera(waves, current, frames=60):
    pictures, surface = film(waves, frames), water(current)
    fluid = np.ones(pictures.shape[:3], bool)
    return windows_of(pictures, fluid, STEP, CAMERA, surface, np.full((60, 60), 5.0), DEEP)


def test_films_give_slope_and_wavelength_within_a_fifth():
    current, slopes, lengths = (0.1, -0.4), [], []
    for seed in range(5):  # waves come in groups: one window sees more or less of them
        made = MadeWaves.running(0.5, 0.05, current, 0.5 * np.pi, DEEP, seed=seed)
        windows = through_camera(made, current)
        assert len(windows) >= 2
        found = waves_in(windows)
        assert isinstance(found, FilmedWaves)
        assert found.wavevectors[:, 1] @ found.variance > 0  # they run away from the camera
        slopes.append(found.slope_variance)
        lengths.append(found.wavelength() / made.wavelength)
    assert np.mean(slopes) == pytest.approx(0.05**2, rel=0.2)
    assert lengths == pytest.approx(np.ones(5), rel=0.2)


def test_a_mirrored_shore_is_more_light_for_the_same_slope():
    made = MadeWaves.running(0.5, 0.05, (0.1, -0.4), 0.5 * np.pi, DEEP, seed=0)
    plain = film(made, 60)
    striped = (plain * (0.75 + 0.25 * np.sin(np.arange(plain.shape[1]) / 8.0))[:, None, None]).astype(np.uint8)
    place = STEP, CAMERA, water((0.1, -0.4)), np.full((60, 60), 5.0), DEEP
    bare, shore = (windows_of(f, np.ones(f.shape[:3], bool), *place)[0].mirrored for f in (plain, striped))
    assert bare < 2.0 < 10.0 < shore  # beside 3, of a uniform sky


def test_a_film_of_level_water_shows_none():
    assert isinstance(waves_in(through_camera(None, (0.1, -0.4), 40)), str)


def test_windows_are_where_the_film_shows_water():
    pictures = film(None, 20)
    fluid = np.zeros(pictures.shape[:3], bool)
    assert windows_of(pictures, fluid, STEP, CAMERA, water((0, 0)), np.full((60, 60), 5.0), DEEP) == []
    assert windows_of(pictures[:8], ~fluid[:8], STEP, CAMERA, water((0, 0)), np.full((60, 60), 5.0), DEEP) == []
    found = windows_of(pictures, ~fluid, STEP, CAMERA, water((0.2, 0)), np.full((60, 60), 5.0), DEEP)
    assert found and all(w.current == (0.2, 0.0) and w.medium.depth == 5.0 for w in found)
    assert all(abs(np.hypot(*w.sight) - 1) < 1e-9 and 1.0 < w.incidence < 1.4 for w in found)
