"""The mask of water up to the horizon, on made seas: waves of deep water on a plane in perspective, and a beach."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.evaluate.images import mask_iou
from fluidlift.shape.evidence import gather_evidence
from fluidlift.shape.open_sea import lulls, reaching_over, sea_horizon, wave_odds, with_sea
from fluidlift.shape.segment import segment
from fluidlift.shape.view import OpenHorizon
from fluidlift.types.clip import Label, VideoClip
from fluidlift.types.flow import PixelFlow

FRAMES, HEIGHT, WIDTH = 20, 120, 200
FOCAL, FPS = 190.0, 25.0
"""px, frames per second"""
SKY = (190.0, 205.0, 225.0)
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH] + 0.5
POST = (np.abs(COLUMNS - 150) < 5) & (ROWS > 15) & (ROWS < 75)


def made_sea(*, eye=1.7, line=30.0, lean=0.0, shore=85.0, waves=24, slope=0.06, post=False, seed=0):
    """Frames, u8 [t,h,w,3], the water, bool [h,w], and px below the horizon, as seen from `eye` metres above it."""
    rng = np.random.default_rng(seed)
    depth = ROWS - (line + np.tan(np.radians(lean)) * (COLUMNS - WIDTH / 2))
    far = FOCAL * eye / np.maximum(depth, 0.3)
    across = far * (COLUMNS - WIDTH / 2) / FOCAL
    number = 2.0 * np.pi / np.exp(rng.uniform(np.log(0.4), np.log(8.0), waves))
    heading = rng.normal(-0.5 * np.pi, 0.5, waves)
    phase = rng.uniform(0.0, 2.0 * np.pi, waves)
    edge = shore + 6.0 * gaussian_filter(rng.normal(size=WIDTH), 15.0, mode="wrap") * 15.0**0.5
    sand = np.array([150.0, 130.0, 100.0])
    sand = sand + 25.0 * gaussian_filter(rng.normal(size=(HEIGHT, WIDTH, 1)), (1.0, 1.0, 0.0))
    water = (depth > 0) & (ROWS < edge)
    frames = np.empty((FRAMES, HEIGHT, WIDTH, 3))
    for t in range(FRAMES):
        tilt = np.zeros((HEIGHT, WIDTH))
        for k, angle, begin in zip(number, heading, phase, strict=True):
            kx, kz = k * np.cos(angle), k * np.sin(angle)
            seen = np.exp(-0.5 * ((kz * far / np.maximum(depth, 0.3)) ** 2 + (kx * far / FOCAL) ** 2))  # within a pixel
            tilt += seen * np.cos(kx * across + kz * far - np.sqrt(9.81 * k) * t / FPS + begin)
        light = slope * tilt * np.sqrt(2.0 / waves)
        frames[t] = np.array([60.0, 95.0, 120.0]) * (1.0 + 6.0 * light)[..., None]
        frames[t] = np.where((depth > 0)[..., None], frames[t], np.array(SKY) + 0.2 * depth[..., None])
        frames[t] = np.where((ROWS >= edge)[..., None], sand, frames[t])
        if post:
            frames[t][POST] = 30.0
    frames += rng.normal(0.0, 1.5, frames.shape)
    return np.clip(frames, 0, 255).round().astype(np.uint8), water & ~(POST & post), depth


def evidence_of(frames):
    video = VideoClip(frames, np.arange(FRAMES) / FPS)
    flow = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32)
    return video, PixelFlow(flow, np.zeros(flow.shape[:3], np.float32))


@pytest.fixture(scope="module")
def sea():
    return made_sea(post=True)


def test_the_mask_of_a_sea_reaches_its_horizon_and_ends_at_its_beach(sea):
    frames, water, depth = sea
    found = segment(*evidence_of(frames)).labels == Label.FLUID
    assert mask_iou(found[FRAMES // 2], water) > 0.9
    assert found[:, (depth > 1) & (depth < 8) & ~POST].mean() > 0.95, "far water, which hardly moves"
    assert found[:, ROWS > 105].mean() < 0.02, "sand"
    assert found[:, POST & (ROWS > 35) & (ROWS < 70) & (np.abs(COLUMNS - 150) < 3)].mean() < 0.1


@pytest.mark.parametrize("lean", [-4.0, 3.0])
def test_its_line_is_found_where_it_is(lean):
    frames, _, _ = made_sea(lean=lean, seed=2)
    horizon = sea_horizon(gather_evidence(*evidence_of(frames)))
    assert horizon is not None
    (_, left), (_, right) = horizon.ends
    rise = np.tan(np.radians(lean)) * WIDTH / 2
    assert left == pytest.approx(30.0 - rise, abs=2.0) and right == pytest.approx(30.0 + rise, abs=2.0)


def test_a_sea_without_a_beach_is_water_to_the_lower_edge():
    frames, water, _ = made_sea(shore=400.0, seed=3)
    found = segment(*evidence_of(frames)).labels[FRAMES // 2] == Label.FLUID
    assert mask_iou(found, water) > 0.95


def test_smooth_water_between_its_waves_and_its_horizon_is_water():
    """From a cliff of 16 m, waves of 8 m and less are within a pixel over half of the sea."""
    frames, water, depth = made_sea(eye=16.0, shore=400.0, line=40.0, seed=104)
    evidence = gather_evidence(*evidence_of(frames))
    found = with_sea(evidence, depth > 55, np.zeros_like(water), OpenHorizon(((0.0, 40.0), (WIDTH, 40.0)), 1.0))
    assert mask_iou(found, water) > 0.95


def test_depth_below_the_line():
    level = OpenHorizon(((0.0, 10.0), (40.0, 10.0)), 1.0)
    np.testing.assert_allclose(level.below((20, 40))[:, 0], np.arange(20) - 9.5)
    leaning = OpenHorizon(((0.0, 0.0), (40.0, 20.0)), 1.0)
    np.testing.assert_allclose(np.diag(leaning.below((20, 40))[:, ::2]), 0.25, atol=1e-12)
    np.testing.assert_allclose(leaning.below((40, 80))[1::2, 1::2], 2 * leaning.below((20, 40)) + 0.5 * (1 - 0.5))


def test_what_reaches_above_the_horizon_is_no_wave():
    horizon = OpenHorizon(((0.0, 30.0), (WIDTH, 30.0)), 1.0)
    person = (np.abs(COLUMNS - 50) < 4) & (ROWS > 25) & (ROWS < 80)
    crest = (np.abs(ROWS - 60) < 3) & (COLUMNS > 80)
    np.testing.assert_array_equal(reaching_over(person | crest, horizon), person)


def test_stillness_tells_sand_near_the_viewer_and_nothing_at_the_horizon():
    depth = np.broadcast_to(ROWS - 30.0, ROWS.shape)
    moving = (depth > 20) & (depth < 40)
    wander = np.log(np.where(moving, 0.02 * depth, 0.02) + 0.2)
    odds = wave_odds(wander, depth, moving, np.full(depth.shape, 0.1))
    assert (odds[depth > 60] < -1.0).all()
    assert (np.abs(odds[(depth > 0) & (depth < 3)]) < 0.5).all()
    assert (odds[(depth > 30) & moving] > 0.5).all()
    smooth = wave_odds(wander, depth, moving, np.full(depth.shape, 2.0))
    assert (smooth == 0.0).all(), "without texture stillness is not seen"


def test_nothing_above_the_line_is_kept(sea):
    frames, _, depth = sea
    evidence = gather_evidence(*evidence_of(frames))
    clouds = (ROWS < 10) & (COLUMNS < 60)
    horizon = OpenHorizon(((0.0, 30.0), (WIDTH, 30.0)), 1.0)
    found = with_sea(evidence, clouds | ((depth > 20) & (depth < 40)), np.zeros_like(clouds), horizon)
    assert not found[depth < 0].any() and found.any()
    assert not with_sea(evidence, clouds, np.zeros_like(clouds), horizon).any(), "without moving water there is none"


def test_a_lull_among_waves_is_water_and_a_rock_is_not(sea):
    frames, water, depth = sea
    picture = gather_evidence(*evidence_of(frames)).typical.copy()
    lull = (np.hypot(ROWS - 65, COLUMNS - 60) < 5) & water
    rock = (np.hypot(ROWS - 65, COLUMNS - 100) < 5) & water
    picture[rock] = [40.0, 30.0, -20.0]
    kept = water & ~lull & ~rock
    found = lulls(picture, kept, (depth > 0) & ~kept, np.zeros_like(lull))
    np.testing.assert_array_equal(found, lull)
