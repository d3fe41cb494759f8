"""Strips that a stabilizer filled with mirror images, in clips that were moved and filled so."""

import cv2
import numpy as np
import pytest

from fluidlift.shape.mirrored_edges import BESIDE, mirrored_edges

SIZE = (240, 180)


def room(seed=0, *, size=SIZE, grain=2.0):
    """Colours with grain of some px."""
    noise = np.random.default_rng(seed).normal(size=(size[1], size[0], 3))
    noise = cv2.GaussianBlur(noise, (0, 0), grain)
    return np.clip(128.0 + 30.0 * noise / noise.std(), 0, 255).astype(np.uint8)


def moved(shifts, *, tilt=0.0, border=cv2.BORDER_REFLECT, noise=2.0):
    """A room whose frames were shifted (px right, px down) and turned (degrees) and filled; True: filled in a frame."""
    picture, frames, filled = room(), [], np.zeros((SIZE[1], SIZE[0]), bool)
    rng = np.random.default_rng(1)
    for dx, dy in shifts:
        move = cv2.getRotationMatrix2D((0.5 * SIZE[0], 0.5 * SIZE[1]), tilt, 1.0)
        move[:, 2] += (dx, dy)
        frame = cv2.warpAffine(picture, move, SIZE, flags=cv2.INTER_LINEAR, borderMode=border)
        frames.append(np.clip(frame + rng.normal(0.0, noise, frame.shape), 0, 255).astype(np.uint8))
        filled |= cv2.warpAffine(np.ones((SIZE[1], SIZE[0]), np.uint8), move, SIZE, flags=cv2.INTER_NEAREST) == 0
    return np.stack(frames), filled


DRIFT = np.linspace(0.0, 1.0, 9)


@pytest.mark.parametrize("direction", [(0, 14), (0, -14), (14, 0), (-14, 0), (14, -14)])
def test_a_mirrored_strip_is_found_at_any_edge(direction):
    frames, filled = moved(DRIFT[:, None] * np.array(direction))
    found = mirrored_edges(frames)
    assert found[filled].mean() > 0.98
    near = cv2.dilate(filled.astype(np.uint8), np.ones((2 * BESIDE + 3,) * 2)) > 0
    assert not found[~near].any()


@pytest.mark.parametrize("tilt", [-2.5, 1.0])
def test_a_strip_that_is_tilted_is_found(tilt):
    frames, filled = moved(DRIFT[:, None] * np.array([0, -16]), tilt=tilt)
    found = mirrored_edges(frames)
    bottom = np.indices(filled.shape)[0] > SIZE[1] - 12
    assert found[filled & bottom].mean() > 0.9


@pytest.mark.parametrize("border", [cv2.BORDER_REPLICATE, cv2.BORDER_CONSTANT, cv2.BORDER_WRAP])
def test_what_is_filled_in_another_way_is_no_mirror(border):
    frames, _ = moved(DRIFT[:, None] * np.array([0, 14]), border=border)
    assert not mirrored_edges(frames).any()


def test_a_camera_that_stands_has_no_mirrored_edges():
    frames, _ = moved(np.zeros((9, 2)))
    assert not mirrored_edges(frames).any()


@pytest.mark.parametrize("vertical", [False, True])
def test_stripes_and_plain_walls_match_their_reflection_in_any_line_and_are_no_mirror(vertical):
    along = np.indices((SIZE[1], SIZE[0]))[0 if vertical else 1]
    stripes = 128.0 + 60.0 * np.sin(2.0 * np.pi * along / 9.0)
    noise = np.random.default_rng(2).normal(0.0, 2.0, (9, SIZE[1], SIZE[0], 3))
    frames = np.clip(stripes[..., None] + noise, 0, 255).astype(np.uint8)
    assert not mirrored_edges(frames).any()
    assert not mirrored_edges(np.clip(128.0 + noise, 0, 255).astype(np.uint8)).any()


@pytest.mark.parametrize("tilt", [0.0, 3.0])
def test_a_bar_along_the_edge_is_its_own_reflection_and_no_mirror(tilt):
    """Such as a window's frame."""
    row, column = np.indices((SIZE[1], SIZE[0]))
    bar = np.abs(row - 8.5 - np.tan(np.radians(tilt)) * (column - 0.5 * SIZE[0])) < 2.0
    noise = np.random.default_rng(2).normal(0.0, 2.0, (9, SIZE[1], SIZE[0], 3))
    frames = np.clip(np.where(bar, 200.0, 60.0)[..., None] + noise, 0, 255).astype(np.uint8)
    assert not mirrored_edges(frames).any()


def test_a_still_pool_that_mirrors_its_bank_far_from_the_edge_is_none():
    bank = room(3, size=(SIZE[0], SIZE[1] // 2))
    frames = np.stack([np.concatenate([bank, bank[::-1]])] * 9)
    assert not mirrored_edges(frames).any()


def test_one_frame_alone_is_not_believed():
    frames, _ = moved([(0, 14)])
    assert not mirrored_edges(frames).any()


def test_a_clip_too_small_to_tell_has_none():
    assert not mirrored_edges(np.zeros((3, 8, 8, 3), np.uint8)).any()
