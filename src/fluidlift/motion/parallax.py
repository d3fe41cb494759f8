"""Whether a camera went somewhere or only turned, and which corners stand still: epipolar geometry of tracks.

The pictures of a camera that only turns are homographies of each other, whatever they show (Hartley, Zisserman 2004,
8.4); those of one that goes somewhere are so on each plane alone, and everything else that stands lies on its epipolar
line. What flows is not found again where it was seen first, or not on its line.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.motion.tracks import Tracks

NEAR_LINE = 1.0
"""px from its epipolar line within which a corner agrees with it"""
LEAST_PAIRS = 30
"""corners that two frames must share, to be compared"""
APART = (0.4, 0.7, 1.0)
"""parts of the clip that lie between the frames compared"""
LIFE = 0.4
"""part of the clip through which a corner must be followed to count as standing: foam and ripples are lost earlier"""
OFF_PLANE = 0.09
"""share of the standing corners off the homography from which the camera went somewhere. Of made clips 0.02 where it
turned by 10 degrees, 0.6 to 0.7 where it went 1.2 m through a valley; of 16 real ones 0 to 0.06 of those that stand or
turn, 0.12 to 0.8 of those that go on or sway before something near"""
TRIALS = 2000
"""of RANSAC"""


@dataclass(frozen=True)
class Parallax:
    """What the tracks of a clip say of its camera."""

    standing: Bool[np.ndarray, " n"]
    """which tracks agree with a scene that stands, in most of the pairs of frames that show them"""
    off_plane: float
    """share of standing corners that no homography carries over, of the frames farthest apart that share enough"""

    @property
    def went(self) -> bool:
        """Whether the camera went somewhere."""
        return self.off_plane > OFF_PLANE


def parallax_of(tracks: Tracks) -> Parallax:
    """Compare frames at several distances in time."""
    seen, count = tracks.seen, tracks.places.shape[1]
    for_it, against = np.zeros(len(seen), int), np.zeros(len(seen), int)
    off = 0.0
    for part in APART:
        gap = max(1, round(part * (count - 1)))
        shares = []
        starts = np.unique(np.linspace(0, count - 1 - gap, 1 + round(2 * (1 - part) / part)).astype(int))
        for first in starts:
            both = np.flatnonzero(seen[:, first] & seen[:, first + gap])
            if len(both) < LEAST_PAIRS:
                continue
            a, b = tracks.places[both, first], tracks.places[both, first + gap]
            agree = _agreeing(a, b)
            for_it[both[agree]] += 1
            against[both[~agree]] += 1
            if agree.sum() >= LEAST_PAIRS:
                shares.append(1.0 - float(_on_plane(a[agree], b[agree]).mean()))
        # what flows agrees with lines by chance between frames near each other; the farther, the less is left of it
        off = max(shares) if shares else off
    lives = seen.sum(axis=1) >= max(3, LIFE * count)
    return Parallax(lives & (for_it > 0) & (for_it > 2 * against), off)


def _agreeing(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Which pairs of places agree with one fundamental matrix.

    Of two candidates, from all pairs and from those off the largest plane, that with more support off its own largest
    plane counts: a plane alone (such as water that drifts as a whole) fits any epipole (Chum et al. 2005).
    """
    best, most = np.zeros(len(a), bool), -1
    for chosen in (np.ones(len(a), bool), ~_on_plane(a, b)):
        if chosen.sum() < LEAST_PAIRS // 2:
            continue
        fundamental = _fundamental(a[chosen], b[chosen])
        if fundamental is None:
            continue
        agree = _from_line(fundamental, a, b) < NEAR_LINE
        support = int(agree.sum() - _on_plane(a[agree], b[agree]).sum()) if agree.sum() >= 8 else 0
        if support > most or (support == most and agree.sum() > best.sum()):
            best, most = agree, support
    return best


def _fundamental(a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """[3,3], or None where the pairs have none."""
    cv2.setRNGSeed(0)
    try:
        found, _ = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, 0.7 * NEAR_LINE, 0.999, TRIALS)
    except cv2.error:  # OpenCV 5.0 raises where no sample gives a model, as where nothing moves
        return None
    return found if found is not None and found.shape == (3, 3) else None


def _on_plane(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """bool [n]: which pairs one homography carries over."""
    if len(a) < 8:
        return np.zeros(len(a), bool)
    cv2.setRNGSeed(0)
    try:
        homography, inside = cv2.findHomography(a, b, cv2.USAC_MAGSAC, NEAR_LINE, maxIters=TRIALS, confidence=0.999)
    except cv2.error:
        return np.zeros(len(a), bool)
    return np.zeros(len(a), bool) if homography is None else inside[:, 0] > 0


def _from_line(fundamental: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sampson distance, px."""
    a1, b1 = np.c_[a, np.ones(len(a))], np.c_[b, np.ones(len(b))]
    to, back = a1 @ fundamental.T, b1 @ fundamental
    slope = np.sqrt(to[:, 0] ** 2 + to[:, 1] ** 2 + back[:, 0] ** 2 + back[:, 1] ** 2)
    return np.abs((b1 * to).sum(axis=1)) / np.maximum(slope, 1e-12)
