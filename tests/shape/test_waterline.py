"""The edge of a stream whose waves run up its bank and leave it again."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.shape.frame_pictures import opponent
from fluidlift.shape.segment import segment
from fluidlift.shape.waterline import MISTAKEN, ShoreColours
from fluidlift.types.clip import VideoClip
from fluidlift.types.flow import PixelFlow

FRAMES, HEIGHT, WIDTH = 24, 120, 160
ROWS, COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH]
GROUND, WATER = np.array([125.0, 112.0, 98.0]), np.array([70.0, 105.0, 120.0])


def smooth(rng, sigma):
    noise = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), sigma, mode="wrap")
    return (noise / noise.std())[..., None]


def wet_at(t: int) -> np.ndarray:
    """A wave of 3 px either way runs along the upper bank."""
    return np.logical_and(ROWS >= 40 + 3 * np.sin(2 * np.pi * (COLUMNS / 80 - t / 12)), ROWS < 75)


def swash(ground=GROUND) -> tuple[VideoClip, PixelFlow, np.ndarray]:
    """Clip, its flow, and where there is water, bool [T,h,w]."""
    rng = np.random.default_rng(2)
    room, pattern = ground + 5.0 * smooth(rng, 2.0), smooth(rng, 3.0)
    wet = np.stack([wet_at(t) for t in range(FRAMES)])
    frames = np.empty((FRAMES, HEIGHT, WIDTH, 3))
    flow = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32)
    for t in range(FRAMES):
        frames[t] = np.where(wet[t][..., None], WATER + 15.0 * np.roll(pattern, 3 * t, axis=1), room)
    flow[wet[:-1], 0] = 3.0
    frames += rng.normal(size=frames.shape)
    video = VideoClip(np.clip(frames, 0, 255).round().astype(np.uint8), np.arange(FRAMES) / 25.0)
    return video, PixelFlow(flow, np.ones(flow.shape[:3], np.float32)), wet


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def test_the_edge_follows_the_waves_up_and_down_the_bank():
    video, flow, wet = swash()
    fluid = segment(video, flow).fluid
    ever = np.broadcast_to(wet.any(axis=0), wet.shape)
    assert overlap(ever, wet) < 0.94, "what was ever wet is much too large, or this tests nothing"
    assert overlap(fluid, wet) > 0.98
    assert 0.98 < fluid.sum() / wet.sum() < 1.02


def test_a_place_that_the_user_calls_fluid_stays_fluid_while_it_looks_dry():
    video, flow, wet = swash()
    row, column = 39, 60
    assert 0 < wet[:, row, column].sum() < FRAMES
    fluid = segment(video, flow, points=[(column + 0.5, row + 0.5, 1)]).fluid
    assert fluid[:, row, column].all()


@pytest.mark.parametrize(("ground", "tells"), [(GROUND, True), (WATER, False)])
def test_colours_tell_only_where_the_ground_does_not_look_like_the_water(ground, tells):
    video, _, wet = swash(ground)
    pictures = np.stack([opponent(frame) for frame in video.frames[::4]])
    region = np.asarray(wet.any(axis=0))
    colours = ShoreColours(pictures, region, np.zeros_like(region))
    strip = region & (ROWS < 43)
    assert (colours.tell[strip].mean() > 0.9) if tells else (colours.tell[strip].mean() < MISTAKEN)


def test_without_any_ground_around_the_fluid_no_colours_are_dry():
    video, _, _ = swash()
    everywhere = np.ones((HEIGHT, WIDTH), bool)
    colours = ShoreColours(video.frames[::4].astype(np.float32), everywhere, ~everywhere)
    assert (colours(video.frames[0].astype(np.float32)) > 0.0).mean() > 0.99
