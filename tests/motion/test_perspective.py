"""The focal length of a camera that turns, from what its turns do to the picture."""

import cv2
import numpy as np
import pytest

from fluidlift.motion.camera_motion import camera_motion
from fluidlift.motion.perspective import Pair, perspective_of
from fluidlift.motion.stabilize import shake_and_drift, stabilise
from fluidlift.numerics.homography2 import carried, turned
from fluidlift.types.clip import VideoClip

SIZE = (192, 256)
MIDDLE = 0.5 * (np.array(SIZE) - 1.0)
FRAMES = 13
TILTS = 2.0 * (np.arange(FRAMES) - FRAMES // 2)
"""px"""
FOCAL = 270.0


def pairs(perspective: float, *, flowing: float = 0.0, shift: float = 20.0) -> list[Pair]:
    """Features of six pairs of frames, found to 0.2 px; a share of them flows on by some px besides."""
    rng, made = np.random.default_rng(4), []
    for k in range(6):
        here = rng.uniform([5, 5], [SIZE[0] - 5, SIZE[1] - 5], (160, 2))
        motion = turned(np.array([shift * np.sin(k), shift * np.cos(k), 0.002, 0.003]), perspective, MIDDLE)
        there = carried(motion, here) + rng.normal(0.0, 0.2, here.shape)
        flows = rng.random(len(here)) < flowing
        there[flows, 1] += rng.uniform(1.0, 4.0, flows.sum())
        middle = carried(motion, MIDDLE) - MIDDLE
        guess = np.array([[1.0, 0.0, middle[0]], [0.0, 1.0, middle[1]], [0.0, 0.0, 1.0]])
        made.append(Pair(here, there, guess))
    return made


@pytest.mark.parametrize("flowing", [0.0, 0.4])
def test_a_turn_tells_the_focal_length(flowing):
    found = perspective_of(pairs(FOCAL**-2, flowing=flowing), SIZE)
    # 20 px bend the corners by 5: a thousand features of 0.2 px tell that to 1 %, and the focal length by half of it
    assert found**-0.5 == pytest.approx(FOCAL, rel=0.03)


def test_a_slide_before_a_wall_shows_no_perspective():
    assert perspective_of(pairs(0.0), SIZE) == 0.0
    assert perspective_of(pairs(0.0, flowing=0.4), SIZE) == 0.0


def test_a_turn_too_small_to_tell_shows_none():
    assert perspective_of(pairs(FOCAL**-2, shift=0.5), SIZE) == 0.0
    assert perspective_of([], SIZE) == 0.0


def filmed(tilts: np.ndarray, *, turns: bool) -> tuple[np.ndarray, np.ndarray]:
    """A fall over half of the picture before a camera that tilts (or slides) by px per frame, and its homographies."""
    rng, (width, height) = np.random.default_rng(2), SIZE
    wide = (2 * height, 2 * width)

    def texture() -> np.ndarray:
        parts = [cv2.GaussianBlur(rng.normal(size=wide).astype(np.float32), (0, 0), s) for s in (1.5, 4.0, 12.0)]
        return np.sum([w * p / p.std() for w, p in zip((12.0, 18.0, 18.0), parts)], axis=0)

    rock, water, shown, motions = 110.0 + texture(), texture(), [], []
    band = cv2.GaussianBlur((np.abs(np.arange(wide[1]) - width) < 0.25 * width).astype(np.float32)[None], (0, 0), 4.0)
    away = np.array([[1.0, 0.0, -0.5 * width], [0.0, 1.0, -0.5 * height], [0.0, 0.0, 1.0]])
    keep = np.exp(-1.0 / 8.0)  # it has another look after eight frames
    for tilt in tilts:
        water = keep * np.roll(water, 5, axis=0) + np.sqrt(1.0 - keep**2) * texture()
        motion = turned(np.array([0.0, tilt, 0.0, 0.0]), FOCAL**-2 if turns else 0.0, MIDDLE)
        scene = rock * (1.0 - band) + band * (150.0 + 1.3 * water)
        shown.append(cv2.warpPerspective(scene, motion @ away, SIZE, flags=cv2.INTER_CUBIC))
        motions.append(motion)
    noisy = np.stack(shown) + rng.normal(0.0, 2.0, (len(tilts), height, width))
    reference = np.linalg.inv(motions[len(tilts) // 2])
    return np.clip(noisy, 0, 255).round().astype(np.uint8), np.stack([m @ reference for m in motions])


@pytest.mark.parametrize("turns", [True, False])
def test_a_camera_that_tilts_or_slides_before_a_fall_is_followed_to_its_corners(turns):
    grey, true = filmed(TILTS, turns=turns)
    found = camera_motion(list(grey), limit=40.0)
    assert found is not None
    corners = np.array([[0, 0], [SIZE[0], 0], [0, SIZE[1]], SIZE], float)
    errors = [np.linalg.norm(carried(a, corners) - carried(b, corners), axis=-1).max() for a, b in zip(found, true)]
    # as features and grey levels place it; without perspective the corners of a turn are 4 px off
    assert max(errors) < 0.2


def test_a_tilt_over_a_fall_is_taken_out():
    grey, true = filmed(TILTS, turns=True)
    clip = VideoClip(grey[..., None].repeat(3, axis=-1), np.arange(FRAMES) / 30.0)
    steady, report = stabilise(clip)
    assert report.stabilised and report.drift_px == pytest.approx(shake_and_drift(true, *SIZE, ())[1], abs=0.2)
    rock = np.abs(np.arange(SIZE[0]) - 0.5 * SIZE[0]) > 0.4 * SIZE[0]
    off = np.abs(steady.frames[..., 0].astype(float) - grey[FRAMES // 2])[:, 20:-20, rock]
    assert np.median(off) < 4.0, "grey levels: twice the noise of 2, and what resampling leaves of the finest detail"
