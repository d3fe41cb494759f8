"""Water that goes on from what was found, and what only looks as restless."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from fluidlift.shape.evidence import gather_evidence
from fluidlift.shape.quiet_reaches import own_motion, pieces_that_go_on, step_of_colour, with_quiet_reaches
from fluidlift.types.clip import VideoClip
from fluidlift.types.flow import PixelFlow

FRAMES, HEIGHT, WIDTH = 24, 120, 160
ROWS, COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH]
LIVELY = (COLUMNS > 50) & (COLUMNS < 100)
"""a stream that runs down the picture"""
REACH = (COLUMNS >= 100) & (COLUMNS < 135) & (ROWS > 40) & (ROWS < 90)
"""a side channel of it"""
FERN = (COLUMNS <= 50) & (COLUMNS > 20) & (ROWS > 40) & (ROWS < 90)
NOTHING = np.zeros((HEIGHT, WIDTH), bool)
WATER, EARTH, LEAVES = np.array([70.0, 90.0, 110.0]), np.array([110.0, 105.0, 100.0]), np.array([60.0, 120.0, 40.0])


def smooth(rng, sigma):
    noise = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), sigma, mode="wrap")
    return (noise / noise.std())[..., None]


@pytest.fixture(scope="module", params=(0.0, 0.3))
def seen(request):
    """Evidence of a clip whose camera trembles by so many px."""
    rng = np.random.default_rng(5)
    ground, faint, strong, leaves = (smooth(rng, sigma) for sigma in (1.5, 2.0, 2.0, 1.5))
    sway = request.param * rng.normal(size=(FRAMES, 2))
    frames = np.empty((FRAMES, HEIGHT, WIDTH, 3))
    for t in range(FRAMES):
        here = EARTH + 12.0 * ground
        # ripples come and go about their place
        here[REACH] = (WATER + 6.0 * np.roll(faint, int(2 * np.sin(1.7 * t)), axis=1))[REACH]
        here[FERN] = (LEAVES + 12.0 * np.roll(leaves, int(6 * np.sin(1.3 * t)), axis=1))[FERN]
        here[LIVELY] = (WATER + 25.0 * np.roll(strong, 3 * t, axis=0))[LIVELY]
        frames[t] = shift(here, (*sway[t], 0.0), order=1, mode="nearest")
    frames += rng.normal(size=frames.shape)
    video = VideoClip(np.clip(frames, 0, 255).round().astype(np.uint8), np.arange(FRAMES) / 25.0)
    flow = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32)
    return gather_evidence(video, PixelFlow(flow, np.ones(flow.shape[:3], np.float32)))


def test_a_channel_of_the_same_colours_is_added_and_ground_is_not_though_the_camera_trembles(seen):
    found = with_quiet_reaches(seen, LIVELY, NOTHING)
    assert found[REACH].mean() > 0.8
    assert found[~(REACH | LIVELY)].mean() < 0.02
    assert found[LIVELY].all()


def test_what_moves_as_much_beyond_a_step_of_colour_is_no_water(seen):
    assert np.median(own_motion(seen, LIVELY)[FERN]) > np.median(own_motion(seen, LIVELY)[REACH]) - 0.3
    assert not with_quiet_reaches(seen, LIVELY, NOTHING)[FERN & (COLUMNS < 45)].any()


def test_the_tremble_of_the_camera_is_no_motion_of_the_ground(seen):
    motion = own_motion(seen, LIVELY)
    bank = (COLUMNS > 140) | (COLUMNS < 15)
    assert np.median(motion[REACH]) - np.median(motion[bank]) > 0.5


def test_what_is_barred_is_never_added_and_no_mask_or_a_whole_one_stays(seen):
    assert not with_quiet_reaches(seen, LIVELY, REACH)[REACH].any()
    assert with_quiet_reaches(seen, NOTHING, NOTHING) is NOTHING
    whole = ~NOTHING
    assert with_quiet_reaches(seen, whole, NOTHING) is whole


@pytest.mark.parametrize(("top", "white", "kept"), [
    (30, True, True),  # spray in the midst of a river
    (0, True, False),  # a sky over it
    (0, False, True),  # a fall that comes from above the picture
])  # fmt: skip
def test_what_water_surrounds_is_water_but_for_a_sky(top, white, kept):
    rng = np.random.default_rng(1)
    piece = (ROWS >= top) & (ROWS < 70) & (COLUMNS > 40) & (COLUMNS < 120)
    picture = np.broadcast_to(WATER, (HEIGHT, WIDTH, 3)) + 4.0 * rng.normal(size=(HEIGHT, WIDTH, 3))
    picture[piece] += 100.0 * white
    assert pieces_that_go_on(picture.astype(np.float32), piece, ~piece)[piece].mean() == pytest.approx(
        float(kept), abs=0.05
    )


def test_a_step_of_colour_is_told_in_units_of_what_colours_vary_by():
    rng = np.random.default_rng(2)
    left = COLUMNS < 80
    for spread, least, most in ((1.0, 3.0, 9.0), (20.0, 0.1, 0.7)):
        picture = spread * rng.normal(size=(HEIGHT, WIDTH, 3)) + np.where(left, 0.0, 10.0)[..., None]
        assert least < step_of_colour(picture, left, ~left) < most
    assert step_of_colour(np.zeros((HEIGHT, WIDTH, 3)), left, COLUMNS > 140) == np.inf, "they do not meet"
