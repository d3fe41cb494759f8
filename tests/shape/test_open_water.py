"""Quiet water beside the moving water of a wide fluid."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.shape.evidence import gather_evidence
from fluidlift.shape.open_water import holes, is_part_of_all, large_pieces, log_wander, with_open_water
from fluidlift.types.clip import VideoClip
from fluidlift.types.flow import PixelFlow

FRAMES, HEIGHT, WIDTH = 20, 120, 160
ROWS, COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH]
QUIET = (ROWS >= 45) & (ROWS < 70)
LIVELY = ROWS >= 70
FAR = ROWS >= 53
"""from the bank, by what wander is pooled over in so small a picture"""
NARROW = (COLUMNS > 70) & (COLUMNS < 130)
STONE = (ROWS - 95) ** 2 + (COLUMNS - 80) ** 2 < 8**2


def smooth(rng, sigma):
    noise = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), sigma, mode="wrap")
    return (noise / noise.std())[..., None]


@pytest.fixture(scope="module")
def seen():
    """Evidence of a clip: ground above, water that hardly changes but drifts, lively water below, and a stone in it."""

    def evidence(*, drift: int = 1, tremble: int = 0, near: float = 4.0, narrow: bool = False):
        rng = np.random.default_rng(3)
        ground = np.array([110.0, 105.0, 100.0]) + 12.0 * smooth(rng, 1.5)
        faint = smooth(rng, 2.0)
        strong = np.where((ROWS > 95)[..., None], smooth(rng, near), smooth(rng, 2.0))
        frames = np.empty((FRAMES, HEIGHT, WIDTH, 3))
        for t in range(FRAMES):
            frames[t] = np.roll(ground, tremble * (t % 5), axis=1)
            quiet, lively = (x & (NARROW | (not narrow)) for x in (QUIET, LIVELY & ~STONE))
            frames[t][quiet] = (np.array([70.0, 90.0, 110.0]) + 4.0 * np.roll(faint, drift * t, axis=1))[quiet]
            frames[t][lively] = (np.array([70.0, 90.0, 110.0]) + 25.0 * np.roll(strong, 3 * t, axis=1))[lively]
        frames += rng.normal(size=frames.shape)
        video = VideoClip(np.clip(frames, 0, 255).round().astype(np.uint8), np.arange(FRAMES) / 25.0)
        flow = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32)
        return gather_evidence(video, PixelFlow(flow, np.ones(flow.shape[:3], np.float32)))

    return evidence


NOTHING = np.zeros((HEIGHT, WIDTH), bool)


def test_quiet_water_that_drifts_is_added_up_to_its_bank(seen):
    region = LIVELY & ~STONE
    found = with_open_water(seen(), region, NOTHING)
    assert found[QUIET & FAR].mean() > 0.9
    assert found[ROWS < 45].mean() < 0.02
    assert not found[STONE].any(), "a hole in the mask is a rock, whatever is beside it"
    assert found[region].all()


def test_wander_tells_what_change_does_not(seen):
    wander = np.exp(log_wander(seen()))
    inside = (ROWS >= 52) & (ROWS < 64)
    assert np.median(wander[inside]) > 1.5 * np.median(wander[ROWS < 40])


def test_what_is_barred_stays_out(seen):
    barred = QUIET & (COLUMNS < 60)
    found = with_open_water(seen(), LIVELY, barred)
    assert not found[barred].any()
    assert found[QUIET & FAR & (COLUMNS > 65)].mean() > 0.9


def test_a_fluid_that_is_not_wide_keeps_its_mask(seen):
    region = LIVELY & NARROW
    assert with_open_water(seen(narrow=True), region, NOTHING) is region


def test_wide_water_of_which_a_part_was_found_is_found_whole(seen):
    found = with_open_water(seen(), LIVELY & (COLUMNS > 110), NOTHING)
    water = (LIVELY | (QUIET & FAR)) & ~STONE
    assert found[water].mean() > 0.95
    assert found[ROWS < 45].mean() < 0.02


def test_a_part_that_does_not_wander_is_not_made_whole(seen):
    bank = (ROWS < 40) & (COLUMNS > 110)
    assert with_open_water(seen(), bank, NOTHING) is bank


def test_nothing_is_added_where_the_camera_goes_on(seen):
    region = LIVELY & ~STONE
    assert with_open_water(seen(tremble=1), region, NOTHING) is region


def test_a_body_that_does_not_recede_keeps_its_mask(seen):
    region = LIVELY & ~STONE
    assert with_open_water(seen(near=1.2), region, NOTHING) is region


def test_without_quiet_water_the_mask_is_the_same_array(seen):
    region = LIVELY & ~STONE
    assert with_open_water(seen(drift=0), region, NOTHING) is region


def test_rims_and_patches_are_no_pieces():
    rim = (ROWS >= 40) & (ROWS < 42)
    patch = (ROWS < 12) & (COLUMNS < 12)
    assert not large_pieces(rim | patch, LIVELY).any()
    assert large_pieces(rim | patch | QUIET, LIVELY)[QUIET].mean() > 0.95


def test_a_piece_that_no_water_leads_to_is_not_added():
    beyond = (ROWS >= 10) & (ROWS < 40)
    assert not large_pieces(beyond, LIVELY).any()
    assert not large_pieces(beyond, LIVELY | ((ROWS >= 40) & (COLUMNS < 4))).any()


def test_a_bay_at_the_picture_s_edge_is_no_hole():
    region = LIVELY & ~STONE & ~((ROWS > 110) & (COLUMNS > 140))
    assert np.array_equal(holes(region), STONE)


CLIFF = (ROWS < 30) & (COLUMNS < 45)
FOAM = (ROWS + 0.6 * COLUMNS < 110) & ~CLIFF
"""runs out of three sides of the picture: the bright part of water that is everywhere but at the cliff"""


@pytest.fixture(scope="module")
def from_above():
    """Evidence of water that is looked straight down on, as lively everywhere, and a still cliff."""
    rng = np.random.default_rng(5)
    waves, cliff = smooth(rng, 2.0), np.array([90.0, 85.0, 75.0]) + 12.0 * smooth(rng, 1.5)
    frames = np.empty((FRAMES, HEIGHT, WIDTH, 3))
    for t in range(FRAMES):
        water = np.where(FOAM[..., None], [190.0, 195.0, 200.0], [40.0, 80.0, 95.0])
        frames[t] = np.where(CLIFF[..., None], cliff, water + 12.0 * np.roll(waves, t, axis=1))
    frames += rng.normal(size=frames.shape)
    video = VideoClip(np.clip(frames, 0, 255).round().astype(np.uint8), np.arange(FRAMES) / 25.0)
    flow = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32)
    return gather_evidence(video, PixelFlow(flow, np.ones(flow.shape[:3], np.float32)))


def test_water_from_above_of_which_its_foam_was_found_is_found_whole(from_above):
    found = with_open_water(from_above, FOAM, CLIFF & (ROWS < 20) & (COLUMNS < 35))
    inner = (ROWS > 36) | (COLUMNS > 51)
    assert found[inner].mean() > 0.95
    assert found[(ROWS < 22) & (COLUMNS < 37)].mean() < 0.1


def test_what_does_not_run_out_of_the_picture_keeps_its_mask(from_above):
    tray = FOAM & (ROWS > 34) & (COLUMNS > 4)
    assert not is_part_of_all(tray, log_wander(from_above))
    assert is_part_of_all(FOAM, log_wander(from_above))


def test_what_has_still_surroundings_is_not_all(seen):
    wander = log_wander(seen(drift=0))
    assert not is_part_of_all(LIVELY, wander)
    assert not is_part_of_all(~FOAM, np.full(FOAM.shape, np.log(0.9 + 0.2))), "all moves as a camera does"
