"""What counts as fluid: change that goes somewhere, against the clip's own noise."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from fluidlift.errors import InputRejected
from fluidlift.messages import code_of
from fluidlift.shape.colour_growth import colour_odds, grown_from_streams, grown_steadily, with_quiet_water
from fluidlift.shape.evidence import fluid_score, gather_evidence
from fluidlift.shape.segment import OF_SCORE, Label, LabelWriter, clues_of, doubts, overlay, segment, sureness
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


def test_an_edge_that_a_stabilizer_filled_with_a_mirror_image_is_no_fluid(river, monkeypatch):
    pictures, flow = stream(np.random.default_rng(3))
    displacement = flow.displacement.copy()
    for t, strip in enumerate(np.linspace(4, 16, FRAMES).round().astype(int)):
        pictures[t, HEIGHT - strip :] = pictures[t, HEIGHT - 2 * strip : HEIGHT - strip][::-1]
        displacement[min(t, FRAMES - 2), HEIGHT - strip :, :, 1] = -1.6  # twice what the frame moves by
    clip, moved = clip_of(pictures), replace(flow, displacement=displacement)
    labels = segment(clip, moved)
    assert not labels.fluid[:, HEIGHT - 16 :].any()
    assert [code_of(w) for w in labels.warnings] == ["mirrored-edge"]
    assert overlap(labels.fluid[FRAMES // 2], stream_mask() & ~rock_mask()) > 0.92
    monkeypatch.setattr("fluidlift.shape.segment.mirrored_edges", lambda frames: np.zeros(frames.shape[1:3], bool))
    assert segment(clip, moved).fluid[:, HEIGHT - 16 :].any()
    assert not any(code_of(w) == "mirrored-edge" for w in segment(*river).warnings)


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
    # by its activity alone the leaf would pass for fluid: it is its motion that tells
    alone = replace(evidence, swaying=0.0 * evidence.swaying, carried=0.0 * evidence.carried)
    assert float(np.median(fluid_score(alone)[leaf])) > 0.0
    assert float(np.median(fluid_score(evidence)[leaf])) < 0.0
    labels = segment(clip_of(pictures), flow)
    assert labels.fluid[0][45:85, 10:60].mean() > 0.95
    assert labels.fluid[0][10:25, 30:110].mean() < 0.1


def with_jug(rng: np.random.Generator) -> tuple[np.ndarray, PixelFlow]:
    """The stream, and above it something of a fine pattern that swings by 12 px to either side."""
    pictures, flow = stream(rng)
    jug, area = texture(rng, (HEIGHT, WIDTH), sigma=2.5), (slice(5, 30), slice(20, 120))
    where = 12.0 * np.sin(0.8 * np.arange(FRAMES))
    for t in range(FRAMES):
        moved = cv2.warpAffine(jug, np.float32([[1, 0, where[t]], [0, 1, 0]]), (WIDTH, HEIGHT))
        pictures[t][area] = (np.array([50.0, 110.0, 40.0]) + 40.0 * moved[..., None])[area]
    flow.displacement[:, area[0], area[1], 0] = np.diff(where)[:, None, None]
    return pictures, flow


def test_what_swings_far_is_carried_and_no_fluid():
    pictures, flow = with_jug(np.random.default_rng(12))
    evidence = gather_evidence(clip_of(pictures), flow)
    jug, water = (slice(10, 25), slice(40, 100)), (slice(45, 85), slice(10, 60))
    assert float(np.median(evidence.carried[jug])) > 0.5 > 0.1 > float(np.median(evidence.carried[water]))
    assert float(np.median(fluid_score(replace(evidence, carried=0.0 * evidence.carried))[jug])) > 0.0
    score = fluid_score(evidence)[jug]
    assert -3.0 <= float(np.median(score)) < 0.0, "colours and edges still have their say"
    fluid = segment(clip_of(pictures), flow).fluid[0]
    assert fluid[water].mean() > 0.95
    assert fluid[jug].mean() < 0.1


def smoke(rng: np.random.Generator, *, frames: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A grey cloud that rises over a dark still wall and turns over as it does; pictures and true masks."""
    pictures = 0.4 * still_room(rng, frames=frames)
    truth = np.zeros((frames, HEIGHT, WIDTH), bool)
    grain, other = (
        texture(rng, (HEIGHT, WIDTH), sigma=2.5),
        texture(np.random.default_rng(90), (HEIGHT, WIDTH), sigma=2.5),
    )
    for t in range(frames):
        top, turned = HEIGHT - 10 - 4 * t, 0.15 * t  # of one look for half a second: no board that is pushed in
        truth[t, max(top, 5) :, 60:100] = True
        look = np.cos(turned) * grain + np.sin(turned) * other
        cloud = 170.0 + 25.0 * np.roll(look, -4 * t, axis=0)[..., None].repeat(3, axis=-1)
        pictures[t][truth[t]] = cloud[truth[t]]
    return pictures, truth


def test_smoke_that_rises_is_outlined_in_every_frame():
    pictures, truth = smoke(np.random.default_rng(9))
    labels = segment(clip_of(pictures), no_flow(24))
    # a front of 40 px, known to the 1 px of smoothing in the pictures; the first frames are the smallest
    for t in (2, 12, 23):
        assert overlap(labels.fluid[t], truth[t]) > 0.85, t


def test_a_thin_jet_that_moves_along_is_outlined_though_the_ground_has_its_colours():
    rng, frames = np.random.default_rng(3), 30
    pictures, truth = still_room(rng, frames=frames) + 60.0, np.zeros((frames, HEIGHT, WIDTH), bool)
    pictures[:, :, : WIDTH // 3] = (45.0 + 12.0 * texture(rng, (HEIGHT, WIDTH)))[:, : WIDTH // 3, None]
    for t in range(frames):
        left = 70 + round(0.2 * t)
        truth[t, 5:50, left : left + 4] = True
        beads = 45.0 + 12.0 * texture(rng, (45, 1), sigma=1.0)  # too fast to be followed
        pictures[t][truth[t]] = np.repeat(beads, 4, axis=0)
    for t in range(frames):  # what it falls into is red, and rises
        red = np.array([170.0, 40.0, 40.0]) + 25.0 * texture(rng, (t + 10, 40))[..., None]
        pictures[t][HEIGHT - t - 10 :, 55:95] = red
    fluid = segment(clip_of(pictures), no_flow(frames)).fluid
    for t in (3, 15, 27):
        assert fluid[t][truth[t]].mean() > 0.8, t


def test_a_leaf_that_sways_beside_smoke_is_no_smoke_in_any_frame():
    rng = np.random.default_rng(9)
    pictures, truth = smoke(rng)
    flow, leaf = no_flow(24), texture(rng, (HEIGHT, WIDTH), sigma=2.5)
    area, where = (slice(40, 80), slice(5, 40)), 2.0 * np.sin(1.3 * np.arange(24))
    for t in range(24):
        moved = cv2.warpAffine(leaf, np.float32([[1, 0, where[t]], [0, 1, 0]]), (WIDTH, HEIGHT))
        pictures[t][area] = (np.array([150.0, 160.0, 150.0]) + 40.0 * moved[..., None])[area]
    flow.displacement[:, area[0], area[1], 0] = np.diff(where)[:, None, None]
    fluid = segment(clip_of(pictures), flow).fluid
    assert fluid[:, 45:75, 10:35].mean() < 0.05
    assert overlap(fluid[12], truth[12]) > 0.85


def test_an_outline_is_the_surer_the_more_the_score_agrees_and_never_below_a_half():
    score = np.array([[-12.0, -3.0, 0.0, 3.0, 12.0]])
    inside, outside = sureness(np.ones_like(score, bool), score), sureness(np.zeros_like(score, bool), score)
    assert (np.diff(inside) >= 0.0).all() and (np.diff(outside) <= 0.0).all()
    assert inside[0, 0] == 0.0 and outside[0, 4] == 0.0  # a label that is likelier wrong is not sure at all
    assert 0.9 < inside[0, 4] < 1.0 and 0.8 < outside[0, 0] < 1.0  # and none is beyond doubt


def test_the_trembling_shadow_of_smoke_is_no_smoke():
    rng = np.random.default_rng(9)
    pictures, truth = smoke(rng)
    shadow = (slice(None), slice(98, 116), slice(101, 150))
    for t in range(len(pictures)):
        pictures[t, 90:] += ~truth[t, 90:, :, None] * 70.0  # a lit floor
        pictures[t][shadow[1:]] *= 0.55 + 0.1 * texture(rng, (HEIGHT, WIDTH), sigma=3.0)[shadow[1:]][..., None]
    fluid = segment(clip_of(pictures), no_flow(24)).fluid
    assert fluid[shadow].mean() < 0.1
    assert overlap(fluid[20], truth[20]) > 0.85  # as without a shadow


def spilled(rng: np.random.Generator, *, frames: int = 24) -> tuple[np.ndarray, np.ndarray, tuple[slice, slice]]:
    """Blue water before a brown wall, that runs where its shadow lay; pictures, true masks, the first shadow."""
    pictures, truth = still_room(rng, frames=frames), np.zeros((frames, HEIGHT, WIDTH), bool)
    shadow, grain = (slice(70, 110), slice(76, 100)), texture(rng, (HEIGHT, WIDTH), sigma=2.5)
    for t in range(frames):
        front = max(100 - 4 * t, 10)
        truth[t, 30 + 2 * t :, 100:130], truth[t, 70:, front:100] = True, True
        truth[t, 110:] = False
        water = np.array([40.0, 75.0, 120.0]) + 15.0 * np.roll(grain, -4 * t, axis=1)[..., None]  # as dark as a shadow
        shade = np.zeros((HEIGHT, WIDTH), bool)
        shade[70:110, max(front - 24, 0) : front] = True
        pictures[t][shade] *= 0.6
        pictures[t][truth[t]] = water[truth[t]]
    return pictures, truth, shadow


def test_the_shadow_of_coloured_water_is_ground_though_no_light_ever_falls_there():
    pictures, truth, shadow = spilled(np.random.default_rng(3))
    fluid = segment(clip_of(pictures), no_flow(24)).fluid
    assert fluid[0][shadow].mean() < 0.05  # 0.25 by brightness alone
    for t in (0, 4, 8, 12, 20):  # 0.82 to 0.93
        assert overlap(fluid[t], truth[t]) > 0.95, t


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


def test_labels_at_full_size_keep_their_areas():
    labels = np.zeros((1, 30, 40), np.uint8)
    labels[0, 10:20, 10:30] = Label.FLUID
    writer = LabelWriter((1, 90, 120))
    writer.write(0, labels[0], np.full((30, 40), 0.5, np.float32))
    full, sure = writer.labels, writer.confidence
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


# what the user says


@pytest.fixture(scope="module")
def brook_and_screen() -> tuple[VideoClip, PixelFlow]:
    """The stream, and above it a screen with a red pattern that changes as lively as the water."""
    rng = np.random.default_rng(11)
    pictures, flow = stream(rng)
    for t in range(FRAMES):
        change = 30.0 * texture(rng, (HEIGHT, WIDTH), sigma=3.0)[..., None]
        pictures[t][5:30, 20:120] = (np.array([170.0, 60.0, 50.0]) + change)[5:30, 20:120]
    return clip_of(pictures), flow


def test_a_click_takes_away_what_moves_and_is_no_fluid(brook_and_screen):
    screen = (slice(8, 27), slice(25, 115))
    water = (slice(45, 85), slice(5, 60))
    before = segment(*brook_and_screen).fluid[0]
    after = segment(*brook_and_screen, points=[(70, 17, 0)]).fluid[0]
    assert before[screen].mean() > 0.9, "else there is nothing to take away"
    assert after[screen].mean() < 0.1
    assert after[water].mean() > 0.95


def test_a_click_adds_a_pool_that_does_not_move():
    rng = np.random.default_rng(12)
    pictures, flow = stream(rng)
    pool = (slice(95, 115), slice(30, 130))
    pictures[:, pool[0], pool[1]] = np.array([40.0, 120.0, 60.0]) + rng.normal(size=(FRAMES, 20, 100, 3))
    clip = clip_of(pictures)
    assert segment(clip, flow).fluid[0][pool].mean() < 0.1
    labels = segment(clip, flow, points=[(80, 105, 1)])
    assert labels.fluid[0][pool].mean() > 0.9
    assert labels.fluid[0][:35].mean() < 0.05, "the bank on the other side is not the pool's like"


def test_the_pixel_of_a_click_has_its_label_where_clicks_lie_side_by_side(brook_and_screen):
    fluid = segment(*brook_and_screen, points=[(40, 17, 0), (40, 60, 1), (100, 17, 1)]).fluid[0]
    assert not fluid[17, 40] and fluid[60, 40] and fluid[17, 100]


def test_a_click_that_agrees_leaves_the_mask_nearly_as_it_was(brook_and_screen):
    clip, flow = brook_and_screen
    before, after = segment(clip, flow).fluid[0], segment(clip, flow, points=[(30, 65, 1)]).fluid[0]
    # the outline is cut anew, by another energy: a px or two on an outline of about 600 px around 10000 px
    assert overlap(before, after) > 0.9


def test_a_click_beside_smoke_takes_its_place_out_of_every_frame():
    pictures, truth = smoke(np.random.default_rng(9))
    rng = np.random.default_rng(3)
    for t in range(len(pictures)):  # a red lamp that flickers in a corner
        pictures[t][85:110, 10:40] = np.array([190.0, 40.0, 30.0]) * rng.uniform(0.5, 1.2)
    clip = clip_of(pictures)
    lamp = (slice(None), slice(88, 107), slice(13, 37))
    before, after = segment(clip, no_flow(24)).fluid, segment(clip, no_flow(24), points=[(25, 97, 0)]).fluid
    assert before[lamp].mean() > 0.3, "else there is nothing to take away"
    assert after[lamp].mean() < 0.02
    assert overlap(after[20], truth[20]) > 0.8


def test_clicks_find_fluid_where_nothing_else_does():
    rng = np.random.default_rng(5)
    pictures = still_room(rng)
    pictures[:, 40:90] = np.array([60.0, 90.0, 130.0]) + rng.normal(size=(FRAMES, 50, WIDTH, 3))
    labels = segment(clip_of(pictures), no_flow(), points=[(80, 65, 1), (80, 10, 0)])
    assert overlap(labels.fluid[0], stream_mask()) > 0.9


def test_points_outside_or_with_a_strange_label_are_rejected(brook_and_screen):
    with pytest.raises(InputRejected, match="outside"):
        segment(*brook_and_screen, points=[(WIDTH, 3, 1)])
    with pytest.raises(InputRejected, match="label"):
        segment(*brook_and_screen, points=[(3, 3, 2)])


# colour where motion says too little


def test_colour_odds_are_those_of_the_two_histograms_and_bounded():
    picture = np.zeros((10, 10, 3), np.float32)
    picture[:, 5:, 0] = 200.0
    right = np.zeros((10, 10))
    right[:, 5:] = 1.0
    odds = colour_odds(picture, right, 1.0 - right)
    assert (odds[:, 5:] > 3.0).all() and (odds[:, :5] < -3.0).all()
    even = colour_odds(picture, np.ones((10, 10)), np.ones((10, 10)))
    assert np.abs(even).max() < 1e-5


def test_water_that_moves_too_little_to_tell_joins_by_its_colour_and_the_banks_do_not():
    rng = np.random.default_rng(3)
    pictures, flow = stream(rng)
    ripples = 12.0 * texture(rng, (HEIGHT, WIDTH), sigma=3.0)[..., None]
    for t in range(FRAMES):  # less than half of the contrast of the stream
        calm = np.array([60.0, 90.0, 130.0]) + np.roll(ripples, t, axis=1) + rng.normal(size=ripples.shape)
        pictures[t, 90:105] = calm[90:105]
    evidence = gather_evidence(clip_of(pictures), flow)
    lively = np.zeros((HEIGHT, WIDTH), bool)
    lively[42:88] = True
    score = fluid_score(evidence)
    found = with_quiet_water(evidence.typical, score, lively)
    assert float(np.median(score[92:103])) < 0.0, "else motion alone would tell"
    assert found[92:103].mean() > 0.85
    assert found[:35].mean() < 0.05 and found[110:].mean() < 0.05
    assert found[lively].all(), "nothing is taken away"


def shaken_honey() -> tuple[np.ndarray, np.ndarray]:
    """A hand-held picture of a yellow puddle on a patterned grey tray; some of the puddle streams. And its mask."""
    rng = np.random.default_rng(7)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    puddle = ((rows - 60) / 40.0) ** 2 + ((columns - 80) / 55.0) ** 2 < 1.0
    tray = np.array([120.0, 120.0, 125.0]) + 40.0 * texture(rng, (HEIGHT, WIDTH), sigma=1.2)[..., None]
    honey = np.array([170.0, 120.0, 40.0]) + 10.0 * texture(rng, (HEIGHT, WIDTH), sigma=1.2)[..., None]
    still = np.where(puddle[..., None], honey, tray)
    pattern = 25.0 * texture(rng, (HEIGHT, WIDTH), sigma=2.0)[..., None]
    pictures = still_room(rng)
    for t in range(FRAMES):
        picture = still.copy()
        picture[50:70, 60:110] += np.roll(pattern, 2 * t, axis=1)[50:70, 60:110]
        hand = rng.normal(scale=0.8, size=2)
        pictures[t] = shift(picture, (*hand, 0.0), order=1, mode="nearest")
    return pictures, puddle


def test_in_a_shaken_picture_the_fluid_grows_from_where_it_streams():
    pictures, puddle = shaken_honey()
    flow = no_flow()
    flow.displacement[:, 50:70, 60:110, 0] = 2.0
    evidence = gather_evidence(clip_of(pictures), flow)
    grown = grown_from_streams(evidence, np.ones((HEIGHT, WIDTH), bool))
    assert grown is not None
    # the picture trembles by a px either way on an outline of 300 px around 6900 px
    assert overlap(grown, puddle) > 0.85


def test_fluid_that_fills_its_picture_grows_over_what_does_not_stream():
    """Three quarters of the picture, in two tones; an eighth of it streams, in the brighter one."""
    rng = np.random.default_rng(8)
    columns = np.mgrid[0:HEIGHT, 0:WIDTH][1]
    fluid = columns < 120
    bank = np.array([90.0, 125.0, 60.0]) + 40.0 * texture(rng, (HEIGHT, WIDTH), sigma=1.2)[..., None]
    water = np.array([150.0, 150.0, 155.0]) - 10.0 * (columns < 60)[..., None]
    water = water + 10.0 * texture(rng, (HEIGHT, WIDTH), sigma=2.0)[..., None]
    pattern = 25.0 * texture(rng, (HEIGHT, WIDTH), sigma=2.0)[..., None]
    pictures, flow, still = still_room(rng), no_flow(), np.where(fluid[..., None], water, bank)
    for t in range(FRAMES):
        picture = still.copy()
        picture[:, 75:105] += np.roll(pattern, 2 * t, axis=0)[:, 75:105]
        pictures[t] = shift(picture, (*rng.normal(scale=0.8, size=2), 0.0), order=1, mode="nearest")
    flow.displacement[:, :, 75:105, 1] = 2.0
    evidence = gather_evidence(clip_of(pictures), flow)
    everywhere = np.ones((HEIGHT, WIDTH), bool)
    found = [grown_from_streams(evidence, everywhere, against=odds) for odds in (0.0, 1.0)]
    assert all(f is not None for f in found)
    kept, other = (overlap(f, fluid) for f in found)
    assert kept > 0.9 > other
    steadily = grown_steadily(evidence, everywhere)
    assert steadily is not None
    np.testing.assert_array_equal(steadily, found[0])


def test_what_has_the_colours_of_all_around_it_does_not_grow_over_that():
    """A jet of a twentieth of the picture before a wall of its own blue, which gets a little darker to one side."""
    rng = np.random.default_rng(9)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    jet = (abs(columns - 80) < 8) & (rows < 70)
    still = np.array([110.0, 140.0, 200.0]) - 0.25 * columns[..., None]
    pattern = 25.0 * texture(rng, (HEIGHT, WIDTH), sigma=2.0)[..., None]
    pictures, flow = still_room(rng), no_flow()
    for t in range(FRAMES):
        picture = still + np.where(jet[..., None], np.roll(pattern, 2 * t, axis=0), 0.0)
        pictures[t] = shift(picture, (*rng.normal(scale=0.8, size=2), 0.0), order=1, mode="nearest")
    flow.displacement[:, jet, 1] = 2.0
    evidence, everywhere = gather_evidence(clip_of(pictures), flow), np.ones((HEIGHT, WIDTH), bool)
    lax, steadily = grown_from_streams(evidence, everywhere), grown_steadily(evidence, everywhere)
    assert lax is not None and steadily is not None
    assert overlap(steadily, jet) > 0.6 > overlap(lax, jet)


def test_what_moves_as_a_solid_is_left_out_where_fluid_grows():
    pictures, puddle = shaken_honey()
    flow = no_flow()
    flow.displacement[:, 50:70, 60:110, 0] = 2.0
    known = clues_of(clip_of(pictures), flow)
    jug = np.zeros((HEIGHT, WIDTH), bool)
    jug[:, 95:] = True
    assert known.grown is not None and known.grown[jug & puddle].mean() > 0.8
    grown = replace(known, solids=jug).grown
    assert grown is not None and not grown[jug].any() and grown[puddle & ~jug].mean() > 0.8


def test_without_anything_that_streams_nothing_grows():
    evidence = gather_evidence(clip_of(shaken_honey()[0]), no_flow())
    assert grown_from_streams(evidence, np.ones((HEIGHT, WIDTH), bool)) is None


def test_doubt_is_told_where_the_picture_shakes():
    pictures, _ = shaken_honey()
    flow = no_flow()
    flow.displacement[:, 50:70, 60:110, 0] = 2.0
    labels = segment(clip_of(pictures), flow)
    assert "mask-doubtful" in map(code_of, labels.warnings)


def test_the_more_of_the_picture_could_be_either_the_stronger_the_warning():
    score = np.full((100, 100), -6.0, np.float32)
    score[:40] = 6.0
    assert doubts(0.4, score) == ()
    score[40:60] = -0.5  # half as large as the fluid
    (mild,) = doubts(0.4, score)
    assert "50 %" in mild and "--click" in mild
    score[40:90] = -0.5
    (strong,) = doubts(0.4, score)
    assert "more of the picture is doubtful than is fluid" in strong
    assert "mask-nearly-everything" in map(code_of, doubts(0.95, score))


def test_what_is_known_to_stand_counts_against_fluid_in_the_units_of_the_score(river):
    clip, flow = river
    half = np.zeros((2, 2), np.float32)
    half[:, 1] = -2.4  # the right half: seen the same from several places
    plain, told = clues_of(clip, flow).score, clues_of(clip, flow, said=half).score
    left, right = slice(0, plain.shape[1] // 4), slice(3 * plain.shape[1] // 4, None)
    assert np.array_equal(told[:, left], plain[:, left])
    free = np.abs(plain[:, right]) < 4.0  # the score ends at 12
    assert (told[:, right] - plain[:, right])[free] == pytest.approx(-2.4 / OF_SCORE, abs=1e-3)
    assert (told[:, right] > 0).sum() < (plain[:, right] > 0).sum()


def sinking_column(rng: np.random.Generator, color: np.ndarray) -> tuple[np.ndarray, PixelFlow, np.ndarray]:
    """A teal body with foam that is let go: its upper part, of a color of its own, sinks as a whole within ten of 40
    frames, while what lies below spreads to the right. Pictures, exact flow, and the mask of the first frame."""
    count = 40
    pictures, flow = still_room(rng, frames=count), np.zeros((count - 1, HEIGHT, WIDTH, 2), np.float32)
    above = color + 25.0 * texture(rng, (HEIGHT, WIDTH), sigma=1.5)[..., None]
    first = np.zeros((HEIGHT, WIDTH), bool)
    for t in range(count):
        sunk, right = 3 * min(t, 10), 70 + 2 * t
        upper, lower = (slice(30 + sunk, 65), slice(40, 70)), (slice(65, 100), slice(40, right))
        foam = texture(rng, (HEIGHT, WIDTH), sigma=1.5)[..., None]
        pictures[t][lower] = (np.array([30.0, 120.0, 125.0]) + 40.0 * foam)[lower]
        pictures[t][upper] = shift(above, (sunk, 0, 0), order=1)[upper]
        if t < count - 1:
            flow[t][lower] = rng.normal(scale=2.0, size=(35, right - 40, 2))
            flow[t][upper] = (0.0, 3.0) if t < 10 else (0.0, 0.0)
        if t == 0:
            first[upper] = first[lower] = True
    return pictures, PixelFlow(flow, np.ones(flow.shape[:3], np.float32)), first


def test_what_leaves_as_a_whole_in_the_colors_of_the_fluid_is_fluid():
    pictures, flow, first = sinking_column(np.random.default_rng(5), np.array([30.0, 120.0, 125.0]))
    labels = segment(clip_of(pictures), flow).labels
    top = np.s_[34:60, 44:66]
    assert first[top].all() and (labels[0][top] == Label.FLUID).mean() > 0.9
    assert (labels[-1][34:55, 44:66] == Label.FLUID).mean() < 0.05


def test_what_leaves_as_a_whole_in_other_colors_is_none():
    pictures, flow, _ = sinking_column(np.random.default_rng(5), np.array([205.0, 150.0, 120.0]))  # a hand
    labels = segment(clip_of(pictures), flow).labels
    assert (labels[0][34:55, 44:66] == Label.FLUID).mean() < 0.1
    assert (labels[0][74:92, 44:66] == Label.FLUID).mean() > 0.9
