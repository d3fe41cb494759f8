"""What counts as fluid: change that goes somewhere, against the clip's own noise."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.errors import InputRejected
from fluidlift.shape.background import without_background
from fluidlift.shape.evidence import fluid_score, gather_evidence, noise_map, separating_level
from fluidlift.shape.segment import (
    Label,
    at_full_size,
    grows,
    median_over_time,
    overlay,
    segment,
    solids_in,
)
from fluidlift.types.clip import VideoClip
from fluidlift.types.flow import PixelFlow

FRAMES, HEIGHT, WIDTH = 16, 120, 160


def texture(rng: np.random.Generator, shape: tuple[int, int], *, sigma: float = 2.0) -> np.ndarray:
    """Smooth random brightness, mean 0, deviation 1."""
    noise = gaussian_filter(rng.normal(size=shape).astype(np.float32), sigma, mode="wrap")
    return noise / noise.std()


def still_room(rng: np.random.Generator, *, frames: int = FRAMES) -> np.ndarray:
    """A brown room, float32 [T,H,W,3], with the noise of a sensor (1 grey level)."""
    room = np.array([110.0, 95.0, 75.0], np.float32) + 12.0 * texture(rng, (HEIGHT, WIDTH))[..., None]
    return room[None] + rng.normal(scale=1.0, size=(frames, HEIGHT, WIDTH, 3)).astype(np.float32)


def clip_of(pictures: np.ndarray, *, alpha: np.ndarray | None = None) -> VideoClip:
    frames = np.clip(pictures, 0, 255).round().astype(np.uint8)
    return VideoClip(frames, np.arange(len(frames)) / 25.0, alpha=alpha)


def no_flow(frames: int = FRAMES) -> PixelFlow:
    shape = (frames - 1, HEIGHT, WIDTH)
    return PixelFlow(np.zeros((*shape, 2), np.float32), np.ones(shape, np.float32))


def stream_mask() -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[40:90] = True
    return mask


def rock_mask() -> np.ndarray:
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    return (rows - 65) ** 2 + (columns - 80) ** 2 < 12**2


def stream(rng: np.random.Generator, *, speed: int = 3) -> tuple[np.ndarray, PixelFlow]:
    """Blue water with a pattern that moves to the right, and a grey rock that stands in it."""
    pictures = still_room(rng)
    pattern = texture(rng, (HEIGHT, WIDTH), sigma=3.0)
    water = stream_mask() & ~rock_mask()
    rock = np.array([130.0, 128.0, 125.0]) + 6.0 * texture(rng, (HEIGHT, WIDTH))[..., None]
    for t in range(FRAMES):
        surface = np.array([60.0, 90.0, 130.0]) + 30.0 * np.roll(pattern, speed * t, axis=1)[..., None]
        pictures[t][water] = surface[water]
        pictures[t][rock_mask()] = rock[rock_mask()]
    flow = no_flow()
    flow.displacement[:, water, 0] = speed
    return pictures, flow


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.fixture(scope="module")
def river() -> tuple[VideoClip, PixelFlow]:
    pictures, flow = stream(np.random.default_rng(3))
    return clip_of(pictures), flow


def test_a_moving_pattern_is_fluid_and_the_still_room_is_not(river):
    labels = segment(*river)
    # the outline may be off by the pooling radius, about 1.5 px on 2 x 160 px of bank: 6% of the area
    assert overlap(labels.fluid[FRAMES // 2], stream_mask() & ~rock_mask()) > 0.92
    assert labels.confidence.dtype == np.float16
    assert float(labels.confidence.min()) >= 0.0 and float(labels.confidence.max()) <= 1.0


def test_a_still_rock_in_the_stream_is_solid_and_the_banks_are_background(river):
    labels = segment(*river)
    # same tolerance of about 1.5 px on a disc of radius 12 px: a quarter of its area
    assert overlap(labels.solid[0], rock_mask()) > 0.7
    assert not labels.solid[:, :35].any() and not labels.solid[:, 95:].any()


def test_a_stream_that_stays_in_its_bed_keeps_its_labels_from_frame_to_frame(river):
    fluid = segment(*river).fluid
    assert np.mean(fluid[1:] != fluid[:-1]) < 0.001 * fluid.mean()


def test_the_same_clip_gives_the_same_labels(river):
    first, second = segment(*river), segment(*river)
    assert np.array_equal(first.labels, second.labels) and np.array_equal(first.confidence, second.confidence)


def test_progress_is_told_and_grows(river):
    told = []
    segment(*river, progress=lambda part, words: told.append(part))
    assert told == sorted(told) and len(told) >= 2


def test_a_lamp_that_flickers_makes_no_fluid():
    rng = np.random.default_rng(4)
    pictures, flow = stream(rng)
    flicker = 1.0 + 0.08 * np.sin(2.1 * np.arange(FRAMES))
    labels = segment(clip_of(pictures * flicker[:, None, None, None]), flow)
    assert overlap(labels.fluid[0], stream_mask() & ~rock_mask()) > 0.9  # as without flicker, less rounding


def test_nothing_that_moves_is_rejected_with_the_advice_to_give_a_mask():
    with pytest.raises(InputRejected, match=r"nothing moves.*--mask"):
        segment(clip_of(still_room(np.random.default_rng(5))), no_flow())


def test_flicker_alone_is_nothing_that_moves():
    flicker = 1.0 + 0.1 * np.sin(2.1 * np.arange(FRAMES))
    pictures = still_room(np.random.default_rng(6)) * flicker[:, None, None, None]
    with pytest.raises(InputRejected, match="nothing moves"):
        segment(clip_of(pictures), no_flow())


def test_a_single_frame_needs_a_mask():
    clip = clip_of(still_room(np.random.default_rng(7), frames=1))
    with pytest.raises(InputRejected, match="mask"):
        segment(clip, no_flow(1))
    assert segment(clip, no_flow(1), user_mask=stream_mask()).fluid[0].sum() == stream_mask().sum()


def swaying(rng: np.random.Generator) -> tuple[np.ndarray, PixelFlow]:
    """The stream, and above it a leaf of fine pattern that sways by 2 px to either side."""
    pictures, flow = stream(rng)
    leaf = texture(rng, (HEIGHT, WIDTH), sigma=2.5)
    area = (slice(5, 30), slice(20, 120))
    where = 2.0 * np.sin(1.3 * np.arange(FRAMES))
    for t in range(FRAMES):
        moved = cv2.warpAffine(leaf, np.float32([[1, 0, where[t]], [0, 1, 0]]), (WIDTH, HEIGHT))
        pictures[t][area] = (np.array([50.0, 110.0, 40.0]) + 40.0 * moved[..., None])[area]
    flow.displacement[:, area[0], area[1], 0] = np.diff(where)[:, None, None]
    return pictures, flow


def test_motion_that_goes_nowhere_counts_as_swaying_and_the_stream_does_not():
    pictures, flow = swaying(np.random.default_rng(8))
    evidence = gather_evidence(clip_of(pictures), flow)
    leaf, water = evidence.swaying[10:25, 30:110], evidence.swaying[45:85, 10:60]
    assert float(np.median(leaf)) > 0.5 > 0.1 > float(np.median(water))
    assert float(np.median(evidence.streaming[45:85, 10:60])) > 0.8


def test_a_leaf_that_sways_is_background_though_it_changes():
    pictures, flow = swaying(np.random.default_rng(8))
    evidence = gather_evidence(clip_of(pictures), flow)
    leaf = (slice(10, 25), slice(30, 110))
    # by its activity alone the leaf would pass for fluid: it is the swaying that tells
    assert float(np.median(fluid_score(replace(evidence, swaying=0.0 * evidence.swaying))[leaf])) > 0.0
    assert float(np.median(fluid_score(evidence)[leaf])) < 0.0
    labels = segment(clip_of(pictures), flow)
    assert labels.fluid[0][45:85, 10:60].mean() > 0.95
    assert labels.fluid[0][10:25, 30:110].mean() < 0.1


def smoke(rng: np.random.Generator, *, frames: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A grey cloud that rises over a dark still wall; pictures and true masks."""
    pictures = 0.4 * still_room(rng, frames=frames)
    truth = np.zeros((frames, HEIGHT, WIDTH), bool)
    grain = texture(rng, (HEIGHT, WIDTH), sigma=2.5)
    for t in range(frames):
        top = HEIGHT - 10 - 4 * t
        truth[t, max(top, 5) :, 60:100] = True
        cloud = 170.0 + 25.0 * np.roll(grain, -4 * t, axis=0)[..., None].repeat(3, axis=-1)
        pictures[t][truth[t]] = cloud[truth[t]]
    return pictures, truth


def test_smoke_that_rises_is_outlined_in_every_frame():
    pictures, truth = smoke(np.random.default_rng(9))
    labels = segment(clip_of(pictures), no_flow(24))
    # a front of 40 px, known to the 1 px of smoothing in the pictures; the first frames are the smallest
    for t in (2, 12, 23):
        assert overlap(labels.fluid[t], truth[t]) > 0.85, t


def test_a_front_grows_and_foam_that_comes_back_does_not():
    front = np.zeros((20, 30, 30), bool)
    for t in range(20):
        front[t, : t + 1] = True
    foam = np.random.default_rng(0).random((20, 30, 30)) < 0.4
    assert grows(front) and grows(front[::-1])
    assert not grows(foam)


def test_the_mask_of_the_user_wins_with_confidence_one(river):
    clip, flow = river
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:20, :30] = True
    for given in (mask, np.broadcast_to(mask, (FRAMES, HEIGHT, WIDTH)).copy()):
        labels = segment(clip, flow, user_mask=given)
        assert np.array_equal(labels.fluid, np.broadcast_to(mask, labels.labels.shape))
        assert float(labels.confidence.min()) == 1.0


def test_a_mask_of_another_size_or_an_empty_one_is_rejected(river):
    with pytest.raises(InputRejected, match="mask of shape"):
        segment(*river, user_mask=np.ones((4, 4), bool))
    with pytest.raises(InputRejected, match="empty mask"):
        segment(*river, user_mask=np.zeros((HEIGHT, WIDTH), bool))


def test_alpha_serves_as_mask_unless_it_is_constant(river):
    clip, flow = river
    alpha = np.zeros((FRAMES, HEIGHT, WIDTH), np.uint8)
    alpha[:, 10:20, 10:20] = 255
    masked = VideoClip(clip.frames, clip.times, alpha=alpha)
    assert np.array_equal(segment(masked, flow).fluid, alpha > 127)
    opaque = VideoClip(clip.frames, clip.times, alpha=np.full_like(alpha, 255))
    assert np.array_equal(segment(opaque, flow).labels, segment(clip, flow).labels)


def test_outside_the_region_of_interest_there_is_no_fluid(river):
    labels = segment(*river, roi=(0, 0, 60, HEIGHT))
    assert not labels.fluid[:, :, 61:].any() and labels.fluid[:, :, :55].any()
    with pytest.raises(InputRejected, match="outside"):
        segment(*river, roi=(1000, 0, 10, 10))


def test_flow_of_another_length_is_an_error(river):
    with pytest.raises(ValueError, match="flow"):
        segment(river[0], no_flow(FRAMES + 3))


def test_two_populations_are_divided_between_them_and_one_is_not_divided_below_the_floor():
    rng = np.random.default_rng(1)
    activity = np.concatenate([rng.normal(0.2, 0.1, 3000), rng.normal(3.0, 0.3, 1000)]).clip(0)
    assert 0.6 < separating_level(activity) < 2.4
    # half of a normal distribution lies above its mean: a still clip must not be divided there
    assert separating_level(rng.normal(0.2, 0.1, 3000).clip(0)) >= np.log(1.8)


def test_the_noise_follows_the_tremble_of_edges_and_not_the_fluid():
    rng = np.random.default_rng(2)
    steep = rng.uniform(0.0, 40.0, (100, 100)).astype(np.float32)
    change = 1.0 + 0.1 * steep
    change[:40] += 60.0
    noise = noise_map(change, steep)
    # the base is read from a class of finite width, as is the slope: a fifth either way
    assert np.allclose(noise, 1.0 + 0.1 * steep, rtol=0.35)


def test_small_holes_are_filled_still_ones_are_solid_and_open_bays_stay_outside():
    region = np.zeros((60, 60), bool)
    region[10:50, 10:50] = True
    region[20:30, 20:30] = False
    region[40, 40] = False
    region[10:20, 45:50] = False
    still = np.ones_like(region)
    filled, solid = solids_in(np.kron(region, np.ones((2, 2))) > 0, np.kron(still, np.ones((2, 2))) > 0)
    filled, solid = filled[::2, ::2], solid[::2, ::2]
    assert solid.sum() == 100 and solid[20:30, 20:30].all()
    assert filled[40, 40] and not filled[12, 47] and not solid[12, 47]
    assert solids_in(region, ~still)[0][25, 25], "a hole that moves is fluid"


def test_the_median_over_time_drops_a_single_frame():
    odds = np.zeros((5, 2, 2), np.float16)
    odds[2] = 9.0
    assert not median_over_time(odds).any()


def test_background_that_shows_between_the_fluid_is_taken_out_of_its_colours():
    around = np.zeros((4, 4, 4), np.float32)
    around[0, 0, 0] = 1000.0
    mixed = np.zeros_like(around)
    mixed[0, 0, 0], mixed[3, 3, 3] = 200.0, 50.0
    own = without_background(mixed, around)
    assert own[0, 0, 0] == 0.0 and own[3, 3, 3] == 50.0


def test_labels_at_full_size_keep_their_areas():
    labels = np.zeros((1, 30, 40), np.uint8)
    labels[0, 10:20, 10:30] = Label.FLUID
    full, sure = at_full_size(labels, np.full((1, 30, 40), 0.5, np.float32), 90, 120)
    # an outline of 180 px, off by at most half a px
    assert abs(int((full == Label.FLUID).sum()) - 30 * 60) < 90
    assert sure.shape == (1, 90, 120) and sure.dtype == np.float16


def test_the_overlay_tints_fluid_hatches_solids_and_leaves_the_rest():
    frame = np.full((40, 40, 3), 100, np.uint8)
    labels = np.zeros((40, 40), np.uint8)
    labels[5:20, 5:20], labels[25:35, 25:35] = Label.FLUID, Label.SOLID
    picture = overlay(frame, labels)
    assert picture.dtype == np.uint8 and picture.shape == frame.shape
    assert (picture[0, :] == 100).all()
    assert picture[12, 12, 2] > picture[12, 12, 0]
    assert len(np.unique(picture[27:33, 27:33].reshape(-1, 3), axis=0)) == 2
    assert (frame == 100).all(), "the frame itself is not drawn on"
