"""Reaches of quiet water, spray and foam that go on from the water that was found, in scenes of any sort.

`open_water` knows wide water that lies and recedes. Here nothing is asked of the scene: a piece beside the mask is
water where two things hold together.

- It does not keep its place. A camera that is held, or a stabilizer, leaves a tremble, and what trembles with the whole
  picture stands still: the motion that the ground around the mask has in common (an affine one, frame by frame) is
  taken off first. What is left, smoothed over some px, since ripples hang together and noise does not, is weighed by
  the gradient: px by which a place moves by itself. A place without texture, in spray and overexposed foam, says
  little by that, and is neither as still as ground nor as lively as water.
- Water goes on from water: either its colours do not change where it meets the mask, by no more than they vary on
  both sides, or the mask surrounds it (the picture's edges count as neither). What reaches the picture's upper edge
  has to have both, for a sky behind a fall is surrounded by it as well.

Banks, trees behind a fountain and ferns beside a brook, which wander too, meet the water at a step of colour.
"""

from __future__ import annotations

import cv2
import numpy as np

from fluidlift.shape.colour_growth import STIFFNESS, colour_odds
from fluidlift.shape.evidence import Evidence, sharpness
from fluidlift.shape.min_cut import disc, edge_weights, min_cut, spread
from fluidlift.shape.open_water import GIVEN, OF_COLOUR, OF_HEIGHT, RIM, SHARED, SURE, growth_downwards
from fluidlift.shape.region import clean_region

COMPARED = 30
"""pictures of a clip of which the departure from the typical one is averaged"""
FITTED, ROUNDS_OF_FIT = 4000, 3
"""pixels of the ground that the common motion is fitted on, and rounds in which what departs from it loses weight"""
AROUND = 4
"""px from the mask from which a place counts as ground for that"""
RIPPLE = 2.0
"""px at working size over which departures are smoothed: noise of single pixels falls to a seventh"""
LEAST, FLAT = 0.05, 0.5
"""grey levels that a departure and grey levels per px that a gradient are taken to be at least: what coding leaves"""
QUIET_QUANTILE = 0.3
"""of the rest of the picture is taken to be as still as ground is seen to be"""
APART = 0.8
"""log of the ratio of the motion in and around the mask that is taken at least"""
PART, PER_PART = 0.45, 4.0
"""of the way from the log of the ground's motion to that of the mask's at which a place is as likely water as not, and
log odds over the whole way. Of 20 clips the mean overlap is the same to 0.004 from 0.35 to 0.5 and from 4 to 6"""
SMALLEST = 0.005
"""part of the picture below which a piece is not added"""
BESIDE, MIXED = 0.03, 0.006
"""parts of the longer side: how far on both sides of the mask's edge colours are read, and how near to it they mix"""
SAME = 0.7
"""step of the median colour over the mask's edge, in units of what colours deviate on both sides, below which they go
on. Of 29 pieces in 12 clips the nine of water that go on have 0.03 to 0.64, ground has 0.84 to 5.3"""
SPEAK = 10
"""px on either side, below which colours are not compared"""
CODED = 2.0
"""grey levels, deviation that colours have at least"""
SURROUNDED = 0.9
"""part of the outline of a piece, within the picture, that lies at the mask: spray below a fall, foam in a stream"""
TOUCHING = 0.1
"""the same of any piece, at least, as in `open_water`"""
PASSES = 2
"""what a first one adds tells a second one, as the mask does, how water looks and moves and how far up it lies"""


def own_motion(evidence: Evidence, region: np.ndarray) -> np.ndarray:
    """float32 [h,w]: log of about the px by which what a place shows moves by itself, without the common tremble.

    Args:
        evidence: of the clip.
        region: bool [h,w], the mask: the rest of the picture tells how the camera moves.
    """
    kept, typical = evidence.pictures, evidence.typical
    picked = np.unique(np.linspace(0, len(kept) - 1, min(COMPARED, len(kept))).round().astype(int))
    across, down = (cv2.Sobel(typical, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    ground = ~spread(region, AROUND)
    still = np.flatnonzero(ground if ground.any() else np.ones_like(ground))
    still = still[:: max(1, len(still) // FITTED)]
    height, width = region.shape
    rows, columns = (axis.astype(np.float32) / max(region.shape) - 0.5 for axis in np.mgrid[0:height, 0:width])
    slopes = [
        (gradient[..., 0] * weight).ravel()[still] for gradient in (across, down) for weight in (1, columns, rows)
    ]
    terms = np.stack(slopes, axis=1)
    squares = np.zeros(region.shape, np.float32)
    for picture in kept[picked]:
        apart = picture.astype(np.float32) - typical
        u, v = np.split(robust_fit(terms, apart[..., 0].ravel()[still]), 2)
        right, below = (c[0] + c[1] * columns + c[2] * rows for c in (u, v))
        apart -= across * right[..., None] + down * below[..., None]
        smooth = cv2.GaussianBlur(apart, (0, 0), RIPPLE)
        squares += np.einsum("ijk,ijk->ij", smooth, smooth)
    steep = cv2.GaussianBlur(sharpness(typical), (0, 0), RIPPLE)
    moved = np.log((np.sqrt(squares / len(picked)) + LEAST) / (steep + FLAT))
    return cv2.GaussianBlur(moved, (0, 0), SHARED * max(region.shape))


def robust_fit(terms: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[k]: weights of terms [n,k] that give values [n], by least squares in which outliers count less (Cauchy)."""
    weight = np.ones(len(values), np.float32)
    found = np.zeros(terms.shape[1])
    for _ in range(ROUNDS_OF_FIT):
        weighted = terms * weight[:, None]
        found = np.linalg.solve(weighted.T @ terms + 1e-3 * np.eye(terms.shape[1]), weighted.T @ values)
        off = np.abs(values - terms @ found)
        weight = 1.0 / (1.0 + (off / (2.0 * np.median(off) + 0.2)) ** 2)
    return found.astype(np.float32)


def with_quiet_reaches(evidence: Evidence, region: np.ndarray, barred: np.ndarray) -> np.ndarray:
    """The region, bool [h,w], and what goes on from it and moves by itself; else the same array. Nothing is taken away.

    Args:
        evidence: of the clip.
        region: bool [h,w], the fluid's outline.
        barred: bool [h,w], what is no fluid in any case: rocks, hands, plants, all above a horizon.
    """
    if not region.any() or region.all():
        return region
    motion, weights = own_motion(evidence, region), edge_weights(evidence.typical, STIFFNESS)
    found = region
    for _ in range(PASSES):
        if found.all():
            break
        added = reaches_beside(evidence.typical, motion, found, barred & ~found, weights)
        if not added.any():
            break
        found = (clean_region(found | added) & ~barred) | found
    return found


def reaches_beside(
    picture: np.ndarray, motion: np.ndarray, region: np.ndarray, barred: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:  # fmt: skip
    """bool [h,w]: what goes on from a region and moves by itself.

    Args:
        picture: float32 [h,w,3], typical opponent colours.
        motion: float32 [h,w], of `own_motion`.
        region: bool [h,w], neither empty nor everything.
        barred: bool [h,w], outside it, what is no fluid in any case.
        weights: of the edges of the picture, of `edge_weights`.
    """
    colour = colour_odds(picture, region.astype(np.float32), (~region).astype(np.float32))
    odds = np.clip(motion_odds(motion, region) + OF_COLOUR * colour, -SURE, SURE)
    odds[region], odds[barred] = GIVEN, -GIVEN
    found = min_cut(odds, *weights) | region
    return pieces_that_go_on(picture, found & ~region, region)


def motion_odds(motion: np.ndarray, region: np.ndarray) -> np.ndarray:
    """float32 [h,w]: log odds of water of what moves by itself, `own_motion`, around a region, bool [h,w].

    What moves in the region tells what to look for; where it recedes, at each row. Above its upper end it is less
    likely, as in `open_water`.
    """
    height = len(region)
    rows = np.broadcast_to(np.arange(height, dtype=np.float32)[:, None], region.shape)
    still, lively = np.quantile(motion[~region], QUIET_QUANTILE), np.median(motion[region])
    growth = max(growth_downwards(motion, region), 0.0)
    expected = lively + np.minimum(growth * (rows - rows[region].mean()), 0.0)
    share = np.clip((motion - still) / np.maximum(expected - still, APART), -0.2, 1.2)
    above = np.maximum(np.quantile(rows[region], 0.02) - rows, 0.0) / height
    return (PER_PART * (share - PART) + OF_HEIGHT * above).astype(np.float32)


def pieces_that_go_on(picture: np.ndarray, added: np.ndarray, region: np.ndarray) -> np.ndarray:
    """bool [h,w]: the pieces of `added` that are no rim, and that go on from the region or are surrounded by it.

    Args:
        picture: float32 [h,w,3], typical opponent colours.
        added: bool [h,w], what could be water.
        region: bool [h,w], the mask.
    """
    longest, kept = max(region.shape), np.zeros_like(region)
    rim = RIM * longest
    thick = cv2.morphologyEx(added.astype(np.uint8), cv2.MORPH_OPEN, disc(rim))
    parts, stats = cv2.connectedComponentsWithStats(thick, connectivity=4)[1:3]
    outline = (thick > 0) & (cv2.erode(thick, np.ones((3, 3), np.uint8)) == 0)
    at_mask = outline & spread(region, rim)
    for part in np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= SMALLEST * region.size):
        piece = parts == part
        if part == 0:
            continue
        touching = (at_mask & piece).sum() / max((outline & piece).sum(), 1)
        if touching < TOUCHING:
            continue
        same, surrounded = step_of_colour(picture, piece, region) < SAME, touching >= SURROUNDED
        if (same and surrounded) if piece[0].any() else (same or surrounded):
            kept |= piece
    return kept


def step_of_colour(picture: np.ndarray, piece: np.ndarray, region: np.ndarray) -> float:
    """How far the colours of a piece are from those of the region where both meet, in units of their deviation.

    Args:
        picture: float32 [h,w,3], typical opponent colours.
        piece: bool [h,w].
        region: bool [h,w], apart from it.
    """
    longest = max(region.shape)
    medians, deviation = [], CODED
    for here, there in ((piece, region), (region, piece)):
        side = here & spread(there, BESIDE * longest) & ~spread(there, MIXED * longest)
        if side.sum() < SPEAK:
            return np.inf
        colours = picture[side]
        medians.append(np.median(colours, axis=0))
        deviation += float(np.median(np.abs(colours - medians[-1]), axis=0).sum())
    return float(np.abs(medians[0] - medians[1]).sum()) / deviation
