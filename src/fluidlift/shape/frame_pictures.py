"""Small steady pictures of a clip of any length: a bounded sample kept, the other frames made when asked for."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from fluidlift.numerics.over_time import median_over_time

MOST_SAMPLED = 150
"""frames whose pictures are kept: the spread of an average over them is below a tenth of that of one frame"""
BURST_SECONDS = 1.0
"""length of a run of neighbouring frames in the sample of a long clip: five times the slowest lag that is measured"""
SHORTEST_BURST, LONGEST_BURST = 16, 50
"""frames"""


OPPONENT = np.array([[0.299, 0.587, 0.114], [0.5, 0.0, -0.5], [-0.25, 0.5, -0.25]], np.float32)
"""brightness and two colour differences of red, green and blue"""


def opponent(frames: np.ndarray) -> np.ndarray:
    """Brightness and two colour differences, float32 [...,3] of u8 [...,3] sRGB; linear, so noise stays noise."""
    return cv2.transform(frames.astype(np.float32), OPPONENT)


def shown(picture: np.ndarray) -> np.ndarray:
    """u8 [h,w,3], sRGB, of opponent colours, float32 [h,w,3]."""
    return np.clip(np.rint(cv2.transform(picture, np.linalg.inv(OPPONENT))), 0.0, 255.0).astype(np.uint8)


def working_scale(height: int, width: int, *, longest: int = 384) -> float:
    """Factor (at most 1) that brings the longer side to `longest` px."""
    return min(1.0, longest / max(height, width))


def shrink(picture: np.ndarray, scale: float) -> np.ndarray:
    """The picture at working size (area mean)."""
    if scale == 1.0:
        return picture
    height, width = _shrunk(picture.shape[0], picture.shape[1], scale)
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def working_size(height: int, width: int) -> tuple[int, int]:
    """Height and width of pictures at working size, px."""
    return _shrunk(height, width, working_scale(height, width))


def _shrunk(height: int, width: int, scale: float) -> tuple[int, int]:
    return (height, width) if scale == 1.0 else (max(round(height * scale), 8), max(round(width * scale), 8))


def typical_picture(pictures: np.ndarray, *, most: int = 31) -> np.ndarray:
    """Temporal median, float32 [h,w,3], of at most `most` evenly spaced pictures."""
    pick = np.unique(np.linspace(0, len(pictures) - 1, min(most, len(pictures))).round().astype(int))
    return median_over_time(pictures[pick].astype(np.float32))


def burst_length(frames: int, interval: float, *, most: int = MOST_SAMPLED) -> int:
    """Frames that follow each other in the sample of a clip of `frames` frames, `interval` s apart."""
    if frames <= most:
        return frames
    return int(np.clip(round(BURST_SECONDS / interval), SHORTEST_BURST, min(LONGEST_BURST, most)))


def sampled_frames(frames: int, interval: float, *, most: int = MOST_SAMPLED) -> np.ndarray:
    """Numbers of the frames to look at, int [S], increasing: all of a short clip, bursts spread over a long one.

    Neighbours stay neighbours within a burst, so that change over short lags is measured as in a short clip.

    Args:
        frames: of the clip.
        interval: s between frames.
        most: of them to take, about.
    """
    length = burst_length(frames, interval, most=most)
    if length == frames:
        return np.arange(frames)
    starts = np.linspace(0, frames - length, max(most // length, 1)).round().astype(int)
    return np.unique(starts[:, None] + np.arange(length))


class FramePictures:
    """Opponent colours at working size, lightly smoothed, without global flicker, of any frame of a clip.

    A lamp that flickers multiplies every pixel by nearly the same factor: the median ratio to the median picture.
    """

    def __init__(self, frames: np.ndarray, sampled: np.ndarray, scale: float) -> None:
        """Makes the pictures of the sample.

        Args:
            frames: u8 [T,H,W,3], sRGB; may be a memory map.
            sampled: int [S], frames whose pictures are kept.
            scale: of the working size, at most 1.
        """
        self._frames, self._scale = frames, scale
        self.sampled = sampled
        self.kept = np.stack([self._raw(t) for t in sampled])
        """float16 [S,h,w,3]"""
        self._reference = typical_picture(self.kept)[..., 0]
        self._lit = self._reference > 16.0
        for picture in self.kept:
            self._without_flicker(picture)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, t: int) -> np.ndarray:
        """float16 [h,w,3] of frame t."""
        if not 0 <= t < len(self):
            raise IndexError(t)
        place = int(np.searchsorted(self.sampled, t))
        if place < len(self.sampled) and self.sampled[place] == t:
            return self.kept[place]
        return self._without_flicker(self._raw(t))

    @cached_property
    def typical(self) -> np.ndarray:
        """float32 [h,w,3]: median of the sample, made once for all that ask (they must not write into it)."""
        found = typical_picture(self.kept)
        found.setflags(write=False)
        return found

    def _raw(self, t: int) -> np.ndarray:
        small = shrink(np.ascontiguousarray(self._frames[t]), self._scale)
        return cv2.GaussianBlur(opponent(small), (0, 0), 0.8).astype(np.float16)

    def _without_flicker(self, picture: np.ndarray) -> np.ndarray:
        if self._lit.mean() > 0.1:
            gain = float(np.median(picture[..., 0][self._lit] / self._reference[self._lit]))
            if abs(gain - 1.0) > 0.004 and 0.25 < gain < 4.0:
                picture /= np.float16(gain)
        return picture

    def pairs(self, lag: int) -> np.ndarray:
        """int [n,2]: places in the sample that lie `lag` frames apart."""
        place = np.minimum(np.searchsorted(self.sampled, self.sampled + lag), len(self.sampled) - 1)
        found = np.flatnonzero(self.sampled[place] == self.sampled + lag)
        return np.stack([found, place[found]], axis=1)
