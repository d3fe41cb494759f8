"""Smoke before a background that is known: its color and opacity give the picture again, and are those of the truth."""

import numpy as np
import pytest

from fluidlift.look.smoke_film import (
    OPAQUE,
    TINT,
    SmokeFilm,
    behind_smoke,
    shown_from,
    smoke_color,
    smoke_layer,
    smoke_layers,
)

SIZE = (64, 80)
GREY = np.array([0.75, 0.75, 0.8])


def wall(grain: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.uniform(-grain, grain, (SIZE[0] // 4, SIZE[1] // 4, 1)), np.ones((4, 4, 1)))
    return np.clip(0.3 + blocks * np.array([1.0, 0.8, 0.6]), 0, 1)


def plume(thickest: float, frames: int = 6) -> np.ndarray:
    """Opacity of a puff that wanders."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack(
        [
            thickest * np.exp(-((u - 40 - 6 * np.sin(t)) ** 2 / (2 * 9**2) + (v - 32) ** 2 / (2 * 16**2)))
            for t in range(frames)
        ]
    )


def pictures(opacity: np.ndarray, behind: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a = opacity[..., None]
    return bytes_of(a * GREY + (1 - a) * behind), opacity > 0.05, bytes_of(behind)


def bytes_of(values: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)


@pytest.mark.parametrize("thickest", [0.2, 0.35, 0.6, 0.9])
def test_what_shows_through_tells_how_opaque_smoke_is(thickest):
    opacity = plume(thickest)
    frames, fluid, behind = pictures(opacity, wall(0.2))
    color = smoke_color(frames, fluid, behind)
    assert color.told and np.abs(color.color - GREY).max() < 0.03
    _, found = smoke_layer(frames[2], fluid[2], behind, color)
    thick = opacity[2] > 0.5 * thickest
    assert found[thick].mean() / 255 == pytest.approx(opacity[2][thick].mean(), rel=0.05)


def test_before_a_bare_wall_the_thickest_counts_as_nearly_opaque():
    frames, fluid, behind = pictures(plume(0.5), np.full((*SIZE, 3), 0.1))
    color = smoke_color(frames, fluid, behind)
    _, found = smoke_layer(frames[0], fluid[0], behind, color)
    assert not color.told and found.max() / 255 == pytest.approx(OPAQUE, abs=0.06)


def test_a_bright_smoke_that_no_color_could_make_so_thin_is_thicker():
    """Twice as white as white is no color: then the smoke hides more."""
    frames, fluid, behind = pictures(plume(0.9), np.full((*SIZE, 3), 0.1))
    frames = np.where(fluid[..., None], np.minimum(frames.astype(int) + 60, 255), frames).astype(np.uint8)
    assert smoke_color(frames, fluid, behind).color.max() <= 1.0


@pytest.mark.parametrize("grain", [0.0, 0.2])
def test_color_and_opacity_before_the_background_are_the_picture(grain):
    frames, fluid, behind = pictures(plume(0.7), wall(grain))
    for picture, mask, (color, opacity) in zip(frames, fluid, smoke_layers(frames, fluid, behind), strict=True):
        a = opacity[..., None] / 255.0
        again = a * color + (1 - a) * behind
        assert np.abs(again - picture)[mask].mean() < 1.5
        assert (opacity[np.abs(picture.astype(int) - behind).max(axis=-1) == 0] == 0).all()


def test_a_background_that_is_guessed_wrong_does_not_dye_the_smoke():
    frames, fluid, _ = pictures(plume(0.5), np.full((*SIZE, 3), [0.2, 0.3, 0.6]))
    wrong = bytes_of(np.full((*SIZE, 3), [0.4, 0.3, 0.2]))
    thick = smoke_color(frames, fluid, wrong)
    color, _ = smoke_layer(frames[0], fluid[0], wrong, thick)
    assert np.abs(color / 255.0 - thick.color).max() <= TINT + 1 / 255


def test_no_smoke_is_no_smoke():
    behind = bytes_of(wall(0.2))
    _, opacity = next(smoke_layers(behind[None], np.zeros((1, *SIZE), bool), behind))
    assert not opacity.any()


def test_masks_of_another_size_are_refused():
    with pytest.raises(ValueError, match="masks"):
        smoke_color(np.zeros((2, 4, 4, 3), np.uint8), np.zeros((2, 4, 5), bool), np.zeros((4, 4, 3), np.uint8))


# played ---------------------------------------------------------------------------------------------------------


def film(count: int = 30, interval: float = 0.1) -> SmokeFilm:
    opacity = np.zeros((count, 8, 8), np.uint8)
    for t in range(count):
        opacity[t] = 100 + 50 * np.sin(2 * np.pi * t / 12)
    return SmokeFilm(np.full((count, 8, 8, 3), 200, np.uint8), opacity, interval)


def test_as_long_as_the_clip_it_is_shown_as_filmed():
    one = film()
    for t in range(len(one)):
        _, depth = one.at(0.1 * t, 2.9)
        assert depth[0, 0] == pytest.approx(-np.log1p(-float(one.opacities[t, 0, 0]) / 255), rel=1e-5)


def test_beyond_its_end_it_goes_on_without_a_jump():
    one, whole = film(), 9.0
    depths = np.array([one.at(0.1 * k, whole)[1][0, 0] for k in range(91)])
    filmed = np.array([one.layer(t)[1][0, 0] for t in range(len(one))])
    assert np.abs(np.diff(depths)).max() < 1.5 * np.abs(np.diff(filmed)).max()
    assert np.ptp(depths[30:]) > 0.8 * np.ptp(filmed)  # and does not stand still


def test_smoke_that_still_comes_to_new_places_at_the_end_spreads():
    v, u = np.mgrid[:40, :40]
    for rises, wanted in ((0.0, False), (0.8, True)):
        top = [30 - rises * t + 1.5 * np.sin(t) for t in range(24)]
        frames = np.stack([np.where((v > y) & (np.abs(u - 20) < 6), 150, 0) for y in top]).astype(np.uint8)
        assert SmokeFilm(np.zeros((*frames.shape, 3), np.uint8), frames, 0.04).spreads == wanted


def test_a_film_of_a_few_frames_can_be_played_for_long():
    for count in (1, 2, 5):
        color, depth = film(count).at(7.0, 9.0)
        assert np.isfinite(color).all() and np.isfinite(depth).all()


# what is behind it ------------------------------------------------------------------------------------------------


def test_what_is_behind_thin_smoke_that_comes_and_goes_is_seen():
    """All of the middle is always in the mask; the guess there is flat, and the wall is not."""
    drifting = np.stack([0.5 * np.roll(plume(1.0)[0], 9 * t, axis=1) for t in range(9)])
    frames, _, behind = pictures(drifting, wall(0.15))
    masks, guess = np.zeros((9, *SIZE), bool), behind.copy()
    masks[:, 10:54, 10:70] = True
    guess[10:54, 10:70] = 77
    found = behind_smoke(frames, masks, guess)
    inner = np.s_[14:50, 14:66]
    assert np.abs(found.astype(int) - behind)[inner].mean() < 0.3 * np.abs(guess.astype(int) - behind)[inner].mean()
    np.testing.assert_array_equal(found[:10], behind[:10])


def test_smoke_that_stands_is_not_taken_for_what_is_behind_it():
    standing = plume(0.8)[:1] * (1 + 0.05 * np.sin(np.arange(9)))[:, None, None]
    frames, fluid, behind = pictures(standing, np.full((*SIZE, 3), 0.1))
    found = behind_smoke(frames, fluid, behind)
    assert np.abs(found.astype(int) - behind).max() <= 3


def test_where_the_guess_is_seen_it_stays():
    frames, fluid, behind = pictures(plume(0.5), wall(0.2))
    fluid[0] = False
    assert behind_smoke(frames, fluid, behind) is behind


def test_smoke_counts_from_the_opacity_that_its_masks_go_to():
    opacities = np.rint(255 * plume(0.8)).astype(np.uint8)
    for bound in (0.05, 0.2, 0.5):
        assert shown_from(opacities, opacities > 255 * bound, 0.15) == pytest.approx(bound, abs=0.006)
    assert shown_from(opacities, np.zeros(opacities.shape, bool), 0.15) == 0.15
