"""Where a fluid that stays in its bed ends in each frame: waves run up a bank and leave it again.

The outline of such a fluid is found from all frames together, so it is what was ever wet, and its edge is as vague as
evidence is pooled. The ground that lies bare between two waves is told by its colours: those of the ground next to it.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from scipy.ndimage import convolve1d

from fluidlift.shape.background import colour_bins
from fluidlift.shape.evidence import POOLING, Evidence
from fluidlift.shape.min_cut import disc, spread
from fluidlift.shape.moving_front import median_of_three

REACH = 0.04
"""part of the longer side: how far a waterline may go back, and the width of the strip of ground that is looked at"""
TILE = 0.08
"""part of the longer side: colours are compared with those so near"""
BINS = 32
"""of each axis of colour: grey foam and brown ground are no more than that apart"""
MIXED = 2.0
"""px beyond the outline where colours of fluid and ground mix"""
BLUR = 1.0
"""px over which log odds are shared between neighbours"""
DECISIVE = 4.0
"""log odds at which the colour of one pixel is held to say no more"""
RARE = 1e-4
"""share of a colour below which it is held to be unknown"""
MISTAKEN = 0.1
"""of the fluid further in may look like the ground; where more does, colours do not tell"""
ALWAYS = 0.9
"""of the frames: what looks like the ground for longer moves all the same, and motion has decided there"""


class ShoreColours:
    """Log odds of fluid against the ground beside it, from colours; histograms of tiles, read once from some frames."""

    def __init__(self, pictures: np.ndarray, region: np.ndarray, solid: np.ndarray) -> None:
        """Reads the colours, the second time without what the first took for ground.

        Args:
            pictures: float32 [n,h,w,3], opponent colours.
            region: bool [h,w], what was ever fluid.
            solid: bool [h,w], rocks: neither fluid nor ground.
        """
        longest = max(region.shape)
        ground = spread(region, REACH * longest) & ~spread(region, MIXED) & ~solid
        rows, columns = (max(2, round(size / (TILE * longest)) + 1) for size in region.shape)
        self._rows = np.linspace(0.0, rows - 1.0, region.shape[0], dtype=np.float32)[:, None]
        self._columns = np.linspace(0.0, columns - 1.0, region.shape[1], dtype=np.float32)[None]
        self._odds = np.zeros((rows, columns, BINS, BINS, BINS), np.float32)
        bare = self._shares(pictures, np.broadcast_to(ground, pictures.shape[:3]))
        wet = np.broadcast_to(region, pictures.shape[:3])
        dry = np.zeros(pictures.shape[:3], bool)
        for _ in range(2):
            self._odds = np.clip(np.log(self._shares(pictures, wet) / bare), -DECISIVE, DECISIVE)
            dry = np.stack([self(picture) for picture in pictures]) < 0.0
            wet = region & ~dry
        outside, share = ~region & ~solid, dry.mean(axis=0)
        inner = region & ~spread(outside | solid, REACH * longest)
        seen, mistaken = (
            cv2.GaussianBlur(weight.astype(np.float32), (0, 0), TILE * longest) for weight in (inner, inner * share)
        )
        changes = (share < ALWAYS) | spread(outside, POOLING * longest)
        self.tell = (seen > 1e-2) & (mistaken < MISTAKEN * seen) & changes
        """bool [h,w]: where fluid nearby is not taken for ground, nor this place for ground nearly all the time"""

    def _shares(self, pictures: np.ndarray, where: np.ndarray) -> np.ndarray:
        """Share of each colour in each tile, float32 [rows,columns,b,b,b], of pictures where bool [n,h,w]."""
        counts = np.zeros_like(self._odds)
        rows, columns = np.broadcast_arrays(np.rint(self._rows).astype(int), np.rint(self._columns).astype(int))
        for picture, here in zip(pictures, where, strict=True):
            np.add.at(counts, (rows[here], columns[here], *colour_bins(picture[here], bins=BINS)), 1.0)
        for axis in range(counts.ndim):
            counts = convolve1d(counts, np.array([0.25, 0.5, 0.25], np.float32), axis=axis, mode="constant")
        return counts / np.maximum(counts.sum(axis=(2, 3, 4), keepdims=True), 1e-6) + RARE

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """float32 [h,w] of one picture [h,w,3]; linear between the middles of tiles."""
        bins = colour_bins(picture, bins=BINS)
        odds = np.zeros(picture.shape[:2], np.float32)
        top = np.minimum(self._rows.astype(int), self._odds.shape[0] - 2)
        left = np.minimum(self._columns.astype(int), self._odds.shape[1] - 2)
        for down in (0, 1):
            for right in (0, 1):
                weight = np.abs(1 - down - (self._rows - top)) * np.abs(1 - right - (self._columns - left))
                odds += weight * self._odds[(top + down, left + right, *bins)]
        return cv2.GaussianBlur(odds, (0, 0), BLUR)


def dry_over_time(
    evidence: Evidence, region: np.ndarray, solid: np.ndarray, picked: tuple[int, ...]
) -> Iterator[np.ndarray]:
    """The part of the region that lies dry in each frame, bool [h,w]: like the ground, and hanging together with it.

    Args:
        evidence: of the clip.
        region: bool [h,w], what was ever fluid.
        solid: bool [h,w], rocks in it.
        picked: frames whose colours are read.
    """
    longest, outside = max(region.shape), ~region & ~solid
    colours = ShoreColours(np.stack([evidence.source[t].astype(np.float32) for t in picked]), region, solid)
    shore = region & colours.tell & spread(outside, REACH * longest)
    if not shore.any() or not outside.any():
        yield from (np.zeros_like(region) for _ in range(len(evidence.source)))
        return
    frames = (evidence.source[t].astype(np.float32) for t in range(len(evidence.source)))
    for odds in median_of_three(colours(picture) for picture in frames):
        dry = shore & (odds < 0.0)
        parts = cv2.connectedComponents((dry | outside).astype(np.uint8), connectivity=4)[1]
        dry &= np.isin(parts, np.unique(parts[outside]))
        left = (region & ~dry) | solid
        yield region & ~(cv2.morphologyEx(left.astype(np.uint8), cv2.MORPH_OPEN, disc(0.004 * longest)) > 0)
