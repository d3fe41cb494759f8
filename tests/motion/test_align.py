"""The picture is laid on its reference to a fraction of a pixel, whatever flows through it."""

import cv2
import numpy as np
import pytest

from fluidlift.motion.align import refined_similarity
from fluidlift.motion.stabilize import GreyFrames, stabilise
from fluidlift.types import VideoClip

SIZE = (240, 160)


def texture(seed: int, size: tuple[int, int] = SIZE, sigma: float = 2.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    grey = cv2.GaussianBlur(rng.uniform(0, 255, size[::-1]).astype(np.float32), (0, 0), sigma)
    return np.clip((grey - grey.mean()) / grey.std() * 40 + 128, 0, 255)


def similarity(dx: float, dy: float, degrees: float, zoom: float) -> np.ndarray:
    """About the middle of the picture."""
    motion = cv2.getRotationMatrix2D((SIZE[0] / 2, SIZE[1] / 2), degrees, zoom)
    motion[:, 2] += dx, dy
    return motion


def shot(motion: np.ndarray, *, fluid: int | None = None, share: float = 0.4, noise: float = 2.0) -> np.ndarray:
    """u8: the scene seen by a camera that moved; `fluid` is the texture of the flowing part (None: all stands)."""
    scene = texture(0)
    if fluid is not None:
        scene = scene.copy()
        rows = slice(round(SIZE[1] * (1 - share)), None)
        scene[rows] = texture(fluid)[rows]
    seen = cv2.warpAffine(scene.astype(np.float32), motion, SIZE, borderMode=cv2.BORDER_REFLECT)
    rng = np.random.default_rng(0 if fluid is None else fluid)
    return np.clip(seen + rng.normal(0, noise, seen.shape), 0, 255).astype(np.uint8)


def distance(found: np.ndarray, true: np.ndarray) -> float:
    """Largest distance of the corners, px."""
    corners = np.array([[0, 0], [SIZE[0], 0], [0, SIZE[1]], SIZE], float)
    return float(np.linalg.norm(corners @ (found - true)[:, :2].T + (found - true)[:, 2], axis=-1).max())


@pytest.mark.parametrize(
    "true", [(0.0, 0.0, 0.0, 1.0), (0.4, -0.3, 0.0, 1.0), (1.7, 1.2, 0.3, 1.0), (-0.8, 0.5, -0.4, 1.006)]
)
def test_a_camera_motion_is_found_to_a_tenth_of_a_pixel_beside_a_fluid_without_any_likeness(true):
    still, moved = similarity(0, 0, 0, 1), similarity(*true)
    found, fit, cells = refined_similarity(shot(still, fluid=1), shot(moved, fluid=2), still)
    # sensor noise of 2 grey levels over some ten thousand pixels with gradients of 10: far below; blur sets the rest
    assert distance(found, moved) < 0.1
    assert 0.5 < fit < 0.8  # three fifths of the picture stand still
    assert cells >= 24


def test_where_the_fluid_has_the_larger_part_the_agreement_says_so():
    still = similarity(0, 0, 0, 1)
    _, fit, _ = refined_similarity(shot(still, fluid=1, share=0.8), shot(still, fluid=2, share=0.8), still)
    assert fit < 0.5


def test_a_picture_without_texture_keeps_the_guess():
    flat, guess = np.full((160, 240), 90, np.uint8), similarity(1, 0, 0, 1)
    found, fit, cells = refined_similarity(flat, flat, guess)
    assert np.array_equal(found, guess) and fit == 0.0 and cells == 0


def test_a_slow_drift_of_a_hand_is_taken_out():
    path = [similarity(0.06 * t, 1.5 * np.sin(t / 9), 0.02 * t, 1.0) for t in range(30)]
    frames = np.stack([np.repeat(shot(m, fluid=3 + t)[..., None], 3, -1) for t, m in enumerate(path)])
    steady, report = stabilise(VideoClip(frames, np.arange(30) / 25.0, "hand.mp4"))
    assert report.stabilised and not report.warnings
    left = [refined_similarity(a, b, similarity(0, 0, 0, 1))[0] for a, b in _with_middle(GreyFrames(steady.frames))]
    # resampling blurs by up to half a pixel differently in each frame: a tenth of a pixel, of a drift of over one
    assert max(distance(m, similarity(0, 0, 0, 1)) for m in left) < 0.25


def _with_middle(grey: GreyFrames) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(grey[len(grey) // 2], grey[t]) for t in range(len(grey))]
