"""Rocks that waves wash over: they change as the water does, and come back to one picture, as water never does."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, gaussian_filter

from fluidlift.shape.evidence import fluid_score, gather_evidence
from fluidlift.shape.intermittently_wet import most_often, washed_ground
from fluidlift.shape.segment import lasting_region, segment
from fluidlift.types.clip import Label, VideoClip
from fluidlift.types.flow import PixelFlow

FRAMES, HEIGHT, WIDTH = 30, 120, 192
ROWS, COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH]
BED = (ROWS >= 25) & (ROWS < 95)
ROCK = (ROWS - 60) ** 2 + (COLUMNS - 90) ** 2 < 14**2
STREAM = BED & ~ROCK
CORE = np.asarray(binary_erosion(ROCK, iterations=2), bool)
BROWN, BLUE, GREY = (122.0, 104.0, 82.0), (110.0, 130.0, 150.0), (125.0, 120.0, 116.0)


def smooth(rng, sigma):
    noise = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), sigma, mode="wrap")
    return noise / noise.std()


def covered(t: int) -> bool:
    """Whether a wave lies over the rock: two frames of five."""
    return t % 5 < 2


def clip(colour=GREY, *, washed: bool = True, flows: float = 4.0) -> tuple[VideoClip, PixelFlow]:
    """A blue stream to the right between brown banks, over a place of one colour that waves cover; flow sees these
    waves alone."""
    rng = np.random.default_rng(5)
    room = np.array(BROWN) + 6.0 * smooth(rng, 2.0)[..., None]
    stone = np.array(colour) + 5.0 * smooth(rng, 1.5)[..., None]
    pattern = smooth(rng, 1.5)
    frames = np.empty((FRAMES, HEIGHT, WIDTH, 3))
    flow = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32)
    for t in range(FRAMES):
        wet = BED if washed and covered(t) else STREAM
        frames[t] = np.where(ROCK[..., None], stone, room)
        frames[t][wet] = (np.array(BLUE) + 40.0 * np.roll(pattern, 4 * t, axis=1)[..., None])[wet]
    flow[:, BED, 0] = flows
    frames += rng.normal(size=frames.shape)
    video = VideoClip(np.clip(frames, 0, 255).round().astype(np.uint8), np.arange(FRAMES) * 0.04)
    return video, PixelFlow(flow, np.ones(flow.shape[:3], np.float32))


def region_of(video, flow):
    evidence = gather_evidence(video, flow)
    return evidence, lasting_region(evidence, fluid_score(evidence), np.ones((HEIGHT, WIDTH), bool))


def test_a_rock_comes_back_to_its_picture_and_a_stream_has_none():
    video, flow = clip()
    evidence = gather_evidence(video, flow)
    share, picture = most_often(evidence, np.exp(evidence.level) * evidence.noise, np.ones((HEIGHT, WIDTH), bool))
    assert abs(np.median(share[CORE]) - 0.6) < 0.05, "three frames of five"
    assert np.quantile(share[STREAM], 0.9) < 0.35
    bare = evidence.pictures[4].astype(np.float32)
    assert np.abs(picture - bare).sum(axis=-1)[CORE].mean() < 4.0, "grey levels, noise of two pictures"


def test_a_rock_is_water_only_while_a_wave_covers_it():
    video, flow = clip()
    region = region_of(video, flow)[1]
    assert region[ROCK].mean() > 0.9, "change alone takes it for water, or this tests nothing"
    labels = segment(video, flow).labels
    shown = [(labels[t][CORE] == Label.SOLID).mean() for t in range(FRAMES) if not covered(t)]
    hidden = [(labels[t][CORE] == Label.FLUID).mean() for t in range(FRAMES) if covered(t)]
    assert np.mean(shown) > 0.9
    assert np.mean(hidden) > 0.9
    assert (labels[:, STREAM] == Label.FLUID).mean() > 0.97


@pytest.mark.parametrize("made", [
    {"colour": BLUE},  # calm water keeps the water's colours
    {"flows": 0.0},  # nothing goes anywhere: a pool shows one picture for long
])  # fmt: skip
def test_nothing_is_taken_where_coming_back_says_nothing(made):
    evidence, region = region_of(*clip(**made))
    assert region[ROCK].mean() > 0.5
    assert washed_ground(evidence, region) is None
