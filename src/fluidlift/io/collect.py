"""Decoded frames become a clip: which are kept, how large, and where they lie meanwhile."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.bars import PictureWindow
from fluidlift.io.decode import Notes
from fluidlift.io.limits import ReadLimits
from fluidlift.io.pictures import fitted_size, resample_with_alpha, same_shape
from fluidlift.messages import Notice
from fluidlift.types import VideoClip
from fluidlift.types.clip import is_variable

REPEATED = "repeated-frames"
"""code of the warning about frames that are the same as the one before"""
MIN_SIDE = 16
"""px; below it nothing can be seen to move"""


class Growing(Protocol):
    """An array to which items are appended."""

    def append(self, item: np.ndarray) -> None:
        """One more item."""

    def close(self) -> np.ndarray:
        """The whole array."""
        ...


class FrameStore(Protocol):
    """Where decoded frames go instead of into memory (`io.stage_cache.Scratch` is one)."""

    def growing(self, name: str, shape: tuple[int, ...], dtype: Any) -> Growing:
        """A new array of items of one shape, empty."""
        ...


@dataclass(frozen=True)
class FrameSelection:
    """Which frames of a file are kept, and how large."""

    name: str
    start: float
    """s"""
    end: float
    """s"""
    max_size: int
    """px"""
    window: PictureWindow | None = None
    """the part of each picture that is kept; None: all of it"""


class _InMemory:
    """Pictures in a list, until they become one array."""

    def __init__(self) -> None:
        self.pictures: list[Any] = []

    def growing(self, name: str, shape: tuple[int, ...], dtype: Any) -> _InMemory:
        """Another list."""
        return _InMemory()

    def append(self, item: np.ndarray) -> None:
        """One more picture."""
        self.pictures.append(item)

    def close(self) -> np.ndarray:
        """One array; each picture is let go as soon as it is copied, so that memory is not needed twice."""
        out = np.empty((len(self.pictures), *self.pictures[0].shape), np.uint8)
        for i in range(len(self.pictures)):
            out[i], self.pictures[i] = self.pictures[i], None
        return out


class Collector:
    """Keeps the wanted frames, small; everything else passes by."""

    def __init__(self, wanted: FrameSelection, limits: ReadLimits, notes: Notes, store: FrameStore | None) -> None:
        self.name, self.start, self.end, self.max_size = wanted.name, wanted.start, wanted.end, wanted.max_size
        self.window = wanted.window
        self.limits, self.notes = limits, notes
        self.in_memory = store is None
        self.store: FrameStore = store or _InMemory()
        self.frames: Growing | None = None
        self.alphas: Growing | None = None
        self.alpha_count, self.least_alpha = 0, 255
        self.times: list[float] = []
        self.last_seen = -math.inf
        self.last_frame: np.ndarray | None = None
        self.size: tuple[int, int] | None = None
        self.repeated = 0

    def wants(self, time: float) -> bool:
        """Whether the frame at `time` (s) is to be kept. Half a microsecond absorbs the rounding of time stamps."""
        if time <= self.last_seen:
            self.notes.add(Notice("times-not-increasing", "frames with times that do not increase were left out"))
            return False
        self.last_seen = time
        return self.start - 5e-7 <= time < self.end - 5e-7

    def add(self, time: float, rgb: np.ndarray, alpha: np.ndarray | None, shape: tuple[int, int]) -> None:
        """Keep a frame; `shape` is its size (width, height) with square pixels."""
        if self.window is not None:
            rgb, alpha = self.window.of(rgb), None if alpha is None else self.window.of(alpha)
            shape = self.window.size(shape)
        if self.size is None:
            self.size = fitted_size(shape, self.max_size)
            if min(self.size) < MIN_SIDE:
                raise InputRejected(f"the frames of '{self.name}' are {shape[0]} x {shape[1]} px", f"{MIN_SIDE} px")
        elif not same_shape(shape, self.size):
            self.notes.add(
                Notice(
                    "frame-size-changes",
                    "the frame size changes inside the clip; later frames were stretched to the first size",
                )
            )
        self._require_room(self.size)
        rgb, alpha = resample_with_alpha(rgb, alpha, self.size)
        self.repeated += self.last_frame is not None and np.array_equal(rgb, self.last_frame)
        if self.frames is None:
            self.frames = self.store.growing("decoded", rgb.shape, np.uint8)
        self.frames.append(rgb)
        self.last_frame = rgb
        self.times.append(time)
        if alpha is not None:
            if self.alphas is None:
                self.alphas = self.store.growing("alpha", alpha.shape, np.uint8)
            self.alphas.append(alpha)
            self.alpha_count, self.least_alpha = self.alpha_count + 1, min(self.least_alpha, int(alpha.min()))

    def _require_room(self, size: tuple[int, int]) -> None:
        n = len(self.times) + 1
        advice = "cut the clip with --start and --duration"
        if n > self.limits.max_frames:
            raise InputRejected(
                f"'{self.name}' has more than {self.limits.max_frames} frames",
                f"at most {self.limits.max_frames} frames",
                f"{advice}, or raise the limit with --set read.max_frames=NUMBER",
            )
        if self.in_memory and n * size[0] * size[1] * 4 > self.limits.max_bytes:
            raise InputRejected(
                f"the frames of '{self.name}' need more than {self.limits.max_bytes / 1e6:.0f} MB",
                "less",
                f"{advice}, lower --max-size, or raise the limit with --max-bytes",
            )

    def clip(self) -> VideoClip:
        """All that was kept."""
        if self.start > 0 and self.last_seen < self.start:
            last = f" (last frame at {self.last_seen:.3f} s)" if math.isfinite(self.last_seen) else ""
            raise InputRejected(
                f"a start of {self.start:g} s, past the end of '{self.name}'{last}",
                "a start inside the clip",
                "lower --start",
            )
        if self.frames is None or len(self.times) < 2:
            found = "no frame" if not self.times else "only one frame"
            raise InputRejected(
                f"{found} that decodes in '{self.name}' between {self.start:g} s and "
                + ("its end" if math.isinf(self.end) else f"{self.end:g} s"),
                "at least two frames, because motion is measured between frames",
                "give a longer clip, or change --start and --duration",
            )
        times = np.asarray(self.times, np.float64)
        if is_variable(times):
            steps = np.diff(times)
            self.notes.add(
                Notice(
                    "variable-frame-rate",
                    f"variable frame rate: {1000 * steps.min():.1f} to {1000 * steps.max():.1f} ms between frames, the "
                    f"longest after frame {int(np.argmax(steps))}; the real times are used",
                )
            )
        if self.repeated:
            text = f"{self.repeated} of {len(times)} frames repeat the one before (a converted frame rate?)"
            self.notes.add(Notice(REPEATED, text))
        frames = self.frames.close()
        alpha = None if self.alphas is None else self.alphas.close()
        if self.alpha_count < len(times) or self.least_alpha == 255:
            alpha = None  # an alpha channel that hides nothing says nothing
        return VideoClip(frames, times, self.name, alpha, tuple(self.notes.lines))
