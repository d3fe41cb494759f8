"""The fluid of a clip, frame by frame, without holding all of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from fluidlift.types import Label


class FluidMasks:
    """The fluid of each frame, bool [T,H,W], read from the labels when it is asked for.

    Args:
        labels: `Label` of each pixel.
        hidden: bool [H,W], pixels in which something stands before the fluid, which counts as fluid in all frames.
    """

    def __init__(self, labels: np.ndarray, hidden: np.ndarray | None = None) -> None:
        self.labels, self.shape, self.ndim = labels, labels.shape, 3
        self.hidden = hidden

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: Any) -> np.ndarray:
        seen = np.asarray(self.labels[index]) == Label.FLUID
        if self.hidden is None:
            return seen
        rest = index[1:] if isinstance(index, tuple) else ()
        return seen | self.hidden[rest]

    def any_frame(self) -> np.ndarray:
        """bool [H,W]: fluid at some time."""
        seen = np.zeros(self.shape[1:], bool)
        for part in parts_of(self.labels):
            seen |= self[part].any(axis=0)
        return seen

    def shares(self) -> np.ndarray:
        """float32 [H,W]: of the frames, those in which each pixel is fluid."""
        total = np.zeros(self.shape[1:], np.int64)
        for part in parts_of(self.labels):
            total += self[part].sum(axis=0)
        return (total / max(len(self), 1)).astype(np.float32)

    def areas(self) -> np.ndarray:
        """float [T]: px of each frame."""
        parts = [self[part].sum(axis=(1, 2)) for part in parts_of(self.labels)]
        return np.concatenate(parts).astype(float)


STAYS = 0.95
"""share of a fluid that must be the same in both halves of its clip for its outline to hold after the clip as well: a
vessel that fills goes on to do so. Two people who draw the outline of water agree as much"""


GAINS = 2.0
"""px that fluid has won in the second half of a clip for each that it has lost, from which its outline grows: what
sways about wins as many as it loses (0.67 a jet in a hand, 0.26 water behind a passer-by), a glass that fills 4.3"""


def share_that_stays(masks: np.ndarray | FluidMasks) -> float:
    """Share of what is fluid in most frames of one half of a clip that is so in both: 1 where the outline stays.

    Args:
        masks: bool [T,H,W], read frame by frame.
    """
    first, second = _mostly_fluid(masks)
    return float((first & second).sum() / max(int((first | second).sum()), 1))


def outline_grows(masks: np.ndarray | FluidMasks) -> bool:
    """Whether a fluid changes its place between the halves of a clip, and wins more of the picture than it loses.

    Args:
        masks: bool [T,H,W], read frame by frame.
    """
    first, second = _mostly_fluid(masks)
    won, lost, either = (int(part.sum()) for part in (second & ~first, first & ~second, first | second))
    return won + lost >= (1.0 - STAYS) * either and won > GAINS * lost


def _mostly_fluid(masks: np.ndarray | FluidMasks) -> list[np.ndarray]:
    """bool [H,W] of both halves of a clip: what is fluid in most of their frames."""
    half = max(len(masks) // 2, 1)
    found = []
    for frames in (range(half), range(len(masks) - half, len(masks))):
        total = np.zeros(masks.shape[1:], np.int64)
        for t in frames:
            total += masks[t]
        found.append(2 * total > len(frames))
    return found


PART_BYTES = 2**25
"""of an array on disk that are copied or looked at in one go"""


def parts_of(array: np.ndarray, *, size: int = PART_BYTES) -> Iterator[slice]:
    """Slices along the first axis that cover an array, each of about `size` bytes."""
    step = max(1, size // max(1, array[:1].nbytes))
    for first in range(0, len(array), step):
        yield slice(first, min(first + step, len(array)))
