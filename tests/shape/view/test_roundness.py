"""Level circles and the ellipses that they are seen as: the view's angle back from them."""

import cv2
import numpy as np
import pytest

from fluidlift.shape.kind import estimate_up, level_camera
from fluidlift.shape.view import look_at
from fluidlift.shape.view.rims import find_rims
from fluidlift.shape.view.roundness import Ellipse, fit_ellipse, out_of_round, round_pool, roundness_evidence, wide_part
from fluidlift.types import PinholeCamera, UpEvidence
from fluidlift.types.kind import POUR, STREAM

SIZE = (320, 240)
CAMERA = PinholeCamera.from_fov(50.0, SIZE)
PITCHES = np.arange(2.0, 89.0, 1.0)
BLACK = np.zeros((*SIZE[::-1], 3), np.uint8)
ROW, COL = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5


def tilted(pitch, roll=0.0):
    return level_camera(CAMERA, UpEvidence(pitch, roll, "", 1.0))


def ring(pitch, roll=0.0, radius=0.3, off=0.0, count=720):
    """px, outline of a level circle in the middle of the view, a distance of 1.2 away; moved aside by `off`."""
    camera = tilted(pitch, roll)
    middle = 1.2 * camera.rays(np.array([[SIZE[0] / 2 + off, SIZE[1] / 2]]))[0]
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    circle = middle + radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], -1)
    return camera.project(circle)[0]


def disc(*args, **options):
    picture = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillPoly(picture, [np.round(ring(*args, **options) * 16 - 8).astype(np.int32)], 1, cv2.LINE_8, 4)
    return picture > 0


def likeliest(ellipses):
    log = np.array([roundness_evidence(tilted(p), ellipses) for p in PITCHES])
    return PITCHES[np.argmax(log)]


def cup(pitch, roll=0.0, hidden=0.0, seed=2):
    """A white rim with dark coffee in it, on a wooden table; a share of the rim is hidden from its right end on."""
    rng = np.random.default_rng(seed)
    picture = cv2.GaussianBlur(rng.uniform(60, 120, (*SIZE[::-1], 3)).astype(np.float32), (0, 0), 2.0)
    for radius, value in ((0.3, 225), (0.27, 45)):
        cv2.fillPoly(
            picture, [np.round(ring(pitch, roll, radius) * 16 - 8).astype(np.int32)], (value,) * 3, cv2.LINE_AA, 4
        )
    if hidden:
        u, v = ring(pitch, roll, 0.35, count=100)[: round(100 * hidden)].T
        cv2.fillPoly(
            picture,
            [np.stack([np.append(u, SIZE[0] / 2), np.append(v, SIZE[1] / 2)], -1).astype(np.int32)],
            (90, 80, 70),
        )
    return np.clip(picture, 0, 255).astype(np.uint8)


def test_the_ellipse_of_an_ellipse_is_itself():
    found = fit_ellipse(((COL - 160) / 50) ** 2 + ((ROW - 120) / 30) ** 2 < 1)
    assert found is not None
    assert found.flatness == pytest.approx(0.6, abs=0.01)  # pixels at the rim
    assert found.axes == pytest.approx((50.0, 30.0), abs=0.5)
    assert found.likeness > 0.98


def test_nothing_and_a_line_have_no_ellipse():
    assert fit_ellipse(np.zeros(SIZE[::-1], bool)) is None
    assert fit_ellipse(ROW == 100.5) is None


@pytest.mark.parametrize("off", [0.0, -60.0])
@pytest.mark.parametrize("pitch", [20.0, 35.0, 55.0, 75.0])
def test_a_circle_is_round_under_the_camera_that_saw_it(pitch, off):
    """In the middle of the picture and beside it, where perspective leans its ellipse."""
    found = fit_ellipse(disc(pitch, off=off))
    assert found is not None
    assert out_of_round(tilted(pitch), found) < 0.03  # of the logarithm: 3 %, half a pixel of the flattest
    assert out_of_round(tilted(pitch - 10.0), found) > 0.05
    assert likeliest([found]) == pytest.approx(pitch, abs=2.0 if pitch < 60 else 5.0)  # d sin(p) goes to 0 at 90


def test_roll_leans_the_ellipse():
    found = fit_ellipse(disc(35.0, roll=5.0))
    assert found is not None
    assert out_of_round(tilted(35.0, 5.0), found) < 0.03 < out_of_round(tilted(35.0, -5.0), found)


def test_what_stands_above_the_horizon_is_no_level_circle():
    ellipse = Ellipse((160.0, 20.0), np.diag([400.0, 100.0]), 1.0)
    assert np.isinf(out_of_round(tilted(0.0), ellipse))
    assert np.isfinite(out_of_round(tilted(40.0), ellipse))


def test_what_is_none_of_a_circle_cannot_rule_anything_out():
    found = fit_ellipse(disc(35.0))
    log = np.array([roundness_evidence(tilted(p), [found]) for p in PITCHES])
    assert 1.0 < log.max() - log.min() < 7.0  # a factor of 1000 at most


def test_three_rims_of_one_cup_say_more_than_one_but_not_three_times_as_much():
    found = fit_ellipse(disc(35.0))
    one, three = (np.ptp([roundness_evidence(tilted(p), [found] * n) for p in PITCHES]) for n in (1, 3))
    assert one < three < 2.0 * one


def test_a_pool_that_the_picture_cuts_or_that_leans_is_not_taken_for_a_circle():
    assert round_pool(disc(35.0)) is not None
    assert round_pool(((COL - 160) / 200) ** 2 + ((ROW - 230) / 120) ** 2 < 1) is None
    along, across = (COL - 160) * 0.8 + (ROW - 120) * 0.6, (ROW - 120) * 0.8 - (COL - 160) * 0.6
    assert round_pool((along / 80) ** 2 + (across / 30) ** 2 < 1) is None
    assert round_pool((np.abs(COL - 160) < 90) & (np.abs(ROW - 120) < 40)) is None  # a rectangle


def test_what_is_taller_than_wide_is_no_level_circle():
    """What a glass holds, seen from the side, with its corners rounded."""
    tall, flat = (((COL - 160) / 60) ** 2 + ((ROW - 120) / half) ** 2 < 1 for half in (67, 58))
    assert round_pool(tall) is None
    assert round_pool(flat) is not None


@pytest.mark.parametrize("pitch", [25.0, 40.0])
def test_the_pool_below_a_jet_is_what_is_wide(pitch):
    pool, jet = disc(pitch), (np.abs(COL - 150) < 8) & (ROW < 120)
    kept = wide_part(pool | jet)
    assert (kept & pool).sum() > 0.97 * pool.sum()
    assert not kept[:20].any()
    down = np.zeros((*SIZE[::-1], 2))
    seen = look_at(POUR, BLACK, pool | jet, pool | jet)
    up = estimate_up("pour", pool | jet, down, 0.0 * ROW, CAMERA, seen)
    assert up.pitch == pytest.approx(pitch, abs=8.0)
    glass = (np.abs(COL - 150) < 60) & (ROW > 70) & (ROW < 200)  # from beside
    assert look_at(POUR, BLACK, glass | jet, glass | jet).pool is None


@pytest.mark.parametrize("pitch", [20.0, 40.0, 65.0])
def test_the_rim_of_a_cup_is_found_and_shows_the_tilt(pitch):
    rims = find_rims(cup(pitch))
    assert 1 <= len(rims) <= 4
    assert likeliest(rims) == pytest.approx(pitch, abs=4.0 if pitch < 60 else 8.0)  # thickness of the rim


def test_a_rim_behind_a_jug_is_found():
    rims = find_rims(cup(40.0, hidden=0.15))
    assert rims and likeliest(rims) == pytest.approx(40.0, abs=5.0)


@pytest.mark.parametrize(("first", "last"), [(0, 190), (115, 320)])
def test_a_rim_that_the_pictures_edge_cuts_is_found(first, last):
    (found, *_) = find_rims(np.ascontiguousarray(cup(40.0)[:, first:last]))
    (whole, *_) = find_rims(cup(40.0))
    assert found.center == pytest.approx((whole.center[0] - first, whole.center[1]), abs=3.0)
    assert found.axes == pytest.approx(whole.axes, rel=0.05)


def test_a_dark_cup_beside_a_bright_window_is_found():
    dim = np.repeat((20 + 0.1 * cup(40.0)[..., :1]).astype(np.uint8), 3, 2)
    window = cv2.GaussianBlur(np.random.default_rng(2).normal(size=(SIZE[1], 40)).astype(np.float32), (0, 0), 6.0)
    dim[:, -40:] = np.clip(128 + 60 * window / window.std(), 0, 255)[..., None]
    rims = find_rims(dim)
    assert rims and likeliest(rims[:1]) == pytest.approx(40.0, abs=5.0)


def test_two_waves_are_no_rim():
    """Crests that bend towards each other at their ends, 8 px apart."""
    picture = cv2.GaussianBlur(np.random.default_rng(3).uniform(90, 110, SIZE[::-1]).astype(np.float32), (0, 0), 2.0)
    cv2.ellipse(picture, (160, 120), (90, 8), 0.0, 0.0, 360.0, 200.0, 2, cv2.LINE_AA)
    assert find_rims(np.repeat(picture[..., None], 3, 2).astype(np.uint8)) == ()


@pytest.mark.parametrize("seed", range(6))
def test_texture_and_a_box_have_no_rims(seed):
    rng = np.random.default_rng(seed)
    picture = cv2.GaussianBlur(rng.uniform(0, 255, (*SIZE[::-1], 3)).astype(np.float32), (0, 0), 1.0 + seed)
    picture = np.clip(128 + 3.0 * (picture - picture.mean()), 0, 255).astype(np.uint8)
    assert find_rims(picture) == ()
    cv2.rectangle(picture, (60, 80), (260, 180), (250, 250, 250), -1)
    assert find_rims(picture) == ()


@pytest.mark.parametrize("pitch", [30.0, 45.0, 60.0])
def test_liquid_in_a_cup_is_looked_down_on_whatever_it_stirs(pitch):
    picture, coffee = cup(pitch), disc(pitch, radius=0.26)
    swirl = 3.0 * np.stack([-(ROW - 120) / 60, (COL - 160) / 60], -1)
    seen = look_at(STREAM, picture, coffee, coffee)
    assert seen.contained and seen.waterline is None
    up = estimate_up("stream", coffee, swirl, coffee.astype(float), CAMERA, seen)
    assert up.pitch == pytest.approx(pitch, abs=6.0)
    assert up.error < 12.0
    assert "roundness of the pool" in up.source and "perspective of the flow" not in up.source


def test_a_pour_into_a_cup_that_is_seen_from_above_is_not_filmed_from_beside():
    jet = (np.abs(COL - 160) < 6) & (ROW < 120)
    down = np.zeros((*SIZE[::-1], 2))
    down[..., 1] = 5.0
    up = estimate_up("pour", jet, down, jet.astype(float), CAMERA, look_at(POUR, cup(40.0), jet, jet))
    assert up.pitch == pytest.approx(40.0, abs=5.0)
    assert "rims of vessels" in up.source


def test_a_flat_pool_says_more_than_one_that_is_seen_from_high_above():
    low, high = (
        estimate_up(
            "stream",
            d,
            np.zeros((*SIZE[::-1], 2)),
            0.0 * ROW,
            CAMERA,
            look_at(STREAM, BLACK, d, d),
        )
        for d in (disc(25.0), disc(65.0))
    )
    assert low.error < 0.7 * high.error
    assert low.pitch < 35.0 and high.pitch > 50.0
