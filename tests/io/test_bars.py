"""Bars are black, flat in every frame, on both sides and straight; everything else is a part of the picture."""

import cv2
import numpy as np
import pytest

from fluidlift.io.bars import PictureWindow, between_bars, find_bars
from fluidlift.types import VideoClip


def scene(frames: int = 8, size: tuple[int, int] = (160, 96), seed: int = 0) -> np.ndarray:
    """Frames u8 [T,H,W,3] of a texture that drifts."""
    rng = np.random.default_rng(seed)
    wide = cv2.GaussianBlur(rng.uniform(0, 255, (size[1], size[0] + frames)).astype(np.float32), (0, 0), 1.5)
    wide = np.clip((wide - wide.mean()) / wide.std() * 40 + 110, 0, 255).astype(np.uint8)
    return np.stack([np.repeat(wide[:, t : t + size[0], None], 3, -1) for t in range(frames)])


def barred(frames: np.ndarray, rows: tuple[int, int], columns: tuple[int, int], level: int = 0) -> np.ndarray:
    """With bars of so many rows and columns."""
    return np.pad(frames, ((0, 0), rows, columns, (0, 0)), constant_values=level)


@pytest.mark.parametrize(
    ("rows", "columns"), [((20, 20), (0, 0)), ((0, 0), (60, 61)), ((9, 8), (12, 12)), ((3, 3), (0, 0))]
)
def test_what_lies_between_bars_is_found_to_the_pixel_beside_their_edges(rows, columns):
    frames = barred(scene(), rows, columns, level=2)
    window = find_bars(frames)
    assert window is not None
    inside = window.of(frames[0])
    lost = [int(b > 0) for b in (*rows, *columns)]
    assert inside.shape[:2] == (96 - lost[0] - lost[1], 160 - lost[2] - lost[3])
    assert np.array_equal(inside, scene()[0][lost[0] : 96 - lost[1], lost[2] : 160 - lost[3]])


def test_bars_that_a_coder_has_blurred_and_made_noisy_are_found():
    frames = barred(scene(), (20, 20), (0, 0)).astype(float)
    rng = np.random.default_rng(3)
    frames = np.stack([cv2.GaussianBlur(f, (0, 0), 0.5) for f in frames]) + rng.normal(0, 2, frames.shape)
    window = find_bars(np.clip(frames, 0, 255).astype(np.uint8))
    assert window is not None
    assert window.top == pytest.approx(20 / 136, abs=2.1 / 136)
    assert window.bottom == pytest.approx(116 / 136, abs=2.1 / 136)


def test_a_picture_without_bars_is_left_whole():
    assert find_bars(scene()) is None


def test_a_dark_ground_on_one_side_alone_is_a_part_of_the_picture():
    assert find_bars(barred(scene(), (30, 0), (0, 0))) is None
    assert find_bars(barred(scene(), (40, 15), (0, 0))) is None


def test_gray_and_white_borders_are_parts_of_the_picture():
    assert find_bars(barred(scene(), (20, 20), (0, 0), level=60)) is None
    assert find_bars(barred(scene(), (20, 20), (0, 0), level=255)) is None


def test_where_anything_ever_shows_in_a_bar_it_is_none():
    frames = barred(scene(), (20, 20), (0, 0))
    frames[5, 4:12, 60:90] = 220  # words, or a jet that begins later
    assert find_bars(frames) is None


def jet_before_black(narrowing: float) -> np.ndarray:
    """A bright round jet down the middle of a black picture, narrower below."""
    frames = np.zeros((8, 120, 160, 3), np.uint8)
    for y in range(120):
        half = 40 - narrowing * y / 120
        frames[:, y, int(80 - half) : int(80 + half)] = 190
    return frames


def test_a_jet_before_black_is_no_picture_between_bars():
    assert find_bars(jet_before_black(15.0)) is None


def test_smoke_before_black_is_left_whole():
    y, x = np.mgrid[0:120, 0:160]
    puff = 200 * np.exp(-(((x - 80) / 20.0) ** 2) - (((y - 70) / 30.0) ** 2))
    frames = np.repeat(np.repeat(puff.astype(np.uint8)[None, ..., None], 3, -1), 6, 0)
    assert find_bars(frames) is None


def test_a_black_clip_has_no_picture_between():
    assert find_bars(np.zeros((4, 60, 80, 3), np.uint8)) is None


def test_a_window_takes_whole_pixels_at_any_size():
    window = PictureWindow(0.25, 1 / 6, 0.75, 5 / 6)
    assert window.size((640, 360)) == (320, 240)
    assert window.of(np.zeros((36, 64, 3))).shape == (24, 32, 3)
    with pytest.raises(ValueError, match="window"):
        PictureWindow(0.5, 0.0, 0.5, 1.0)


def test_a_clip_is_read_again_between_its_bars_and_else_once():
    frames, asked = barred(scene(), (20, 20), (0, 0)), []

    def decode(window: PictureWindow | None = None) -> VideoClip:
        asked.append(window)
        kept = frames if window is None else np.stack([window.of(f) for f in frames])
        return VideoClip(kept, np.arange(len(kept)) / 25.0)

    clip, bars = between_bars(decode)
    assert clip.size == (160, 94) and bars is not None and asked == [None, bars]
    frames, asked = scene(), []
    clip, bars = between_bars(decode)
    assert clip.size == (160, 96) and bars is None and asked == [None]
