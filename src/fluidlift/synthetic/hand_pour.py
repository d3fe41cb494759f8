"""Small clips of a jug that a hand moves and that pours, with exact masks: what is carried, what falls, what stays.

A jug is carried before a textured ground by a similarity that changes with time. From its spout falls a jet that keeps
its foot in step with the spout, whose look runs down it ever faster (free fall: the place on the jet goes as the root
of what has fallen), and spreads as a heap where it lands. All that is fluid at a frame is the jet and the heap.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

SUPERSAMPLING = 2
"""samples per pixel and axis, so that outlines mix half and half as a lens and a sensor mix them"""
LENS = 0.6
"""px, standard deviation of the blur of a picture that is in focus"""
NOISE = 1.5
"""grey levels, standard deviation of the sensor's noise"""
FALL = 700.0
"""px/s^2, acceleration of what falls: a pour of 30 cm that fills two thirds of a picture of 200 px"""
FRAME_RATE = 25.0
"""1/s"""


@dataclass(frozen=True)
class HandPour:
    """A clip of T frames and what of it is fluid, and what is carried."""

    frames: UInt8[np.ndarray, "t h w 3"]
    """sRGB"""
    fluid: Bool[np.ndarray, "t h w"]
    """jet and heap"""
    carried: Bool[np.ndarray, "t h w"]
    """jug and arm"""


@dataclass(frozen=True)
class _Look:
    """What differs from clip to clip."""

    spout: tuple[float, float]
    """u, v at the middle of the clip, px"""
    step: tuple[float, float]
    """px that the jug goes in the clip"""
    turn: float
    """degrees that it turns in the clip"""
    swing: float
    """px to and fro, across"""
    width: float
    """px, of the jet at the spout"""
    floor: float
    """v on which the heap lies, px"""
    heap: tuple[float, float]
    """half widths of the heap in the first and the last frame, px; it is half as high"""
    colours: np.ndarray
    """[3,3], sRGB of ground, jug and fluid"""
    grain: tuple[float, float, float]
    """grey levels, standard deviation of the pattern on ground, jug and fluid"""


def hand_pour(seed: int, *, frames: int = 30, size: tuple[int, int] = (180, 240)) -> HandPour:
    """A made pour; everything about it follows from the seed.

    Args:
        seed: of its look, its motion and its noise.
        frames: of the clip.
        size: width and height, px.
    """
    rng = np.random.default_rng(seed)
    look, big = _drawn(rng, size), SUPERSAMPLING
    width, height = size[0] * big, size[1] * big
    ground = _painted(rng, look.colours[0], look.grain[0], (height, width), 7.0 * big)
    jug = _painted(rng, look.colours[1], look.grain[1], (height, width), 4.0 * big)
    water = rng.normal(size=(6 * height, width // 4))
    water = ndimage.gaussian_filter(water, (5.0 * big, 1.0 * big))
    water *= look.grain[2] / water.std()
    pictures, fluids, solids = [], [], []
    for t in range(frames):
        motion, spout = _carriage(look, t / (frames - 1), t / FRAME_RATE)
        solid = _jug(look, motion, size)
        fluid, along = _fluid(look, spout, t / (frames - 1), size)
        picture = ground.copy()
        carried = cv2.warpAffine(jug, _scaled(motion), (width, height), borderMode=cv2.BORDER_REFLECT)
        pattern = _falling(water, along, t / FRAME_RATE, fluid)
        picture[fluid] = look.colours[2] + pattern[fluid][:, None]
        picture[solid] = carried[solid]
        fluid &= ~solid
        small = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), LENS) + rng.normal(scale=NOISE, size=(size[1], size[0], 1))
        pictures.append(np.clip(small, 0, 255).round().astype(np.uint8))
        for kept, mask in ((fluids, fluid), (solids, solid)):
            kept.append(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5)
    return HandPour(np.stack(pictures), np.stack(fluids), np.stack(solids))


def _drawn(rng: np.random.Generator, size: tuple[int, int]) -> _Look:
    """A look at random: dark on bright or bright on dark, smooth or textured jugs, thick or thin jets."""
    width, height = size
    bright, dark = rng.uniform(140, 220, 3), rng.uniform(25, 80, 3)
    ground, fluid = (bright, dark) if rng.random() < 0.6 else (dark, bright)
    jug = rng.uniform(60, 230, 3)
    first = rng.uniform(6.0, 10.0)
    return _Look(
        spout=(rng.uniform(0.45, 0.65) * width, rng.uniform(0.3, 0.4) * height),
        step=(rng.uniform(-0.08, 0.08) * width, rng.uniform(-0.07, 0.0) * height),
        turn=rng.uniform(-6.0, 6.0), swing=rng.uniform(0.0, 2.0), width=rng.uniform(4.0, 9.0),
        floor=rng.uniform(0.75, 0.9) * height, heap=(first, first * rng.uniform(1.3, 2.5)),
        colours=np.stack([ground, jug, fluid]),
        grain=(rng.uniform(6, 18), rng.uniform(2, 20), rng.uniform(6, 20)),
    )  # fmt: skip


def _painted(
    rng: np.random.Generator, colour: np.ndarray, grain: float, shape: tuple[int, int], coarse: float
) -> np.ndarray:
    """float32 [h,w,3]: one colour with a pattern of two scales."""
    patterns = [ndimage.gaussian_filter(rng.normal(size=shape), scale) for scale in (coarse, coarse / 4)]
    pattern = sum(pattern / pattern.std() for pattern in patterns)
    return (colour + 0.7 * grain * np.asarray(pattern)[..., None]).astype(np.float32)


def _scaled(motion: np.ndarray) -> np.ndarray:
    """The motion [2,3] in samples."""
    return motion * np.array([[1.0, 1.0, SUPERSAMPLING]])


def _carriage(look: _Look, part: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Motion [2,3] (px) of the jug from its place at the middle of the clip, and its spout [2]."""
    motion = cv2.getRotationMatrix2D(look.spout, look.turn * (part - 0.5), 1.0)
    motion[:, 2] += np.asarray(look.step) * (part - 0.5)
    motion[0, 2] += look.swing * np.sin(2.0 * np.pi * seconds / 0.8)
    return motion, motion @ [*look.spout, 1.0]


def _jug(look: _Look, motion: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """bool [h,w] in samples: a jug whose spout is at its lower right, and the arm that holds it from the left."""
    big = SUPERSAMPLING
    out = np.zeros((size[1] * big, size[0] * big), np.uint8)
    u, v = look.spout
    outline = np.array([(2, 0), (-6, -8), (-14, -26), (-46, -22), (-44, 2), (-26, 12), (-8, 8)], float) + (u, v)
    arm = np.array([(u - 40.0, v - 10.0), (-2.0 * u, v - 40.0)])
    outline, arm = (((p @ motion[:, :2].T + motion[:, 2]) * big).round().astype(np.int32) for p in (outline, arm))
    cv2.fillPoly(out, [outline], 1)
    cv2.line(out, arm[0].tolist(), arm[1].tolist(), 1, 26 * big)
    return out > 0


def _fluid(look: _Look, spout: np.ndarray, part: float, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """bool [h,w] in samples, jet and heap, and float [h,w]: how far below the spout, px."""
    big = SUPERSAMPLING
    rows, columns = np.mgrid[0 : size[1] * big, 0 : size[0] * big]
    u, v = (columns + 0.5) / big, (rows + 0.5) / big
    fallen = v - spout[1]
    # what runs ever faster is ever thinner: width as the root of the root of the height of fall
    half = 0.5 * look.width / (1.0 + np.maximum(fallen, 0.0) / 20.0) ** 0.25
    jet = (np.abs(u - spout[0]) < half) & (fallen > -1.0) & (v < look.floor)
    wide = look.heap[0] + part * (look.heap[1] - look.heap[0])
    heap = ((u - look.spout[0]) / wide) ** 2 + ((v - look.floor) / (0.5 * wide)) ** 2 < 1.0
    return jet | (heap & (v < look.floor)), fallen


def _falling(water: np.ndarray, fallen: np.ndarray, seconds: float, where: np.ndarray) -> np.ndarray:
    """float [h,w]: the pattern that falls: what is `fallen` px below the spout left it sqrt(2 s / g) ago."""
    left = seconds - np.sqrt(2.0 * np.maximum(fallen, 0.0) / FALL)
    row = np.mod((left * 220.0 * SUPERSAMPLING).astype(int), len(water))
    column = np.broadcast_to(np.arange(fallen.shape[1]) % water.shape[1], fallen.shape)
    out = np.zeros(fallen.shape)
    out[where] = water[row[where], column[where]]
    return out
