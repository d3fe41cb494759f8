"""What comes for good: places that look one way up to an instant, and another way from then on (change points).

A glass that fills shows its empty inside up to the level, and what is poured into it below that. What is poured may be
smooth and lie still, so that nothing moves there but the level itself, as it passes: how each place looks before and
after tells the level in every frame. Fluid that streams looks different all the time, and has no two looks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from fluidlift.numerics.short_axis import summed
from fluidlift.shape.background import filled_in
from fluidlift.shape.colour_growth import with_quiet_water
from fluidlift.shape.evidence import Evidence, distance_of_pictures
from fluidlift.shape.min_cut import disc, spread
from fluidlift.shape.moving_front import median_of_three

COMPARED = 31
"""pictures, spread over the clip, in which a change is looked for: to a thirtieth of it"""
STEP = 4.0
"""of the difference between two pictures of what does not move, by which both looks differ at least: noise has one of
1 and its means less"""
STEADY = 0.35
"""of that difference, standard deviation of a place about its two looks at most: a change in equal steps over all of
the clip leaves 0.29, white noise 0.46 and more in 99 of 100 places"""
FEWEST = 6
"""pictures, of which any two looks would do for fewer"""
LEAST = 0.002
"""part of the picture that has two looks at least, in one piece: less is a drop or a reflection"""
RISES = 0.8
"""correlation of height with the time at which a piece comes, at least: a level rises, and so does the top of a heap.
Glasses have 0.87 to 1.00 (six made ones, one real), 18 pieces of a made stream, a cascade and a splash -0.78 to 0.74"""
JET = 0.05
"""part of the longer side: a jet and its sway are no wider (radius), as `swaying_jets.WIDEST`"""
BESIDE, NEARBY = 2.0, 0.008
"""px from a region where colors mix; part of the longer side over which places say together what looks like the
ground"""
GROUND = 0.5
"""of the difference of the later look from what lies around the region, that of the earlier one at most, in a
piece as a whole and nearby: where both are as far from it the fluid itself has changed (a choice)"""
BLUR = 0.7
"""px over which the grain of single frames is shared"""


@dataclass(frozen=True)
class Arrivals:
    """Places with two looks."""

    where: Bool[np.ndarray, "h w"]
    bare: Float[np.ndarray, "h w 3"]
    """opponent colors without the fluid"""
    wet: Float[np.ndarray, "h w 3"]
    """with it"""

    @property
    def and_below(self) -> Bool[np.ndarray, "h w"]:
        """Them and all that is below: what is fluid there has been from the first frame on."""
        return np.logical_or.accumulate(self.where, axis=0)

    def with_what_was_there(
        self, evidence: Evidence, score: Float[np.ndarray, "h w"], region: Bool[np.ndarray, "h w"],
        possible: Bool[np.ndarray, "h w"],
    ) -> Bool[np.ndarray, "h w"]:  # fmt: skip
        """The region with what comes and with what lay below that from the first frame on, of the same colors: nothing
        ever moves there.

        Args:
            evidence: of the clip.
            score: log odds of fluid.
            region: outline of all that is ever fluid, as far as motion tells it.
            possible: where fluid may be. What is held to be solid and comes with the fluid for the most part is its
                level.
        """
        count, found = cv2.connectedComponents((~possible).astype(np.uint8), connectivity=4)
        parts = np.asarray(found, np.int64)
        rises = np.bincount(parts[self.where], minlength=count) > 0.5 * np.bincount(parts.ravel(), minlength=count)
        risen = rises[parts] & ~possible
        wet, sure = np.where(self.where[..., None], self.wet, evidence.typical), region | self.where
        grown = with_quiet_water(wet.astype(np.float32), np.where(risen, 0.0, score), sure)
        grown = ndimage.binary_fill_holes(grown | sure)
        return sure | (grown & (possible | risen) & self.and_below)


def arrivals(evidence: Evidence, region: Bool[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"]) -> Arrivals | None:
    """Where fluid comes for good; None where it does nowhere.

    What goes is left alone: foam that settles, and glare that passes, leave what looks like the ground through clear
    water. A jug that is put down comes for good, too, beside the fluid.

    Args:
        evidence: of the clip.
        region: outline of all that is ever fluid, as far as motion tells it.
        inside: where fluid may be.
    """
    kept = evidence.pictures
    if len(kept) < FEWEST or not region.any():
        return None
    picked = np.unique(np.linspace(0, len(kept) - 1, min(COMPARED, len(kept))).round().astype(int))
    before, after, when, steady = _two_looks(kept[picked])
    where = inside & steady
    where &= distance_of_pictures(before, after) > STEP * np.exp(evidence.level) * evidence.noise
    where = cv2.morphologyEx(where.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    where, parts = _rising(where, region, when)
    # what is seen of the ground beside them
    around = filled_in(evidence.typical, ~spread(ndimage.binary_fill_holes(region | where), BESIDE))
    like = [distance_of_pictures(x, around) for x in (before, after)]
    whole = [np.bincount(parts.ravel(), x.ravel()) for x in like]
    smooth = [cv2.GaussianBlur(x, (0, 0), NEARBY * max(region.shape)) for x in like]
    where &= (whole[0] < GROUND * whole[1])[parts] & (smooth[0] < GROUND * smooth[1])
    if not where.any():
        return None
    # where a jet comes by on its way the looks are those on both sides of it
    wide = cv2.morphologyEx(where.astype(np.uint8), cv2.MORPH_CLOSE, disc(JET * max(region.shape))) > 0
    bare, wet = filled_in(before, where), filled_in(after, where)
    return Arrivals(where | (wide & region), bare, wet)


def _two_looks(
    seen: Float[np.ndarray, "n h w 3"],
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"], Int[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Means before and after the instant that parts the looks of each place best (least squares), the first picture
    after it, and whether what is left beside the means is little."""
    count = len(seen)
    total: np.ndarray = np.cumsum(seen, axis=0, dtype=np.float32)
    best: np.ndarray = np.full(seen.shape[1:3], -1.0, np.float32)
    first, second = np.zeros(seen.shape[1:], np.float32), np.zeros(seen.shape[1:], np.float32)
    when = np.zeros(seen.shape[1:3], np.int64)
    for k in range(1, count):
        one, other = total[k - 1] / k, (total[-1] - total[k - 1]) / (count - k)
        between = np.float32(k * (count - k) / count) * summed(np.square(one - other))
        better = between > best
        best[better], first[better], second[better], when[better] = between[better], one[better], other[better], k
    mean = total[-1] / count
    overall = sum(summed(np.square(picture - mean)) for picture in seen)
    left = np.sqrt(np.maximum(overall - best, 0.0) / count)
    return first, second, when, left < STEADY * np.sqrt(summed(np.square(second - first)))


def _rising(
    where: Bool[np.ndarray, "h w"], region: Bool[np.ndarray, "h w"], when: Int[np.ndarray, "h w"]
) -> tuple[Bool[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """The pieces that are large enough, are part of a region for the most part, and come from below upwards; and the
    number of the piece of each pixel."""
    count, found = cv2.connectedComponents(where.astype(np.uint8), connectivity=4)
    parts = np.asarray(found, np.int64)
    size = np.bincount(parts.ravel(), minlength=count)
    kept = (size >= LEAST * where.size) & (np.bincount(parts[region], minlength=count) > 0.5 * size)
    kept[0] = False
    for part in np.flatnonzero(kept):
        rows, times = np.nonzero(parts == part)[0], when[parts == part]
        kept[part] = np.ptp(times) > 0 and np.corrcoef(rows, times)[0, 1] < -RISES
    return kept[parts], parts


def bare_before(evidence: Evidence, found: Arrivals) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Where the ground is seen in a place that fluid comes to, for every frame."""
    frames = (evidence.source[t] for t in range(len(evidence.source)))
    nearer = (
        cv2.GaussianBlur(distance_of_pictures(p, found.wet) - distance_of_pictures(p, found.bare), (0, 0), BLUR)
        for p in frames
    )
    for wetter in median_of_three(nearer):
        yield found.where & (wetter > 0.0)
