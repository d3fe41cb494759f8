"""Letterbox and pillarbox: flat black bars that editing put beside a picture, and the picture between them.

What lies in a bar is no scene. Left in, it is taken for ground that stands still: a black wall around the fluid, a
horizon where there is none, and a picture that is smaller than it need be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Num, UInt8

from fluidlift.errors import require
from fluidlift.types import VideoClip

BLACK = 24
"""levels of 255 of a bar's color at most: black of limited range that was not expanded is 16"""
FLAT = 16
"""levels of 255 that a pixel of a bar differs from its color at most. Beside ten real clips its pixels come out of x264
with up to 12 at constant rate factors of 18 and 28, up to 21 at 36, and out of MJPEG with up to 11"""
LEAST = 2
"""px of the working picture: a thinner bar is a row that two pixels share"""
ALIKE = 0.1
"""of the picture's side, by which two opposite bars differ at most: editing centers a picture"""
SMALLEST = 0.24
"""of the picture's side that lies between bars at least: 9:16 in 21:9"""
STRAIGHT = 0.8
"""of an edge, along which a bar ends within a pixel of its line; the rest may be dark scene, or a bar across (of bars
on all sides only narrow ones are found). A jet before black is round, and narrows as it falls; the rim of a glass is no
longer than the glass is wide"""
SAMPLES = 48
"""frames, spread over the clip, that must agree: what moves there, or appears later, makes it no bar"""


@dataclass(frozen=True)
class PictureWindow:
    """A part of a picture, in shares of its width and height."""

    left: float
    top: float
    right: float
    bottom: float

    def __post_init__(self) -> None:
        require(
            0 <= self.left < self.right <= 1 and 0 <= self.top < self.bottom <= 1, f"a window {self}", "inside 0..1"
        )

    def of(self, picture: Num[np.ndarray, "h w *c"]) -> Num[np.ndarray, "h2 w2 *c"]:
        """This part of a picture: whole pixels that lie inside."""
        rows, columns = self._pixels(picture.shape[0], picture.shape[1])
        return picture[rows, columns]

    def size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Width and height of this part of a picture of that width and height, px."""
        rows, columns = self._pixels(size[1], size[0])
        return columns.stop - columns.start, rows.stop - rows.start

    def _pixels(self, height: int, width: int) -> tuple[slice, slice]:
        rows = slice(int(np.ceil(self.top * height - 1e-6)), int(np.floor(self.bottom * height + 1e-6)))
        return rows, slice(int(np.ceil(self.left * width - 1e-6)), int(np.floor(self.right * width + 1e-6)))


def find_bars(frames: UInt8[np.ndarray, "t h w 3"]) -> PictureWindow | None:
    """What lies between black bars that stay all through a clip; None where there are none.

    A bar reaches from one side of the picture to the other, is flat in every frame, has one like it on the opposite
    side, and ends in a straight line.

    Args:
        frames: sRGB.
    """
    height, width = frames.shape[1:3]
    picked = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), SAMPLES)).astype(int))
    color = np.median(frames[picked][:, [0, 0, -1, -1], [0, -1, 0, -1]].reshape(-1, 3), axis=0)
    if color.max() > BLACK:
        return None
    far = np.zeros((height, width), np.int16)  # largest difference from the color, over time
    for k in picked:
        np.maximum(far, np.abs(frames[k].astype(np.int16) - color.astype(np.int16)).max(axis=-1), out=far)
    rows, columns = slice(0, height), slice(0, width)
    for _ in range(2):  # those of one direction hide where the others end
        rows = _between(far[:, columns]) or rows
        columns = _between(far[rows].T) or columns
    if (rows, columns) == (slice(0, height), slice(0, width)):
        return None
    return PictureWindow(columns.start / width, rows.start / height, columns.stop / width, rows.stop / height)


def between_bars(decode: Callable[..., VideoClip]) -> tuple[VideoClip, PictureWindow | None]:
    """A clip without the bars beside its picture, and what was kept of it; None: it has none.

    Args:
        decode: reads it, and of each picture the `window` where it is given one, as `io.video.read_clip` does.
    """
    found = decode()
    bars = find_bars(found.frames)
    return (found, None) if bars is None else (decode(window=bars), bars)


def _between(far: np.ndarray) -> slice | None:
    """Lines [n] between two bars of lines, without the one at each edge that may show both; None: no bars."""
    first, last = _bar(far), _bar(far[::-1])
    if first is None or last is None or abs(first - last) > ALIKE * len(far):
        return None
    found = slice(first + 1, len(far) - last - 1)
    return found if found.stop - found.start >= SMALLEST * len(far) else None


def _bar(far: np.ndarray) -> int | None:
    """Lines of the bar at the beginning of [n lines, m], from how far each pixel is from its color; None: no bar."""
    lit = far > FLAT
    ends = np.where(lit.any(axis=0), lit.argmax(axis=0), len(far))
    count = int(np.median(ends))
    if not LEAST <= count < len(far) or ends.min() < count - 1:
        return None
    straight = float((np.abs(ends - count) <= 1).mean())
    return count if straight >= STRAIGHT else None
