"""Feature tracks: corners followed from frame to frame (pyramidal Lucas-Kanade), each over as many as show it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.motion.camera_motion import spread_features

ROUND_TRIP = 0.5
"""px by which a corner may miss its place on the way there and back"""
GENERATIONS = 8
"""how often, in a clip, corners are looked for where there are none"""
WINDOW = (21, 21)
"""px around a corner that must look alike"""
APART = 0.012
"""part of the longer side that a new corner keeps from those that are followed already"""
PER_CELL = 24
"""corners of each of the 48 cells of the picture: about a thousand"""


@dataclass(frozen=True)
class Tracks:
    """Where corners were seen."""

    places: Float[np.ndarray, "n t 2"]
    """px, from the upper left corner of the picture; not a number where a corner is not seen"""
    size: tuple[int, int]
    """of the picture, px"""

    @property
    def seen(self) -> Bool[np.ndarray, "n t"]:
        """Which corners each frame shows."""
        return np.isfinite(self.places[..., 0])


def follow(grey: Sequence[np.ndarray]) -> Tracks:
    """Tracks through u8 [H,W] pictures; those of a single frame are left out.

    Each corner is found in the picture where it was seen first, not in the one before: errors of single steps (a tenth
    of a pixel) would add up to pixels over a clip.
    """
    count = len(grey)
    groups: list[_Born] = []
    renewed = max(2, math.ceil(count / GENERATIONS))
    for t in range(count):
        picture = grey[t]
        for group in groups:
            group.go_on(picture, t)
        if t % renewed == 0 and t + 1 < count:
            groups.append(_Born.of(picture, t, count, [g.places[:, t] for g in groups]))
    places = np.concatenate([group.places for group in groups]).astype(np.float64)
    seen = np.isfinite(places[..., 0]).sum(axis=1)
    height, width = grey[0].shape
    return Tracks(places[seen > 1] + 0.5, (width, height))  # OpenCV counts from the middle of the first pixel


@dataclass
class _Born:
    """Corners that were seen first in the same frame."""

    picture: np.ndarray
    """u8 [H,W], that frame"""
    places: np.ndarray
    """float32 [n,t,2], px from the middle of the first pixel"""
    alive: np.ndarray
    """int [n'], which of them are still followed"""
    first: int

    @classmethod
    def of(cls, picture: np.ndarray, t: int, count: int, known: list[np.ndarray]) -> _Born:
        """Corners of a picture that do not lie near those that are `known` ([n,2] each)."""
        height, width = picture.shape
        fresh = spread_features(picture, per_cell=PER_CELL)[:, 0]
        near = np.zeros((height, width), np.uint8)
        for x, y in np.concatenate([np.zeros((0, 2)), *known]):
            if np.isfinite(x):
                cv2.circle(near, (round(float(x)), round(float(y))), max(1, round(APART * max(width, height))), 255, -1)
        at = np.round(fresh).astype(int)
        fresh = fresh[near[np.clip(at[:, 1], 0, height - 1), np.clip(at[:, 0], 0, width - 1)] == 0]
        places = np.full((len(fresh), count, 2), np.nan, np.float32)
        places[:, t] = fresh
        return cls(picture, places, np.arange(len(fresh)), t)

    def go_on(self, picture: np.ndarray, t: int) -> None:
        """Find them in the next frame."""
        if not len(self.alive):
            return
        options = {"winSize": WINDOW, "maxLevel": 2, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        start = np.ascontiguousarray(self.places[self.alive, self.first][:, None])
        last = np.ascontiguousarray(self.places[self.alive, t - 1][:, None])
        ahead, ok, _ = cv2.calcOpticalFlowPyrLK(self.picture, picture, start, last.copy(), **options)
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(picture, self.picture, ahead, start.copy(), **options)
        miss = np.linalg.norm(back - start, axis=-1)[:, 0]
        height, width = picture.shape
        x, y = ahead[:, 0].T
        inside = (x > 2) & (y > 2) & (x < width - 3) & (y < height - 3)
        good = (ok[:, 0] > 0) & (ok_back[:, 0] > 0) & (miss < ROUND_TRIP) & inside
        self.alive = self.alive[good]
        self.places[self.alive, t] = ahead[good, 0]
