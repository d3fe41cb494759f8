"""Combing is seen where something moves between the fields, and nowhere else."""

import cv2
import numpy as np
import pytest

from fluidlift.io.interlace import first_field, is_combed


def moving(instants: int, step: float, *, sigma: float = 1.2, noise: float = 2.0) -> list[np.ndarray]:
    """Instants u8 [H,W,3] of a texture that goes to the right by `step` px each."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.uniform(0, 255, (96, 400)).astype(np.float32), (0, 0), sigma)
    wide = (wide - wide.mean()) / wide.std() * 45 + 128
    out = []
    for t in range(instants):
        shift = np.array([[1, 0, -60 + t * step], [0, 1, 0]], np.float32)
        grey = cv2.warpAffine(wide, shift, (160, 96)) + rng.normal(0, noise, (96, 160))
        out.append(np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, -1))
    return out


def woven(instants: list[np.ndarray]) -> list[np.ndarray]:
    """Frames whose even rows show one instant and whose odd rows show the next."""
    frames = []
    for even, odd in zip(instants[::2], instants[1::2]):
        frame = even.copy()
        frame[1::2] = odd[1::2]
        frames.append(frame)
    return frames


@pytest.mark.parametrize("step", [2.0, 4.0])
def test_rows_of_two_instants_are_combed_and_whole_frames_are_not(step):
    instants = moving(12, step)
    assert is_combed(woven(instants)) is True
    assert is_combed(instants) is False


def test_noise_of_the_camera_is_not_taken_for_combing():
    rng = np.random.default_rng(1)
    assert is_combed([rng.integers(0, 256, (64, 64, 3), np.uint8) for _ in range(4)]) is False


def test_sharpened_frames_are_not_taken_for_combing():
    """Sharpening raises the curvature of rows beyond that of noise, and that of columns as much."""
    sharp = [
        np.clip(4.0 * p - 3.0 * cv2.GaussianBlur(p, (0, 0), 1.0), 0, 255).astype(np.uint8)
        for p in moving(8, 4.0, sigma=0.4)
    ]
    assert is_combed(sharp) is False


def test_slow_motion_between_the_fields_is_seen_in_fine_texture():
    assert is_combed(woven(moving(12, 2.0, sigma=1.0, noise=0.0))) is True


def test_a_still_picture_tells_nothing():
    picture = moving(1, 0.0, noise=0.0)[0]
    assert is_combed([picture, picture, picture]) is None


def test_a_field_is_one_instant_again():
    frames = woven(moving(12, 4.0))
    assert first_field(frames[0]).shape == (48, 160, 3)
    assert is_combed([first_field(f) for f in frames]) is False
