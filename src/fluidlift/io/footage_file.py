"""A small film of the fluid that an asset carries: what its surface looks like over time, for simulations without the
clip. One H.264 file, each picture with its mask below it; of smoke its color, with its opacity below it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from fluidlift.errors import InputRejected
from fluidlift.io.encode import write_video
from fluidlift.io.limits import ReadLimits, require_file, require_size
from fluidlift.io.pictures import fitted_size, resample
from fluidlift.io.video import read_clip
from fluidlift.messages import code_of
from fluidlift.numerics.short_axis import least

MOST_FRAMES = 120
"""frames of the clip: four seconds at 30 per second, 0.2 to 1.3 MB at 512 px. Patches of footage last half of it,
longer than foam does"""
LARGEST = 1024
"""px of a picture's longer side: those of a larger clip are scaled down"""
QUALITY = 14.0
"""constant rate factor: errors of one to two levels, below the noise of clips"""
MOST_BYTES = 256 * 2**20
"""of the file: more than any film of `MOST_FRAMES` takes"""
LIMITS = ReadLimits(max_pixels=2 * LARGEST**2 + 16 * LARGEST, max_frames=4 * MOST_FRAMES, max_bytes=2**30)
"""on what is read back; the file may come from a stranger"""


def size_of_film(size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of the pictures that are kept of a clip of some size, px."""
    return fitted_size(size, LARGEST)


def write_footage(
    path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], fluid: Iterable[Bool[np.ndarray, "h w"]], interval: float
) -> Path:
    """Write pictures (sRGB), and where they show fluid, `interval` seconds apart.

    Raises:
        InputRejected: the disk is full or may not be written.
        ValueError: no frames.
    """
    return _write(path, zip(frames, (255 * m.astype(np.uint8) for m in fluid), strict=True), interval)


def write_smoke(
    path: Path, layers: Iterable[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]], interval: float
) -> Path:
    """Write colors (sRGB) and opacities (of 255) of smoke, `interval` seconds apart.

    Raises:
        InputRejected: the disk is full or may not be written.
        ValueError: no frames.
    """
    return _write(path, layers, interval)


def _write(path: Path, pairs: Iterable[tuple[np.ndarray, np.ndarray]], interval: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)

    def stacked(picture: np.ndarray, below: np.ndarray) -> np.ndarray:
        size = size_of_film((below.shape[1], below.shape[0]))
        marks = np.repeat(below[..., None], 3, axis=-1)
        return np.concatenate([_even_sides(resample(np.asarray(p), size)) for p in (picture, marks)])

    return write_video(path, (stacked(*pair) for pair in pairs), 1.0 / interval, quality=QUALITY, repeatable=True)


def read_footage(path: Path, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, float]:
    """Pictures u8 [T,H,W,3], masks bool [T,H,W] and the seconds between frames.

    Args:
        path: as `write_footage` wrote it.
        size: px of the clip (width, height); the pictures have it, up to `LARGEST`.

    Raises:
        InputRejected: not such a file, one that lacks frames, or larger than an asset's film may be.
    """
    frames, below, interval = read_smoke(path, size)
    return frames, below > 127, interval


def read_smoke(path: Path, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, float]:
    """Colors u8 [T,H,W,3] and opacities u8 [T,H,W] of smoke, as `write_smoke` wrote them, and the seconds between
    frames. See `read_footage`."""
    require_file(path, "film")
    require_size(path, MOST_BYTES, "film")
    clip = read_clip(path, max_size=2 * LARGEST + 16, limits=LIMITS)
    if {"file-cut-off", "frames-damaged"} & {code_of(note) for note in clip.warnings}:
        raise InputRejected(f"'{path.name}' is damaged or cut off", "a whole film", "make the asset again")
    width, height = size_of_film(size)
    rows = height + height % 2
    if clip.size != (width + width % 2, 2 * rows):
        raise InputRejected(
            f"a film of {clip.size[0]} x {clip.size[1]} px in '{path.name}'",
            f"one of {width + width % 2} x {2 * rows} px, the camera's picture and its mask",
            "make the asset again",
        )
    frames = np.asarray(clip.frames)
    below = least(frames[:, rows : rows + height, :width])
    return np.ascontiguousarray(frames[:, :height, :width]), below, float(clip.interval)


def _even_sides(picture: np.ndarray) -> np.ndarray:
    """With its last row and column doubled where their number is odd, as 4:2:0 needs it."""
    return np.pad(picture, [(0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)], mode="edge")
