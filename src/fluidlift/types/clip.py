"""Pictures in time and what each pixel shows."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float, UInt8

from fluidlift.errors import require
from fluidlift.messages import Notice


@dataclass(frozen=True)
class VideoClip:
    """A decoded clip."""

    frames: UInt8[np.ndarray, "t h w 3"]
    """sRGB"""
    times: Float[np.ndarray, " t"]
    """presentation times in s; variable frame rates are real"""
    source: str = ""
    """name of the file, without its folder"""
    alpha: UInt8[np.ndarray, "t h w"] | None = None
    """alpha channel, where the file has one"""
    warnings: tuple[Notice, ...] = ()
    """what the reader noticed and the user should know"""

    def __post_init__(self) -> None:
        f = self.frames
        require(f.ndim == 4 and f.shape[-1] == 3 and f.dtype == np.uint8, f"frames {f.shape} {f.dtype}", "u8 [T,H,W,3]")
        require(len(self.times) == len(f), f"{len(self.times)} times for {len(f)} frames")
        require(bool((np.diff(self.times) > 0).all()), "frame times that do not increase")

    @property
    def interval(self) -> float:
        """Median time between frames, s."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 1.0 / 25.0

    @property
    def size(self) -> tuple[int, int]:
        """Width, height in px."""
        return int(self.frames.shape[2]), int(self.frames.shape[1])

    def __len__(self) -> int:
        return len(self.frames)


class Label(IntEnum):
    """What a pixel shows."""

    BACKGROUND = 0
    FLUID = 1
    SOLID = 2
    """a still thing inside the fluid, such as a rock"""


@dataclass(frozen=True)
class PixelLabels:
    """What each pixel shows in each frame, and how sure that is."""

    labels: UInt8[np.ndarray, "t h w"]
    """values of `Label`"""
    confidence: Float[np.ndarray, "t h w"]
    """0 (a guess) to 1 (given by the user), float16 at rest"""
    warnings: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        require(self.labels.ndim == 3 and self.labels.dtype == np.uint8, f"labels {self.labels.shape}", "u8 [T,H,W]")
        require(self.confidence.shape == self.labels.shape, "confidence and labels of different shapes")

    @property
    def fluid(self) -> np.ndarray:
        """bool [T,H,W]."""
        return self.labels == Label.FLUID

    @property
    def solid(self) -> np.ndarray:
        """bool [T,H,W]."""
        return self.labels == Label.SOLID


def is_variable(times: np.ndarray) -> bool:
    """Steps that differ by more than the rounding of time stamps to milliseconds explains."""
    if len(times) < 3:
        return False
    steps = np.diff(times)
    return bool(steps.max() - steps.min() > max(0.1 * np.median(steps), 0.0021))
