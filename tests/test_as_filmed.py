"""The card: a re-simulation that is the clip itself holds, and each way to go wrong shows in the figure made for it."""

import json

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.evaluate.as_filmed import (
    FEWEST,
    GOOD,
    USABLE,
    VERDICTS,
    WRONG,
    AsFilmed,
    Likeness,
    as_filmed,
    with_certainty,
)
from fluidlift.evaluate.film import growth, mean_flow, mean_flows
from fluidlift.motion.optical_flow import DenseInverseSearch

T, H, W = 48, 64, 96
INTERVAL = 0.04
SPEED = 2
"""px/frame, to the right"""
LIFE = 5.0
"""frames, after which a pattern has been replaced by another"""
STREAM = slice(20, 52)
"""rows that are water"""


def pattern(frames: int, life: float, seed: int = 0) -> np.ndarray:
    """[T,H,W] of unit variance, with grains of a few px, that changes within `life` frames and repeats after them."""
    noise = np.random.default_rng(seed).standard_normal((frames, H, W))
    smooth = ndimage.gaussian_filter(noise, (life, 1.3, 1.3), mode="wrap") if life else noise[:1].repeat(frames, 0)
    smooth = smooth if life else ndimage.gaussian_filter(smooth, (0, 1.3, 1.3), mode="wrap")
    return smooth / smooth.std()


def film(life: float = LIFE, speed: int = SPEED, seed: int = 0) -> np.ndarray:
    """u8 [T,H,W,3]: water between still banks; `life` 0: a wallpaper that only moves."""
    moved = np.stack([np.roll(p, speed * t, axis=1) for t, p in enumerate(pattern(T, life, seed))])
    shade = 110 + 25 * np.sin(np.arange(W) / 11.0) + 12 * np.cos(np.arange(H) / 5.0)[:, None]
    bank = 90 + 20 * pattern(1, 0.0, 7)[0]
    grey = np.repeat(bank[None], T, axis=0)
    grey[:, STREAM] = (shade + 20 * moved)[:, STREAM]
    return np.clip(grey[..., None] * [0.9, 1.0, 1.1], 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def clip() -> np.ndarray:
    return film()


@pytest.fixture(scope="module")
def masks() -> np.ndarray:
    found = np.zeros((T, H, W), bool)
    found[:, STREAM] = True
    return found


def held(clip, masks, renders, coverage=None) -> AsFilmed:
    return as_filmed(clip, masks, INTERVAL, renders, masks if coverage is None else coverage)


def test_waves_over_water_that_stays_are_no_current(clip, masks):
    card = as_filmed(clip, masks, INTERVAL, clip[::-1], masks, runs=False)
    assert held(clip, masks, clip[::-1]).verdict == WRONG, "all of it runs backwards"
    for key in ("current_error", "current_cosine"):
        assert card[key].value is None and card[key].verdict is None and "waves" in card[key].note
    assert card.verdict != WRONG


def test_water_that_stays_and_is_missing_is_advised_on_without_frames_after_the_clip(clip, masks):
    half = masks.copy()
    half[:, :, : W // 2] = False
    card = as_filmed(clip, masks, INTERVAL, clip, half, runs=False)
    assert card["level"].verdict == WRONG and "missing" in card.advice[0]


def test_the_clip_itself_is_good_and_equal_in_every_figure(clip, masks):
    card = held(clip, masks, clip)
    assert card.verdict == GOOD and card.warning() is None and card.advice == ()
    for key in ("level", "liveliness", "crispness_0", "crispness_3", "along_0.2", "along_0.5", "current_cosine"):
        assert card[key].value == pytest.approx(1.0, abs=1e-4)  # stored with four digits
    for key in ("mean", "ring", "flooded", "missing", "colours", "current_error"):
        assert card[key].value == pytest.approx(0.0, abs=1e-6)


def test_the_same_film_half_a_clip_later_is_good(clip, masks):
    card = held(clip, masks, np.roll(clip, T // 2, axis=0))
    assert card.verdict == GOOD, card.rows()
    assert card["mean"].value == pytest.approx(0.0, abs=1e-6)  # the same frames in another order


def test_another_film_of_the_same_water_is_good(masks):
    card = held(film(seed=0), masks, film(seed=1))
    assert card.verdict == GOOD, card.rows()


def test_a_frozen_still_does_not_live(clip, masks):
    card = held(clip, masks, clip[:1].repeat(T, axis=0))
    assert card["liveliness"].value == pytest.approx(0.0, abs=1e-6)
    assert card["liveliness"].verdict == WRONG and card.verdict == WRONG
    assert card["along_0.5"].value is None  # what never changes cannot be followed
    assert "liveliness" in card.warning() and card.advice


def test_a_wallpaper_that_only_moves_is_found_again_downstream_and_water_is_not(clip, masks):
    card = held(clip, masks, film(life=0.0))
    # after 0.5 s, 12 frames, a pattern that lives for 5 is gone: its correlation is exp(-(12 / 5)^2 / 4) = 0.24
    assert card["along_0.5"].value > 2.0
    assert card["along_1"].value is None  # after 1 s the clip's own is no number to divide by
    assert card["current_cosine"].verdict == GOOD


def test_water_on_its_banks_shows_in_level_and_ring(clip, masks):
    wide = masks.copy()
    wide[:, 12:60] = True
    flooded = clip.copy()
    flooded[:, 12:60] = clip[:, 20:44].repeat(2, axis=1)
    card = held(clip, masks, flooded, wide)
    assert card["level"].value == pytest.approx(32 / 48, abs=1e-3)  # rows of water over those that are covered
    assert card["flooded"].value == pytest.approx(1.0) and card["missing"].value == 0.0
    assert card["level"].verdict == WRONG and card["ring"].verdict == WRONG
    assert any("none was filmed" in text for text in card.advice)


def test_what_a_frame_of_the_clip_did_not_see_is_no_fluid_too_much(clip, masks):
    seen = np.ones(masks.shape, bool)
    seen[T // 2 :, :, : W // 3] = False  # the camera looked further to the right
    known = masks & seen
    card = as_filmed(clip, known, INTERVAL, clip, masks, seen=seen)
    assert card["level"].value == pytest.approx(1.0) and card["level"].floor == pytest.approx(1.0)
    blind = as_filmed(clip, known, INTERVAL, clip, masks)
    assert blind["level"].value == pytest.approx(2 / 3, abs=0.01) and blind["level"].verdict == WRONG


def test_water_that_ran_dry_is_missing(clip, masks):
    gone = masks.copy()
    gone[2 * T // 3 :] = False
    card = held(clip, masks, clip, gone)
    assert card["level"].value == 0.0 and card["missing"].value == 1.0
    assert any("missing where it was filmed" in text for text in card.advice)


def test_a_blurred_film_is_not_crisp(clip, masks):
    card = held(clip, masks, np.stack([ndimage.gaussian_filter(f, (1.5, 1.5, 0)) for f in clip]))
    assert card["crispness_0"].value < 0.5 and card["crispness_0"].verdict == WRONG
    assert card["crispness_0"].value < card["crispness_3"].value  # blur takes the fine first


def test_a_current_that_runs_back_has_a_cosine_of_minus_one(clip, masks):
    card = held(clip, masks, clip[:, :, ::-1])
    # flow at the picture's edges, where the pattern comes in, is not measured to a tenth
    assert card["current_cosine"].value == pytest.approx(-1.0, abs=0.05)
    assert card["current_error"].value == pytest.approx(2.0, abs=0.2)
    assert any("another way" in text for text in card.advice)


def test_a_current_too_slow_for_optical_flow_is_not_judged(masks):
    still = film(speed=0)
    card = held(still, masks, still)
    assert card["current_error"].value is None and card["current_error"].verdict is None
    assert "not judged" in card["current_error"].note
    assert card.verdict == GOOD


def test_frames_after_the_end_are_held_against_what_the_clip_is_like(clip, masks):
    later = np.concatenate([clip, clip[:1].repeat(T, axis=0)])
    card = held(clip, masks, later, np.concatenate([masks, masks]))
    assert (card.frames, card.beyond) == (T, T)
    assert card["liveliness"].value == pytest.approx(1.0, abs=1e-4)
    assert card["liveliness"].beyond == pytest.approx(0.0, abs=1e-6)
    assert card["liveliness"].verdict == WRONG and card["level"].beyond == 1.0


def test_a_front_that_moves_is_compared_at_the_same_time_and_only_there(clip, masks):
    advancing = masks & (np.arange(W) < 2 * np.arange(T)[:, None])[:, None]
    ahead = masks & (np.arange(W) < 2 * np.arange(T)[:, None] + 40)[:, None]
    wet = np.where(advancing[..., None], clip, 60)
    card = as_filmed(wet, advancing, INTERVAL, np.concatenate([wet, wet]), np.concatenate([advancing, advancing]))
    assert card.verdict == GOOD and card.beyond == 0 and card["level"].floor is None and card.notes
    assert held(wet, advancing, wet, ahead)["level"].verdict == WRONG


def test_fluid_of_a_few_pixels_gives_no_number(clip):
    few = np.zeros((T, H, W), bool)
    few[:, 30:35, 30:35] = True
    card = held(clip, few, clip)
    assert card["mean"].value is None and card["mean"].verdict is None


def test_films_that_are_too_short_or_of_another_size_are_refused(clip, masks):
    with pytest.raises(ValueError, match=f"{FEWEST} or more"):
        held(clip[: FEWEST - 1], masks[: FEWEST - 1], clip[: FEWEST - 1])
    with pytest.raises(ValueError, match="pictures of the clip"):
        as_filmed(clip, masks, INTERVAL, clip[:, ::2], masks[:, ::2])


@pytest.mark.parametrize(
    ("key", "value", "floor", "verdict"),
    [
        ("level", 0.95, 0.99, GOOD), ("level", 0.92, 0.91, GOOD), ("level", 0.92, 0.99, USABLE),
        ("level", 0.87, 0.5, WRONG), ("mean", 9.0, 6.0, GOOD), ("mean", 14.0, 6.0, USABLE), ("mean", 14.1, 6.0, WRONG),
        ("ring", 2.0, 0.0, GOOD), ("ring", 9.0, None, None), ("ring", 5.1, 0.0, WRONG),
        ("crispness_0", 1.2, 1.0, USABLE),
        ("crispness_0", 0.74, 1.0, WRONG), ("liveliness", 1.3, 1.0, USABLE), ("liveliness", 1.31, 1.0, WRONG),
        ("current_error", 0.5, 0.0, USABLE), ("current_cosine", 0.84, 1.0, WRONG), ("foam", 0.0, 1.0, None),
        ("current_error", 0.6, 0.59, WRONG), ("current_error", 0.6, 0.61, USABLE), ("current_error", 0.3, 0.9, USABLE),
        ("current_error", 1.1, 1.4, WRONG), ("current_cosine", 0.61, 0.6, USABLE), ("current_cosine", 0.59, 0.6, WRONG),
        ("current_cosine", -0.1, -0.5, WRONG), ("current_cosine", 0.84, None, WRONG),
        ("level", None, 1.0, None),
    ],
)  # fmt: skip
def test_the_limits_are_those_that_the_documents_tell(key, value, floor, verdict):
    from fluidlift.evaluate.as_filmed import _judged

    assert _judged(key, value, floor) == verdict


def test_a_clip_that_does_not_agree_with_itself_on_its_current_fails_none_that_is_as_unlike(masks):
    """A clip whose first third runs slower: nothing can be nearer to its last third than that without repeating it."""
    fast, slow = film(), film(speed=SPEED // 2)
    third = len(fast) // 3
    surging = np.concatenate([slow[:third], fast[third:]])
    floor = held(surging, masks, surging)["current_error"].floor
    assert floor == pytest.approx(0.5, abs=0.1)
    assert held(surging, masks, surging)["current_error"].value == pytest.approx(0.0, abs=1e-3)
    assert held(fast, masks, fast)["current_error"].floor < 0.1


def test_a_card_comes_back_from_json_as_it_was(clip, masks):
    card = held(clip, masks, np.concatenate([clip, clip]), np.concatenate([masks, masks]))
    assert AsFilmed.from_dict(json.loads(json.dumps(card.to_dict(), allow_nan=False))) == card


def test_the_verdict_is_the_worst_of_those_that_are_judged():
    figures = [Likeness(k, k, 1.0, verdict=v) for k, v in (("a", GOOD), ("b", None), ("c", USABLE))]
    assert AsFilmed(9, 0, tuple(figures)).verdict == USABLE
    assert AsFilmed(9, 0, (figures[1],)).verdict is None
    assert AsFilmed(9, 0, (figures[1],)).sentence().startswith("as filmed: not judged")
    assert VERDICTS[-1] == WRONG


def test_what_is_rather_wrong_than_right_makes_no_asset_good():
    card = AsFilmed(9, 0, (Likeness("level", "level", 0.99, verdict=GOOD),))
    sure = with_certainty(card, {"mask": 0.9, "kind": 0.6})
    assert sure.verdict == GOOD and sure.advice == () and sure["right_kind"].value == 0.6
    assert sure.sentence() == "as filmed: good (level 0.99)"  # of what is well nothing more is said
    doubted = with_certainty(card, {"mask": 0.3, "kind": 0.6, "tilt": 0.2})
    assert doubted.verdict == USABLE and doubted.warning() is None
    assert doubted.sentence().startswith("as filmed: usable (chance that the mask is right 0.30; chance that the tilt")
    assert len(doubted.advice) == 2 and "--pitch" in doubted.advice[1]
    bad = AsFilmed(9, 0, (Likeness("level", "level", 0.2, verdict=WRONG),))
    assert with_certainty(bad, {"mask": 0.9}).verdict == WRONG
    unmeasured = AsFilmed(9, 0, (Likeness("level", "level", None),))
    assert with_certainty(unmeasured, {"mask": 0.9}).verdict is None  # nothing was held against the clip


def filling(frames: int, first: float, last: float) -> np.ndarray:
    """[frames,H,W]: the row of the surface goes from `first` to `last`, each filled from the left to the right."""
    rows = np.linspace(first, last, frames)[:, None, None]
    place = np.arange(H)[:, None] + 1.0 - np.arange(W) / W
    return (place > rows) & (np.arange(H) < STREAM.stop)[:, None]


@pytest.mark.parametrize(("first", "last", "judged"), [(24, 16, 0), (16, 24, 0), (21, 20, 50)])
def test_a_vessel_that_goes_on_to_fill_is_not_held_against_how_full_it_was(clip, first, last, judged):
    fills = filling(3 * T, first, first + 3 * (last - first))
    card = as_filmed(clip, fills[:T], INTERVAL, np.concatenate([clip] * 3), fills, fills=True)
    assert as_filmed(clip, fills[:T], INTERVAL, np.concatenate([clip] * 3), fills).beyond == 2 * T, "a fall in the wind"
    assert abs(card.beyond - judged) <= 2 and "steadily" in card.notes[0]
    assert card["level"].verdict == GOOD


@pytest.mark.parametrize("seed", range(5))
def test_a_vessel_fills_though_the_jet_above_it_sways(seed):
    frames, rng = 36, np.random.default_rng(seed)
    fills, still = filling(frames, 20, 19.5), filling(frames, 20, 20)
    jet = np.zeros_like(fills)
    for t, wide in enumerate(np.abs(rng.normal(0.0, 10.0, frames)).round().astype(int)):
        jet[t, :2, :wide] = True
    areas = (fills | jet).sum(axis=(1, 2))
    assert np.corrcoef(np.arange(frames), areas)[0, 1] ** 2 < 0.8, "a straight line does not explain most of it"
    assert growth(fills | jet) == pytest.approx(growth(fills), rel=0.5)
    assert growth(still | jet) == 0.0


@pytest.mark.parametrize("grows", [True, False])
def test_a_vessel_fills_though_it_begins_late_and_one_that_settles_again_does_not(grows):
    frames, late = 36, 20
    rows = 22 - np.concatenate([np.linspace(0, -0.5, late), np.linspace(0, 7, frames - late)])  # a jet gets thinner
    if not grows:  # up and down again, higher in the second half on the whole
        rows = 20 - 3 * np.sin(np.pi * np.clip((np.arange(frames) - 12) / 24, 0, 1))
    masks = np.concatenate([filling(1, row, row) for row in rows])
    assert (growth(masks) > 0) == grows


def test_a_level_that_goes_up_and_down_is_held_to_its_mean_after_the_clip():
    clip, rows = film(), (20 + 3 * np.sin(np.linspace(0, 2 * np.pi, T))).round().astype(int)
    waves = np.stack([filling(1, row, row)[0] for row in rows])
    card = as_filmed(clip, waves, INTERVAL, np.concatenate([clip] * 3), np.concatenate([waves] * 3), fills=True)
    assert card.beyond == 2 * T and card.notes == ()


def test_each_pair_of_a_clip_is_measured_once_for_all_its_parts(clip, masks, monkeypatch):
    frames, measured, plain = clip[:24], [], DenseInverseSearch.displacement

    def counted(self, first, second):
        measured.append(first.tobytes())
        return plain(self, first, second)

    monkeypatch.setattr(DenseInverseSearch, "displacement", counted)
    parts = [list(range(16, 23)), list(range(11)), list(range(12, 23)), list(range(7))]
    flows = mean_flows(frames, masks, parts)
    assert len(measured) == len(set(measured)) == len({t for part in parts for t in part})
    for part, flow in zip(parts, flows):
        alone = mean_flow(frames[part[0] :], masks[part[0] :], [t - part[0] for t in part])
        np.testing.assert_array_equal(flow, alone)
