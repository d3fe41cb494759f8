"""A film of a fluid is what stays in each place, and what comes and goes, without the bank that its rim shows."""

import cv2
import numpy as np
import pytest

from fluidlift.look.footage import BROAD, FEWEST, RIM, SHARPER, SHOWN, FluidFootage, grain_kept

SIZE, FRAMES = (48, 64), 12
WATER, BANK = np.array([60, 110, 150]), np.array([150, 90, 40])
INTERVAL = 0.04


def noise(sigma: float = 1.0, contrast: float = 12.0, seed: int = 0, count: int = FRAMES) -> np.ndarray:
    """[T,H,W,1]: grain, another one in each frame."""
    rng = np.random.default_rng(seed)
    grain = np.stack(
        [cv2.GaussianBlur(rng.standard_normal(SIZE).astype(np.float32), (0, 0), sigma) for _ in range(count)]
    )
    return contrast * (grain / grain.std())[..., None]


def everywhere(count: int = FRAMES) -> np.ndarray:
    return np.ones((count, *SIZE), bool)


def lively(**more) -> np.ndarray:
    """u8 [T,H,W,3]: water with grain."""
    return np.clip(WATER + noise(**more), 0, 255).astype(np.uint8)


def looked_up(film: FluidFootage, index: np.ndarray, instants: np.ndarray, *, home: bool = True):
    return film.looked_up(index, instants, np.full(len(index), home))


def at_pixels(mask: np.ndarray) -> np.ndarray:
    return np.argwhere(mask).astype(np.float64)


def test_mean_and_residual_add_up_to_each_picture():
    frames = lively()
    film = FluidFootage.of(frames, everywhere(), INTERVAL)
    index = at_pixels(everywhere()[0])
    for t in (0, 5, FRAMES - 1):
        mean, residual, share = looked_up(film, index, np.full(len(index), float(t)))
        whole = mean + residual
        # single precision; a level of the picture is 4e-3
        np.testing.assert_allclose(whole, frames[t].reshape(-1, 3) / 255.0, atol=1e-5)
        assert (share == 1).all()


def test_residuals_of_a_place_cancel_over_the_time_in_which_it_is_fluid():
    """A thin and a wide part: water that comes and goes has the mean of its own time alone."""
    fluid = everywhere()
    fluid[::2, :, 32:] = False  # half of the time the right half is dry, and shows the bank
    frames = np.where(fluid[..., None], lively(), BANK).astype(np.uint8)
    film = FluidFootage.of(frames, fluid, INTERVAL)
    index = at_pixels(everywhere()[0])
    total = sum(looked_up(film, index, np.full(len(index), float(t)))[1] for t in range(FRAMES))
    assert np.abs(total).max() < 1e-5 * FRAMES  # sums of single precision
    assert np.abs(255 * film.mean[:, 40:] - WATER).mean() < 12, "grain of twelve levels over six frames, and no bank"


def test_what_is_broad_is_shade_and_what_is_small_is_fine():
    """A stripe pattern over a slope of brightness: the blur takes the slope, up to its rim, and leaves the stripes."""
    x = np.arange(SIZE[1])
    wide = 80 + 1.0 * x
    stripes = 20 * np.cos(np.pi * x)  # two pixels long, far below the blur
    frames = np.broadcast_to((wide + stripes)[None, None, :, None], (FRAMES, *SIZE, 3)).round().astype(np.uint8)
    film = FluidFootage.of(frames, everywhere(), INTERVAL)
    inner = slice(8, -8)  # four standard deviations of the blur from the rim
    assert BROAD * max(SIZE) < 2
    np.testing.assert_allclose(
        255 * film.shade[:, inner, 0], np.broadcast_to(wide[inner], (48, 48)), atol=1.0
    )  # rounding
    fine = 255 * (film.mean - film.shade)[:, inner, 0]
    np.testing.assert_allclose(fine, np.broadcast_to(stripes[inner], (48, 48)), atol=1.0)


def oblique_shore() -> tuple[np.ndarray, np.ndarray, FluidFootage]:
    """Picture, pixels that mix water and bank, and the film: an edge that runs through pixels mixes two colours."""
    y, x = np.indices(SIZE)
    away = 0.8 * (x - 30.3) + 0.6 * (y - 24.0)  # px from an oblique waterline, water to its left
    covered = np.clip(0.5 - cv2.GaussianBlur(away, (0, 0), 0.7), 0, 1)[..., None]  # antialiased over a pixel
    picture = np.round(covered * WATER + (1 - covered) * BANK)
    frames = np.repeat(picture[None].astype(np.uint8), FRAMES, axis=0)
    fluid = np.repeat((covered[..., 0] >= 0.5)[None], FRAMES, axis=0)
    mixed = fluid[0] & (np.abs(picture - WATER).max(axis=-1) > 5)
    assert mixed.sum() > 20, "the mask must take in pixels that are mixed for this to say anything"
    return picture, mixed, FluidFootage.of(frames, fluid, INTERVAL)


def test_the_rim_shows_no_bank_in_other_places():
    """What goes on beside the fluid, and what another place is given, is what is well inside."""
    _, mixed, film = oblique_shore()
    assert np.abs(255 * film.inner - WATER).max() < 1.5 and np.abs(255 * film.shade - WATER).max() < 1.5  # rounding
    mean, residual, share = looked_up(film, at_pixels(mixed), np.zeros(mixed.sum()), home=False)
    assert np.abs(255 * mean - WATER).max() < 1.5
    assert (residual == 0).all() and (share == 0).all(), "nothing comes and goes in a mixed pixel"


def test_the_rim_is_as_filmed_in_its_own_place():
    """Else a line of the inside's colour stands along every shore."""
    picture, mixed, film = oblique_shore()
    mean, residual, share = looked_up(film, at_pixels(mixed), np.zeros(mixed.sum()))
    np.testing.assert_allclose(255 * (mean + residual), picture[mixed], atol=1e-3)  # single precision
    assert (share == 1).all()


def test_threads_that_are_no_wider_than_a_rim_are_kept():
    """A thread of two pixels has no pixel that is not at its rim: its own look is all that there is."""
    fluid = np.zeros((FRAMES, *SIZE), bool)
    fluid[:, :, 10:12] = True
    fluid[:, 20:44, 30:60] = True
    frames = np.where(fluid[..., None], WATER, BANK).astype(np.uint8)
    frames[:, :, 10:12] = (250, 250, 250)
    film = FluidFootage.of(frames, fluid, INTERVAL)
    np.testing.assert_allclose(film.mean[:, 10:12], 250 / 255, atol=1e-6)
    assert film.pure[:, 10:12].all()
    assert not film.pure[20, 30:60].any() and film.pure[20 + RIM + 1, 45], "a wide body has a rim"


def test_a_film_that_is_too_short_or_shows_no_fluid_is_none():
    assert FluidFootage.of(lively()[: FEWEST - 1], everywhere(FEWEST - 1), INTERVAL) is None
    assert FluidFootage.of(lively()[:FEWEST], everywhere(FEWEST), INTERVAL) is not None
    assert FluidFootage.of(lively(), ~everywhere(), INTERVAL) is None
    rare = ~everywhere()
    rare[0] = True  # one frame of twelve is less than a tenth
    assert 1 / FRAMES < SHOWN and FluidFootage.of(lively(), rare, INTERVAL) is None
    with pytest.raises(ValueError, match="masks"):
        FluidFootage.of(lively(), everywhere(FRAMES - 1), INTERVAL)


def test_what_was_sharpened_comes_out_of_the_splats_blur_as_it_was():
    """Grain that is hardly wider than the blur: of what it takes, a part of a part of a part is lost (see below)."""
    blur, frames = 0.9, lively(sigma=1.2)
    film = FluidFootage.of(frames, everywhere(), INTERVAL, blur=(blur, blur))

    def error(pictures: np.ndarray) -> float:
        shown = np.stack([cv2.GaussianBlur(p.astype(np.float32), (0, 0), blur) for p in pictures])
        return float(np.sqrt(np.square((shown - frames)[:, 6:-6, 6:-6]).mean()))

    plain, sharpened = error(frames), error(film.frames)
    # the blur leaves 0.6 or so of such grain: 0.4 of it is lost without, 0.4^3 with sharpening, and finer grain more
    assert plain > 2.0 and sharpened < 0.35 * plain


@pytest.mark.parametrize("wavelength", [4.0, 6.0, 10.0])
def test_a_wave_of_which_the_blur_leaves_g_comes_out_with_all_but_the_power_of_what_it_takes(wavelength):
    blur, x = 0.9, np.arange(SIZE[1])
    wave = 120 + 40 * np.cos(2 * np.pi * x / wavelength)
    frames = np.broadcast_to(wave[None, None, :, None], (FRAMES, *SIZE, 3)).round().astype(np.uint8)

    def amplitude(picture: np.ndarray) -> float:
        row = picture[24, 2:62, 0]  # whole waves of all three
        return float(2 * np.abs((row * np.exp(2j * np.pi * x[2:62] / wavelength)).mean()))

    def blurred(picture: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), blur)

    own = amplitude(frames[0])  # of whole levels: 39.7 to 40
    left = amplitude(blurred(frames[0])) / own
    sharp = FluidFootage.of(frames, everywhere(), INTERVAL, blur=(blur, blur)).frames[0]
    shown = amplitude(blurred(sharp)) / own
    # rounding to whole levels twice: half a level of forty, and its mean over sixty pixels much less
    assert shown == pytest.approx(1 - (1 - left) ** (SHARPER + 1), abs=0.5 / 40)
    assert left < 0.9, "or the blur takes nothing"


def test_what_is_blurred_less_down_the_picture_is_sharpened_less_there():
    """Splats of a surface that is seen along it are flat in the picture."""
    blur, frames = (1.1, 0.6), lively(sigma=0.8)
    sharp = FluidFootage.of(frames, everywhere(), INTERVAL, blur=blur).frames

    def steps(pictures: np.ndarray, axis: int) -> float:
        return float(np.square(np.diff(pictures[:, 6:-6, 6:-6].astype(float), axis=axis)).mean())

    across, down = (steps(sharp, axis) / steps(frames, axis) for axis in (2, 1))
    assert across > 1.4 * down > 1.4
    shown = np.stack([cv2.GaussianBlur(p.astype(np.float32), (0, 0), sigmaX=1.1, sigmaY=0.6) for p in sharp])
    across, down = (steps(shown, axis) / steps(frames, axis) for axis in (2, 1))
    assert across == pytest.approx(down, abs=0.35), "and comes out alike, as far as it does"


def test_sharpening_takes_nothing_from_beside_the_fluid():
    """A bank that is much brighter would darken the rim of water that is even."""
    fluid = everywhere()
    fluid[:, :, 32:] = False
    frames = np.where(fluid[..., None], WATER, 255).astype(np.uint8)
    film = FluidFootage.of(frames, fluid, INTERVAL, blur=(1.2, 1.2))
    np.testing.assert_array_equal(film.frames, frames)


def test_a_place_is_looked_up_in_the_nearest_frame():
    """A mean of two frames would show both."""
    frames = np.empty((FRAMES, *SIZE, 3), np.uint8)
    frames[:] = 10 * np.arange(FRAMES)[:, None, None, None]
    film = FluidFootage.of(frames, everywhere(), INTERVAL)
    instants = np.array([-3.0, 2.4, 2.6, FRAMES - 1.2, FRAMES + 7.0])
    mean, residual, _ = looked_up(film, np.full((5, 2), 20.0), instants)
    found = 255 * (mean + residual)[:, 0]
    np.testing.assert_allclose(found, 10 * np.array([0, 2, 3, FRAMES - 1, FRAMES - 1]), atol=1e-3)  # single precision


def test_the_share_of_fluid_is_bilinear_between_pixels():
    fluid = everywhere()
    fluid[3, :, 32:] = False
    film = FluidFootage.of(lively(), fluid, INTERVAL)
    columns = np.array([30.0, 31.0, 31.25, 31.5, 32.0, 40.0])
    index = np.stack([np.full(6, 20.0), columns], axis=-1)
    _, residual, share = looked_up(film, index, np.full(6, 3.0))
    np.testing.assert_allclose(share, [1, 1, 0.75, 0.5, 0, 0], atol=1e-6)
    assert (residual[-2:] == 0).all(), "what is dry adds nothing"
    np.testing.assert_allclose(looked_up(film, index, np.full(6, 4.0))[2], 1.0, atol=1e-6)  # wet again


def test_what_sways_covers_what_it_does_at_an_instant_and_what_was_never_filmed_stays():
    fluid = everywhere()
    fluid[6:, :, 32:48] = False  # it has swayed to the left
    fluid[:, :, 56:] = False  # what no frame shows is not the film's to hide
    fluid[3, 10:30] = False  # a mask that failed once
    fluid[:9, 20:24, 10:14] = False  # and one that failed in a place for a while
    film = FluidFootage.of(lively(), fluid, INTERVAL)
    columns = np.array([20.0, 31.25, 40.0, 60.0])
    index = np.stack([np.full(4, 20.0), columns], axis=-1)
    np.testing.assert_allclose(film.covers(index, np.full(4, 2.4)), 1.0, atol=1e-6)
    np.testing.assert_allclose(film.covers(index, np.full(4, 3.0)), 1.0, atol=1e-6)
    np.testing.assert_allclose(film.covers(index, np.full(4, 8.0)), [1, 0.75, 0, 1], atol=1e-6)
    assert film.covers(np.array([[22.0, 12.0]]), np.zeros(1)) == 1.0


def test_places_beyond_the_picture_are_its_border():
    film = FluidFootage.of(lively(), everywhere(), INTERVAL)
    _, beyond, _ = looked_up(film, np.array([[-5.0, 12.0], [200.0, 400.0]]), np.full(2, 2.0))
    _, border, _ = looked_up(film, np.array([[0.0, 12.0], [SIZE[0] - 1.0, SIZE[1] - 1.0]]), np.full(2, 2.0))
    np.testing.assert_allclose(beyond, border, atol=1e-7)


def test_beyond_the_sides_of_the_picture_lies_its_mirror_image():
    film = FluidFootage.of(lively(), everywhere(), INTERVAL)
    height, width = SIZE
    inside = np.array([[0.0, 0.0], [10.25, 30.5], [height - 1.0, width - 1.0]])
    np.testing.assert_array_equal(film.within(inside), inside)
    beside = np.array([[-3.0, 5.0], [height + 2.0, 5.0], [7.0, -0.5], [7.0, width + 9.0]])
    np.testing.assert_allclose(film.within(beside), [[3, 5], [height - 4, 5], [7, 0.5], [7, width - 11]])


def test_less_is_kept_of_finer_grain_and_by_wider_splats():
    fine, coarse = lively(sigma=0.4), lively(sigma=2.0)
    kept = [[grain_kept(film, everywhere(), (blur, blur)) for blur in (0.6, 0.9, 1.2)] for film in (fine, coarse)]
    assert (np.diff(kept, axis=1) < 0).all() and (np.array(kept[1]) > np.array(kept[0])).all()
    assert kept[0][2] < 0.5 and kept[1][0] > 0.9
    still = np.full((FRAMES, *SIZE, 3), 90, np.uint8)
    assert grain_kept(still, everywhere(), (1.0, 1.0)) == 1.0 and grain_kept(fine, ~everywhere(), (1.0, 1.0)) == 1.0


def test_what_is_kept_is_what_the_film_then_shows():
    """Against the picture of it: sharpened, and blurred as splats do."""
    frames, blur = lively(sigma=0.7), 1.0
    found = FluidFootage.of(frames, everywhere(), INTERVAL, blur=(blur, blur))
    assert found is not None
    own, shown = (
        [np.std(g - cv2.GaussianBlur(g, (0, 0), 1.0)) for g in film.astype(np.float32).mean(axis=-1)]
        for film in (frames, np.stack([cv2.GaussianBlur(f.astype(np.float32), (0, 0), blur) for f in found.frames]))
    )
    assert grain_kept(frames, everywhere(), (blur, blur)) == pytest.approx(np.mean(shown) / np.mean(own), rel=0.05)
