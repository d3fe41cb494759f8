"""When each pixel of a clip was seen to move, gathered frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from fluidlift.shape.evidence import POOLING, Evidence, change_over_time, pool

SATURATION = 0.9
"""a region that is nearly all seen active early (mean of the union's growth curve above this) is one that stays"""
PICKED = 15
"""frames whose activity is kept, for statistics of colour"""


@dataclass(frozen=True)
class Presence:
    """First and last activity of each pixel of a clip of `frames` frames."""

    frames: int
    first: np.ndarray
    """int [h,w]; `frames` where there never was any"""
    last: np.ndarray
    """int [h,w]; -1 where there never was any"""
    picked: tuple[int, ...]
    """some evenly spaced frames"""
    active: np.ndarray
    """bool [len(picked),h,w], activity in those"""

    @property
    def ever(self) -> np.ndarray:
        """bool [h,w]."""
        return self.last >= 0


def watch(evidence: Evidence, seen: np.ndarray) -> Presence:
    """Activity (change above the level that separates still from moving) of every frame, where `seen`, bool [h,w]."""
    frames, sigma = len(evidence.source), POOLING * max(evidence.noise.shape)
    picked = tuple(np.unique(np.linspace(0, frames - 1, min(frames, PICKED)).round().astype(int)).tolist())
    first, last = np.full(seen.shape, frames), np.full(seen.shape, -1)
    kept = np.zeros((len(picked), *seen.shape), bool)
    for t, change in enumerate(change_over_time(evidence)):
        active = (pool(np.log(np.maximum(change, 1.0)), sigma) > evidence.level) & seen
        first[active & (first == frames)] = t
        last[active] = t
        if t in picked:
            kept[picked.index(t)] = active
    return Presence(frames, first, last, picked, kept)


def grows(presence: Presence, where: np.ndarray) -> bool:
    """Whether the fluid advances into (or retreats from) the picture, judged at the pixels `where`, bool [h,w].

    The union of all that was active up to a frame fills at once where a fluid stays in its bed, and fills in the
    course of the clip where smoke rises or a jet advances; the same backwards for a fluid that leaves.
    """
    where = where & presence.ever
    for arrival in (presence.first[where], presence.frames - 1 - presence.last[where]):
        union = np.bincount(arrival, minlength=presence.frames).cumsum()
        if union[-1] and union.mean() / union[-1] < SATURATION:
            return True
    return False


def always(presence: Presence, where: np.ndarray | None = None) -> Presence:
    """The same clip with everything (of `where`, bool [h,w]; None: all) there from its first to its last frame."""
    there = np.ones(presence.first.shape, bool) if where is None else where
    return replace(
        presence, first=np.where(there, 0, presence.first), last=np.where(there, presence.frames - 1, presence.last)
    )


def remaining(presence: Presence) -> Presence:
    """The same clip with nothing that leaves: what was poured lies still where it lies, as long as the jet runs."""
    return replace(presence, last=np.where(presence.ever, presence.frames - 1, presence.last))


def stay(presence: Presence) -> tuple[np.ndarray, np.ndarray]:
    """First and last frame of a fluid that has its place, int [h,w], smoothed; near the ends of the clip means from
    or to the end."""
    frames, ever = presence.frames, presence.ever
    first = np.where(ever, presence.first, 0).astype(np.float32)
    last = np.where(ever, presence.last, frames - 1).astype(np.float32)
    first, last = cv2.medianBlur(first, 5).astype(int), cv2.medianBlur(last, 5).astype(int)
    margin = 0.2 * frames
    return np.where(first <= margin, 0, first), np.where(last >= frames - 1 - margin, frames - 1, last)
