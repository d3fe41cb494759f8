"""Hands and jugs move in the picture and are no fluid; what deforms, or keeps flowing, is none of them."""

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from fluidlift.motion.optical_flow import DenseInverseSearch, PairsAsTheyAre, flow_of_pair
from fluidlift.shape.evidence import gather_evidence
from fluidlift.shape.moving_solids import SharedPairs, _moving_alike, moving_solids
from fluidlift.types.clip import VideoClip

FRAMES, HEIGHT, WIDTH = 40, 180, 240


def texture(seed: int, shape: tuple[int, int], sigma: float = 1.5) -> np.ndarray:
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), sigma)
    return noise / noise.std()


def room() -> np.ndarray:
    """float [T,H,W], still."""
    return np.repeat((110.0 + 15.0 * texture(0, (HEIGHT, WIDTH), 2.5))[None], FRAMES, axis=0)


def swung(t: int) -> np.ndarray:
    """Similarity [2,3] of a hand that swings to and fro about the middle of the left half, 20 px and 6 degrees."""
    phase = np.sin(2.0 * np.pi * t / 30.0)
    motion = cv2.getRotationMatrix2D((60.0, 90.0), 6.0 * phase, 1.0)
    motion[0, 2] += 20.0 * phase
    return motion


def with_hand(pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pictures with a hand in front, and bool [T,H,W] where it is."""
    hand = (150.0 + 25.0 * texture(1, (HEIGHT, WIDTH))).astype(np.float32)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    outline = (((columns - 60) / 32.0) ** 2 + ((rows - 90) / 45.0) ** 2 < 1.0).astype(np.float32)
    result, where = pictures.copy(), np.zeros(pictures.shape, bool)
    for t in range(FRAMES):
        where[t] = cv2.warpAffine(outline, swung(t), (WIDTH, HEIGHT)) > 0.5
        result[t][where[t]] = cv2.warpAffine(hand, swung(t), (WIDTH, HEIGHT))[where[t]]
    return result, where


def found_in(pictures: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(5)
    noisy = pictures + rng.normal(size=pictures.shape)
    frames = np.clip(noisy, 0, 255).round().astype(np.uint8)[..., None].repeat(3, axis=-1)
    clip, estimator = VideoClip(frames, np.arange(FRAMES) / 25.0), DenseInverseSearch()
    flow = SharedPairs(clip, lambda t: flow_of_pair(frames[t], frames[t + 1], estimator))
    return moving_solids(clip, flow, (HEIGHT, WIDTH))


def test_a_hand_that_swings_is_a_solid_and_the_room_is_none():
    pictures, where = with_hand(room())
    found = found_in(pictures)
    always, ever = where.all(axis=0), where.any(axis=0)
    assert found[always].mean() > 0.9
    around = cv2.dilate(ever.astype(np.uint8), np.ones((21, 21))) == 0  # optical flow spreads beyond an outline
    assert not found[around].any()


def test_an_arm_that_reaches_in_steadily_is_a_solid():
    pictures, look = room(), (150.0 + 25.0 * texture(1, (HEIGHT, WIDTH))).astype(np.float32)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    where = np.zeros(pictures.shape, bool)
    for t in range(FRAMES):
        ahead = columns - 1.2 * t
        hand = ((ahead - 70.0) / 26.0) ** 2 + ((rows - 90.0) / 40.0) ** 2 < 1.0
        moved = cv2.warpAffine(look, np.float32([[1, 0, 1.2 * t], [0, 1, 0]]), (WIDTH, HEIGHT))
        pictures[t], where[t] = np.where(hand, moved, pictures[t]), hand
    found = found_in(pictures)
    assert found[where.all(axis=0)].mean() > 0.9
    around = cv2.dilate(where.any(axis=0).astype(np.uint8), np.ones((21, 21))) == 0
    assert not found[around].any()


def test_a_solid_goes_on_beyond_its_features_as_far_as_its_motion_does_and_not_into_what_moves_otherwise():
    steps, motion = [], np.array([2.0, 0.0], np.float32)
    for _ in range(10):
        step = np.zeros((HEIGHT, WIDTH, 2), np.float32)
        step[60:120, :200] = motion  # a smooth sleeve behind the hand
        step[120:150, :200] = (0.0, 2.0)  # a jet
        steps.append(step)
    features = np.float32([(x, y) for x in (140, 170) for y in (70, 110)])
    motions = [np.float64([[1, 0, 2.0 * t], [0, 1, 0]]) for t in range(11)]
    solid = _moving_alike(motions, steps, features)
    assert solid[65:115, 5:175].mean() > 0.95 and not solid[125:].any() and not solid[:55].any()


def test_a_sheet_of_foam_that_slides_by_is_none_though_it_does_not_deform():
    pictures = room()
    for t in range(FRAMES):
        pictures[t, 100:150] = (120.0 + 30.0 * np.roll(texture(2, (HEIGHT, WIDTH)), 3 * t, axis=1))[100:150]
    assert found_in(pictures).mean() < 0.002


def test_water_that_deforms_as_it_sways_is_none():
    pictures = room()
    a, b = texture(3, (HEIGHT, WIDTH)), texture(4, (HEIGHT, WIDTH))
    for t in range(FRAMES):
        phase = 2.0 * np.pi * t / 10.0  # a look of its own every few frames
        moved = np.cos(phase) * np.roll(a, round(8 * np.sin(phase / 3)), axis=1) + np.sin(phase) * b
        pictures[t, 100:150] = (120.0 + 30.0 * moved)[100:150]
    assert found_in(pictures).mean() < 0.002


def test_a_clip_that_is_too_short_shows_none():
    frames = np.zeros((6, HEIGHT, WIDTH, 3), np.uint8)
    clip = VideoClip(frames, np.arange(6) / 25.0)
    flow = SharedPairs(clip, lambda t: (np.zeros((HEIGHT, WIDTH, 2)), np.ones((HEIGHT, WIDTH))))
    assert not moving_solids(clip, flow, (90, 120)).any()


def test_pairs_that_the_evidence_has_read_are_not_read_again():
    frames, read = np.zeros((40, 30, 40, 3), np.uint8), []

    def flow(t: int) -> tuple[np.ndarray, np.ndarray]:
        read.append(t)
        return np.full((30, 40, 2), 0.1 * t), np.ones((30, 40))

    clip = VideoClip(frames, np.arange(40) / 25.0)
    shared = SharedPairs(clip, flow)
    for t in range(39):
        shared(t)
    moving_solids(clip, shared, (30, 40))
    assert read == list(range(39))
    assert np.allclose(shared.step(20), 2.0, atol=1e-3)  # float16 of a px or two


def test_pairs_read_ahead_are_those_read_one_by_one(monkeypatch):
    """Side by side, for the evidence that asks for all of them in order; and none is read again after that."""
    monkeypatch.setattr("fluidlift.motion.multiframe.cores", lambda: 3)
    rng = np.random.default_rng(8)
    pictures = np.stack([cv2.GaussianBlur(p, (0, 0), 2.0) for p in rng.uniform(0, 255, (40, 60, 80, 3))])
    frames, begun = np.clip(6.0 * (pictures - 127.5) + 127.5, 0, 255).astype(np.uint8), []
    reader = PairsAsTheyAre(frames, DenseInverseSearch())

    class Counted:
        def __call__(self, t):
            begun.append(t)
            return reader(t)

        def in_order(self, pairs):
            begun.extend(pairs)
            return reader.in_order(pairs)

    clip = VideoClip(frames, np.arange(40) / 25.0)
    plain, ahead = SharedPairs(clip, reader), SharedPairs(clip, Counted())
    asked = list(range(0, 39, 2))
    found = list(ahead.in_order(asked))
    assert len(found) == len(asked)
    for t, (displacement, confidence) in zip(asked, found):
        np.testing.assert_array_equal(displacement, plain(t)[0])
        np.testing.assert_array_equal(confidence, plain(t)[1])
    for t in asked:
        np.testing.assert_array_equal(ahead.step(t), plain.step(t))
    assert begun[: len(asked)] == asked
    assert set(begun[len(asked) :]) <= set(asked) - ahead._wanted  # what is asked for again is kept


def test_evidence_reads_flow_ahead_where_the_reader_can():
    """One pair after the other leaves all other processors idle, for most of the time until there is a mask."""
    frames = np.zeros((30, 30, 40, 3), np.uint8)
    frames += np.random.default_rng(0).integers(0, 255, frames.shape, np.uint8)
    asked: list[list[int]] = []

    class Ahead:
        def __call__(self, t):
            raise AssertionError("one by one")

        def in_order(self, pairs):
            asked.append(list(pairs))
            return ((np.zeros((30, 40, 2), np.float32), np.ones((30, 40), np.float32)) for _ in asked[-1])

    clip = VideoClip(frames, np.arange(30) / 25.0)
    gather_evidence(clip, SharedPairs(clip, Ahead()))
    assert asked == [list(range(29))]
