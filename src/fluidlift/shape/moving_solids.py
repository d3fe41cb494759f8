"""Rigid-motion segmentation: hands, jugs and posts that move in the picture, which change as a fluid does.

A solid keeps its look and moves as one: over a few tenths of a second its features are found again (pyramidal
Lucas-Kanade) and agree on a similarity (RANSAC), where those of a fluid deform and go out. And it does not keep moving
the same way at the same place: it is held, sways with a camera that is held, or passes. A current does, so a sheet of
foam that slides by without deforming is no solid. Where a clip is too short for that, a solid takes its outline along:
its leading or trailing end keeps up with its motion, where a current flows through an outline that stays.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from fluidlift.numerics.short_axis import lengths, summed
from fluidlift.numerics.similarity2 import composed, inverse
from fluidlift.shape.evidence import PairReader, in_order
from fluidlift.shape.frame_pictures import shrink, working_scale
from fluidlift.types.clip import VideoClip

SIZE = 512
"""px, longer side of the pictures in which features are tracked"""
WINDOW = 0.4
"""s that features are followed. Of 34 real clips 49 to 57 % of the features of hands, pots and jugs were found again
after it and had moved; of water, surf, honey and smoke 0 to 16 %"""
WINDOWS = 8
"""stretches looked at, spread over the clip"""
SEEN = 2
"""of them, none of which overlap, in which a pixel must be of a solid: puffs of smoke and crests hold together once"""
ALIKE = 0.9
"""correlation of the surroundings of a feature before and after"""
PATCH = 15
"""px, side of these surroundings"""
LEAST_MOVE = 0.006
"""part of the longer side that a feature moves in a window: three px of 512, above what is left of a hand's tremble"""
LEAST_FEATURES = 8
"""that agree on one motion: two more pairs than chance finds within `TOLERANCE` among a hundred"""
TOLERANCE = 1.5
"""px by which they may miss it: what turns out of the picture's plane is no exact similarity"""
SOLIDS = 3
"""motions looked for in a window"""
REACH = 0.04
"""part of the longer side beyond the outermost features that a smooth solid is taken to go on"""
AGREES = 0.3
"""part of the motion by which the optical flow of a pixel may differ from that of the solid"""
AGREES_PX = 0.25
"""px per frame that it may differ in any case: the accuracy of the flow"""
STEADY = 0.5
"""length of the mean motion of a place as part of its root mean square. Of the same clips: solids 0.04 to 0.37 (10th
percentile to 90th), water that flows 0.6 to 1"""
TRAVELS = 0.02
"""part of the longer side that a solid goes in the course of a clip before its ends are looked at: three times
`LEAST_MOVE`, above what their places differ by from window to window"""
HOLDS_TOGETHER = 0.75
"""of the windows in which it must be seen then"""
KEEPS_UP = 0.5
"""speed of its leading or trailing end over its own: half way between a current's (0) and a solid's (1)"""
END = 5.0
"""per cent of a solid's pixels that lie beyond what counts as its end"""


@dataclass(frozen=True)
class _Tracks:
    """Features of the first frame of a window, followed to its last."""

    places: np.ndarray
    """float32 [K+1,n,2], px"""
    kept: np.ndarray
    """bool [n], found again"""

    @property
    def moved(self) -> np.ndarray:
        """px [n]."""
        return np.linalg.norm(self.places[-1] - self.places[0], axis=-1)


class SharedPairs:
    """Reads the flow of pairs, and keeps what `moving_solids` will ask for of those that others read before.

    At most `WINDOWS` of `WINDOW` seconds of steps as float16, whatever the length of the clip.
    """

    def __init__(self, clip: VideoClip, flow: PairReader) -> None:
        """Of a clip and the reader of its flow."""
        frames, height, width = clip.frames.shape[:3]
        self._flow, self._scale = flow, working_scale(height, width, longest=SIZE)
        self._wanted = {t for start, length in _windows(frames, clip.interval) for t in range(start, start + length)}
        self._kept: dict[int, np.ndarray] = {}

    def __call__(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Displacement [H,W,2], px, and confidence [H,W] from frame t to t + 1."""
        return self._noted(t, self._flow(t))

    def in_order(self, pairs: Iterable[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """As a call for each of the pairs; its flow may be read ahead."""
        asked = list(pairs)
        for t, found in zip(asked, in_order(self._flow, asked), strict=True):
            yield self._noted(t, found)

    def _noted(self, t: int, found: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The flow of a pair as it was read, kept where it will be asked for."""
        if t in self._wanted and t not in self._kept:
            self._kept[t] = self._shrunk(found[0]).astype(np.float16)
        return found

    def step(self, t: int) -> np.ndarray:
        """float32 [h,w,2]: displacement from frame t to t + 1 at the size at which solids are looked for, px of it."""
        kept = self._kept.get(t)
        return self._shrunk(self._flow(t)[0]) if kept is None else kept.astype(np.float32)

    def _shrunk(self, displacement: np.ndarray) -> np.ndarray:
        return shrink(np.nan_to_num(np.asarray(displacement, np.float32)), self._scale) * np.float32(self._scale)


def _windows(frames: int, interval: float) -> list[tuple[int, int]]:
    """First frame and pairs of each window; none of a clip that is too short."""
    length = max(round(WINDOW / interval), 2)
    if frames - 1 < SEEN * length:
        return []
    return [(int(start), length) for start in np.unique(np.linspace(0, frames - 1 - length, WINDOWS).astype(int))]


def moving_solids(clip: VideoClip, flow: SharedPairs, shape: tuple[int, int]) -> np.ndarray:
    """bool [h,w]: where solids move in at least `SEEN` of the windows.

    Args:
        clip: from a camera that stands or sways a little.
        flow: of its pairs.
        shape: h, w of the result.
    """
    frames, height, width = clip.frames.shape[:3]
    windows = _windows(frames, clip.interval)
    if not windows:
        return np.zeros(shape, bool)
    scale = working_scale(height, width, longest=SIZE)
    masks, means = [], []
    total, squares, count = np.float32(0), np.float32(0), 0
    for start, length in windows:
        grey = [_grey(clip.frames[t], scale) for t in range(start, start + length + 1)]
        steps = [flow.step(t) for t in range(start, start + length)]
        masks.append(_solids_of_window(grey, steps))
        means.append(sum(steps) / np.float32(length))
        total = total + sum(steps)
        squares = squares + sum(summed(step**2) for step in steps)
        count += length
    mean, mean_square = np.linalg.norm(total, axis=-1) / count, squares / count
    steady = mean / np.maximum(np.sqrt(mean_square), AGREES_PX)
    seen = _apart(masks, windows)
    found = (seen >= SEEN) & ((steady < STEADY) | _travelling(masks, means, [start for start, _ in windows]))
    return cv2.resize(found.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _apart(masks: list[np.ndarray], windows: list[tuple[int, int]]) -> np.ndarray:
    """int [h,w]: in how many windows a pixel is of a solid, of those that share no time: in a short clip they overlap,
    and what holds together once would be seen twice."""
    seen = np.zeros(masks[0].shape, int)
    over = np.zeros(masks[0].shape, int)
    for mask, (start, length) in zip(masks, windows, strict=True):
        new = mask & (start >= over)
        seen[new] += 1
        over[new] = start + length
    return seen


def _travelling(masks: list[np.ndarray], means: list[np.ndarray], starts: list[int]) -> np.ndarray:
    """bool [h,w]: what a solid sweeps over that takes its outline along.

    Args:
        masks: bool [h,w], where solids move in each window.
        means: float32 [h,w,2], mean flow of each, px per frame.
        starts: first frame of each.
    """
    seen, found = np.sum(masks, axis=0), np.zeros(masks[0].shape, bool)
    count, parts = cv2.connectedComponents((seen >= SEEN).astype(np.uint8))
    for part in range(1, count):
        own = parts == part
        windows = [k for k, mask in enumerate(masks) if (mask & own).any()]
        if len(windows) < HOLDS_TOGETHER * len(masks):
            continue
        motion = np.mean([means[k][masks[k] & own].mean(axis=0) for k in windows], axis=0)
        speed, times = float(np.linalg.norm(motion)), np.array([starts[k] for k in windows], float)
        if speed * (times[-1] - times[0]) < TRAVELS * max(found.shape):
            continue
        along = [np.argwhere(masks[k] & own)[:, ::-1] @ (motion / speed) for k in windows]
        ends = np.array([np.percentile(places, (END, 100.0 - END)) for places in along])
        first, second = np.triu_indices(len(times), 1)
        slopes = (ends[second] - ends[first]) / (times[second] - times[first])[:, None]  # Theil and Sen
        if np.median(slopes, axis=0).max() > KEEPS_UP * speed:
            found |= own
    return found


def _grey(frame: np.ndarray, scale: float) -> np.ndarray:
    return cv2.cvtColor(shrink(np.ascontiguousarray(frame), scale), cv2.COLOR_RGB2GRAY)


def _solids_of_window(grey: list[np.ndarray], steps: list[np.ndarray]) -> np.ndarray:
    """bool [h,w]: where a solid moves while these frames last.

    Args:
        grey: K+1 pictures u8 [h,w].
        steps: K optical flows float32 [h,w,2], px per frame.
    """
    found = np.zeros(grey[0].shape, bool)
    tracks = tracked(grey)
    if tracks is None:
        return found
    for agree, motions in carried_alike(tracks, LEAST_MOVE * max(grey[0].shape)):
        solid = _moving_alike(motions, steps, tracks.places[0][agree])
        columns, rows = np.clip(tracks.places[0].astype(int), 0, np.array(solid.shape[::-1]) - 1).T
        inside = solid[rows, columns]
        if (inside & tracks.kept).sum() >= 2 * (inside & ~tracks.kept).sum():  # what goes out as often is a fluid
            for motion in motions[:: max(len(steps) // 4, 1)]:
                found |= cv2.warpAffine(solid.astype(np.uint8), motion, solid.shape[::-1]) > 0
    return found


def carried_alike(tracks: _Tracks, least: float) -> Iterator[tuple[np.ndarray, list[np.ndarray]]]:
    """Features that one similarity carries from the first frame to the last, the largest group first.

    Args:
        tracks: of features.
        least: px that a feature moves at least.

    Yields:
        Indices [n] of the features, and their similarities [2,3] of every frame from the first.
    """
    left = tracks.kept & (tracks.moved > least)
    cv2.setRNGSeed(0)
    for _ in range(SOLIDS):
        if left.sum() < LEAST_FEATURES:
            return
        options = {"method": cv2.RANSAC, "ransacReprojThreshold": TOLERANCE, "maxIters": 500}
        similarity, inliers = cv2.estimateAffinePartial2D(tracks.places[0][left], tracks.places[-1][left], **options)
        if similarity is None or inliers.sum() < LEAST_FEATURES:
            return
        agree = np.flatnonzero(left)[inliers[:, 0] > 0]
        left[agree] = False
        yield agree, _motions(np.ascontiguousarray(tracks.places[:, agree]))


def tracked(grey: list[np.ndarray], where: np.ndarray | None = None) -> _Tracks | None:
    """Features followed from frame to frame, forwards and back; None where there are none.

    Args:
        grey: pictures u8 [h,w].
        where: u8 [h,w], not 0 where features are looked for in the first; None: everywhere.
    """
    corners = cv2.goodFeaturesToTrack(grey[0], 600, 0.01, 5, mask=where, blockSize=5)
    if corners is None:
        return None
    places, kept = [corners], np.ones(len(corners), bool)
    for first, second in zip(grey, grey[1:]):
        ahead, found, _ = cv2.calcOpticalFlowPyrLK(first, second, places[-1], places[-1].copy(), winSize=(PATCH, PATCH))
        back, again, _ = cv2.calcOpticalFlowPyrLK(second, first, ahead, ahead.copy(), winSize=(PATCH, PATCH))
        kept &= (found[:, 0] > 0) & (again[:, 0] > 0) & (np.linalg.norm(back - places[-1], axis=-1)[:, 0] < 0.5)
        places.append(ahead)
    followed = np.stack(places)[:, :, 0]
    for i in np.flatnonzero(kept):
        kept[i] = _likeness(grey[0], followed[0, i], grey[-1], followed[-1, i]) > ALIKE
    return _Tracks(followed, kept)


def _likeness(first: np.ndarray, here: np.ndarray, second: np.ndarray, there: np.ndarray) -> float:
    """Normalised cross-correlation of the surroundings of two places."""
    a, b = (
        cv2.getRectSubPix(picture, (PATCH, PATCH), (float(x), float(y))).astype(np.float64)
        for picture, (x, y) in ((first, here), (second, there))
    )
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-6))


def _motions(places: np.ndarray) -> list[np.ndarray]:
    """Similarities [2,3] of every frame of a window from its first, by the features [K+1,n,2] of one solid."""
    motions = [np.eye(2, 3)]
    for there in places[1:]:
        motion, _ = cv2.estimateAffinePartial2D(places[0], there, method=cv2.LMEDS)
        motions.append(motions[-1] if motion is None else motion)
    return motions


def _moving_alike(motions: list[np.ndarray], steps: list[np.ndarray], features: np.ndarray) -> np.ndarray:
    """bool [h,w]: pixels of the first frame about these features [n,2] whose optical flow is that of the solid."""
    height, width = steps[0].shape[:2]
    near = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(near, cv2.convexHull(features).astype(np.int32), 1)
    radius = round(REACH * max(height, width))
    near = cv2.dilate(near, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)))
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    here = np.stack([columns, rows], axis=-1)
    error, length = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for motion, after, step in zip(motions, motions[1:], steps):
        place = (here @ motion[:, :2].T + motion[:, 2]).astype(np.float32)
        turned = composed(after, inverse(motion))
        expected = place @ (turned[:, :2] - np.eye(2)).T.astype(np.float32) + turned[:, 2].astype(np.float32)
        seen = cv2.remap(step, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        error += lengths(seen - expected)
        length += lengths(expected)
    still = length < 0.5 * LEAST_MOVE * max(height, width)
    solid = (near > 0) & ~still & (error < np.maximum(AGREES * length, AGREES_PX * len(steps)))
    # a smooth sleeve goes on as far as its flow does
    parts = cv2.connectedComponents((solid | (~still & (error < AGREES * length))).astype(np.uint8))[1]
    return np.isin(parts, np.unique(parts[solid]))
