"""Plants before a stream: they change as it does, without going, and look the same again and again."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, gaussian_filter, shift

from fluidlift.shape.evidence import fluid_score, gather_evidence
from fluidlift.shape.segment import lasting_region, segment
from fluidlift.shape.vegetation import coming_back, without_plants
from fluidlift.types.clip import VideoClip
from fluidlift.types.flow import PixelFlow

FRAMES, HEIGHT, WIDTH, INTERVAL = 30, 120, 192, 0.08
ROWS, COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH]
FERN = (ROWS >= 65) & (ROWS < 90) & (COLUMNS > 50) & (COLUMNS < 110)
BED = (ROWS >= 30) & (ROWS < 90) & ~FERN
BROWN, BLUE = (62.0, 70.0, 42.0), (60.0, 90.0, 130.0)


def smooth(rng, sigma):
    noise = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), sigma, mode="wrap")
    return noise / noise.std()


def clip(colour=BROWN, *, period: int = FRAMES) -> tuple[VideoClip, PixelFlow]:
    """A brown room, a blue stream to the right, and a fern at its lower bank that swings once a second; flow sees
    nothing there. All of it begins anew after `period` frames."""
    rng = np.random.default_rng(3)
    room = np.array(BROWN) + 6.0 * smooth(rng, 2.0)[..., None]
    pattern, leaves = smooth(rng, 1.0), smooth(rng, 1.2)
    frames = np.empty((FRAMES, HEIGHT, WIDTH, 3))
    for t in range(FRAMES):
        now = t % period
        swing = 4.0 * np.sin(2.0 * np.pi * INTERVAL * now)
        swung = shift(leaves, (0.3 * swing, swing), order=1, mode="wrap")
        frames[t] = room
        frames[t][BED] = (np.array(BLUE) + 25.0 * np.roll(pattern, 4 * now, axis=1)[..., None])[BED]
        frames[t][FERN] = (np.asarray(colour) + 40.0 * swung[..., None])[FERN]
    frames += rng.normal(size=frames.shape)
    flow = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32)
    flow[:, BED, 0] = 4.0
    video = VideoClip(np.clip(frames, 0, 255).round().astype(np.uint8), np.arange(FRAMES) * INTERVAL)
    return video, PixelFlow(flow, np.ones(flow.shape[:3], np.float32))


def cleared(video, flow, interval=INTERVAL):
    """What change alone takes for water, and the same without plants."""
    evidence = gather_evidence(video, flow)
    score = fluid_score(evidence)
    region = lasting_region(evidence, score, np.ones((HEIGHT, WIDTH), bool))
    return region, without_plants(evidence, score, region, interval)


def test_few_ways_to_move_bring_a_patch_back_and_a_stream_never_comes():
    back = coming_back(gather_evidence(*clip()), INTERVAL)
    fern, bed = (np.asarray(binary_erosion(place, iterations=5), bool) for place in (FERN, BED))
    assert np.quantile(back[fern], 0.9) < 0.4
    assert np.quantile(back[bed], 0.1) > 0.6


def test_a_fern_that_swings_is_no_water():
    video, flow = clip()
    region, kept = cleared(video, flow)
    assert region[FERN].mean() > 0.9, "change alone takes it for water, or this tests nothing"
    assert kept[FERN].mean() < 0.15
    assert kept[BED].mean() > 0.97
    fluid = segment(video, flow).fluid
    assert fluid[:, FERN].mean() < 0.15
    assert fluid[:, BED].mean() > 0.95


@pytest.mark.parametrize(("made", "interval"), [
    ({"colour": BLUE}, INTERVAL),  # water that rocks in a bay keeps the water's colours
    ({"period": 10}, INTERVAL),  # a clip that repeats itself: the stream comes back as well
    ({}, 0.04),  # too short to see anything come back
])  # fmt: skip
def test_nothing_is_taken_where_coming_back_says_nothing(made, interval):
    region, kept = cleared(*clip(**made), interval)
    assert region[FERN].mean() > 0.5
    np.testing.assert_array_equal(kept, region)
