"""Quiet water of a stream, a river or the sea, beside its moving water: a second pass over the mask of a wide fluid.

What changes little is ground or quiet water. Three things tell them apart where a fluid is wide:

- *wander*, about the pixels by which a texture moves: how far a place departs from its typical look, over its gradient.
  Faint ripples hardly change the brightness of a dark or hazy place, but they do move what little texture it has. Seen
  along level water it falls with the distance, by as much as the rows of the mask itself show;
- colour: that of the fluid against that of the rest;
- height in the picture: water that lies level does not rise above its own far end.

Each is a log odds of a logistic regression (`benchmarks/open_water_fit.py`), and what is added is cut out along edges.
A bank ends where the wander does, so a rim around the mask is not water; nor is a small patch: that is the
error of an outline, or a wall in which the water is mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fluidlift.shape.colour_growth import STIFFNESS, colour_odds
from fluidlift.shape.evidence import (
    Evidence,
    distance_of_pictures,
    lagged_change,
    noise_map,
    otsu_threshold,
    sharpness,
)
from fluidlift.shape.frame_pictures import FramePictures, typical_picture, working_scale
from fluidlift.shape.min_cut import disc, edge_weights, min_cut
from fluidlift.shape.region import clean_region

WIDE = 0.3
"""part of the picture that moving water must fill. Of 15 real clips of rivers, falls and surf those with less (brooks,
cascades, a fall in its pool: 0.12 to 0.24) have ferns and wet rock beside the water that wander as quiet water does"""
MODES_APART = 4.2
"""distance of the means of the two modes of the log of the wander, over their spread, from which it alone tells how
far the water goes"""
MOSTLY = 0.8
"""part of the mask that is in the upper mode there: it is found by another clue, and has to agree"""
UNSTEADY = 0.3
"""px of wander of the quiet part of what is around the fluid, from which the camera itself goes on and wander tells
nothing: 0.41 to 0.74 in three clips where it does, 0 to 0.22 where it stands or is held"""
RECEDES = 0.5
"""by how much the log of the wander in the mask grows from the picture's top to its bottom, at least: water that lies
is further away higher up. 1.0 to 2.4 in five clips of it, -0.8 in a fountain before trees that the cut would take"""
STILLEST = 0.02
"""of the whole picture is still at least, where the fluid may be nearly everything: a rock, a strip of beach"""
ALIKE = 0.25
"""of the way from the log of the stillest wander to that of the mask: where the middle of the rest of the picture is
that near to the mask's, most of it moves as the fluid does. Surf from above of which the foam alone was found is off by
0.04 to 0.10, of 30 other clips 26 by 0.39 and more, milk in coffee by 0.33, a weir by 0.2 (nothing is much stiller), a
tall fall by 0.15 (its camera moves, it is not wide), honey before a machine that trembles by 0.09 (it runs out of no
side)"""
SIDES, RUNS_OUT = 3, 0.1
"""of the picture that such a fluid runs out of, over so much of each: a vessel or a tray keeps it in, a bank or a wall
beside it leaves two"""
QUIET_QUANTILE = 0.2
"""of the rest of the picture is taken to be still: as in `evidence.noise_map`"""
COMPARED = 40
"""pictures of a clip of which the departure from the typical one is averaged"""
NOISE_OF_MEAN = 0.8
"""mean departure of a still thing from its median, as part of its mean change between frames (0.71 for normal noise,
a little more for that of a codec)"""
FINE, SHARED = 1.5, 0.006
"""px over which departure and gradient are pooled; part of the longer side over which the log of the wander is: a rim
of lively water does not spread far in the log"""
FLAT = 0.5
"""grey levels per px, gradient of a place without texture"""
STILL = 0.2
"""px of wander that says nothing: what is left of a tremble"""
RIM = 0.012
"""part of the longer side: wander is the least so near, and strips narrower than twice this are no water; the radius
over which wander, change and flow are pooled, together"""
APART = 0.6
"""log of the ratio of the wander in and around the fluid that is taken at least: below it they hardly differ"""
ROUNDS = 3
"""in which the colours are read anew from the larger region"""
SMALLEST = 0.03
"""part of the picture below which a piece is not added. With each of 12 clips predicted by the others, all that is
added above it is water; at 0.02 two of six pieces are not (a gate that mirrors the water, a bank of dead leaves)"""
TOUCHING = 0.1
"""part of the outline of a piece that lies at the mask or within a rim of it, at least: quiet water goes on from moving
water. Of seven pieces in five clips the five of water have 0.22 to 0.66, a hedge and a far bank have none"""
SURE = 4.0
"""log odds at which the field is held to say no more"""
GIVEN = 8.0
"""log odds by which the mask, its rocks and moving solids are kept"""
OF_WANDER, OF_COLOUR, OF_HEIGHT, BIAS = 4.6, 0.21, -10.0, -1.5
"""log odds per unit of each term of `Field`, and of a place that has none of them: logistic regression on pixels
outside the masks of 9 real and 3 made clips of wide water"""


@dataclass(frozen=True)
class Field:
    """What tells quiet water from ground around a region, each float32 [h,w]."""

    wander: np.ndarray
    """log of the wander: 0 as around the region, 1 as in it at that row; -0.2 to 1.2"""
    colour: np.ndarray
    """log odds of the region's colours"""
    height: np.ndarray
    """how far above the region's upper end, part of the picture's height"""

    @property
    def odds(self) -> np.ndarray:
        """float32 [h,w], log odds of water."""
        return OF_WANDER * self.wander + OF_COLOUR * self.colour + OF_HEIGHT * self.height + BIAS


def log_wander(evidence: Evidence) -> np.ndarray:
    """float32 [h,w], of `wander_of` the pictures of a clip."""
    kept = evidence.pictures
    picked = np.unique(np.linspace(0, len(kept) - 1, min(COMPARED, len(kept))).round().astype(int))
    return wander_of(kept[picked], typical_picture(kept), evidence.noise)


def wander_of(pictures: np.ndarray, typical: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """float32 [h,w]: log of about the px by which what a place shows moves, and `STILL`; the least within `RIM`.

    Args:
        pictures: [n,h,w,3], opponent colours.
        typical: float32 [h,w,3], their median.
        noise: float32 [h,w], mean absolute change of a still thing from picture to picture, grey levels.
    """
    longest = max(noise.shape)
    departure = sum(distance_of_pictures(picture, typical) for picture in pictures) / len(pictures)
    steep = np.zeros(typical.shape[:2], np.float32)
    for channel in range(3):
        plane = np.ascontiguousarray(typical[..., channel])
        steep += np.hypot(
            cv2.Sobel(plane, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(plane, cv2.CV_32F, 0, 1, scale=0.125)
        )
    beyond = np.maximum(departure - NOISE_OF_MEAN * noise, 0.0).astype(np.float32)
    beyond, steep = (cv2.GaussianBlur(x, (0, 0), FINE) for x in (beyond, steep))
    pooled = cv2.GaussianBlur(np.log(beyond / (steep + FLAT) + STILL), (0, 0), SHARED * longest)
    return cv2.GaussianBlur(cv2.erode(pooled, disc(RIM * longest)), (0, 0), FINE)


def recession(frames: np.ndarray, region: np.ndarray) -> float:
    """By how much the log of the wander grows within a region from the top of the picture to its bottom.

    What moves on water that lies moves by fewer px the farther it is, which is the higher up in the picture.

    Args:
        frames: u8 [n,h,w,3], sRGB, a few of a clip.
        region: bool [h,w].
    """
    source = FramePictures(frames, np.arange(len(frames)), working_scale(*region.shape))
    noise = noise_map(lagged_change(source.kept, source.pairs(1)), sharpness(source.typical))
    wander = wander_of(source.kept, source.typical, noise)
    inside = cv2.resize(region.astype(np.float32), wander.shape[::-1], interpolation=cv2.INTER_AREA) > 0.99
    return growth_downwards(wander, inside) * len(inside) if inside.any() else 0.0


def lies_open(region: np.ndarray, wander: np.ndarray) -> bool:
    """Whether a region, bool [h,w], is wide water that lies, before a camera that stands: it recedes, or fills all.

    Args:
        region: what moves in it.
        wander: float32 [h,w], of `log_wander`.
    """
    if region.mean() < WIDE or region.all():
        return False
    if is_part_of_all(region, wander):
        return True
    steady = float(np.quantile(wander[~region], QUIET_QUANTILE)) < np.log(UNSTEADY + STILL)
    return steady and growth_downwards(wander, region) * len(region) > RECEDES


def is_part_of_all(region: np.ndarray, wander: np.ndarray) -> bool:
    """Whether a region, bool [h,w], is a part of what moves alike nearly everywhere, before a camera that stands.

    So does water that is looked down on steeply, out to the picture's edges: it does not recede, and what its foam, its
    colours or its streams tell is a part of it. Falls and fountains have something still around them.

    Args:
        region: what was found of it.
        wander: float32 [h,w], of `log_wander`.
    """
    edges = (region[0], region[-1], region[:, 0], region[:, -1])
    if sum(bool(edge.mean() > RUNS_OUT) for edge in edges) < SIDES:
        return False
    still, rest, moving = np.quantile(wander, STILLEST), np.median(wander[~region]), np.median(wander[region])
    steady = still < np.log(UNSTEADY + STILL) and min(rest, moving) - still > APART
    return bool(steady and abs(rest - moving) < ALIKE * (moving - still))


def growth_downwards(wander: np.ndarray, region: np.ndarray) -> float:
    """By how much the log of the wander, float32 [h,w], grows per row within a region, bool [h,w] (least squares)."""
    rows = np.nonzero(region)[0].astype(np.float64)
    off = rows - rows.mean()
    return float((off * wander[region]).sum() / max(float((off**2).sum()), 1.0))


def field_around(wander: np.ndarray, picture: np.ndarray, region: np.ndarray, found: np.ndarray) -> Field:
    """What tells quiet water from ground.

    Args:
        wander: float32 [h,w], of `log_wander`.
        picture: float32 [h,w,3], typical opponent colours.
        region: bool [h,w], the mask; neither empty nor everything.
        found: bool [h,w], the mask and what was added to it so far: its colours are the water's.
    """
    height = len(region)
    rows = np.broadcast_to(np.arange(height, dtype=np.float32)[:, None], region.shape)
    everywhere = is_part_of_all(region, wander)
    still = np.quantile(wander, STILLEST) if everywhere else np.quantile(wander[~region], QUIET_QUANTILE)
    lively = np.median(wander[region])
    growth = max(growth_downwards(wander, region), 0.0)
    expected = lively + np.minimum(growth * (rows - rows[region].mean()), 0.0)
    share = (wander - still) / np.maximum(expected - still, APART)
    upper = np.quantile(rows[region], 0.02)
    return Field(
        np.clip(share, -0.2, 1.2).astype(np.float32),
        colour_odds(picture, found.astype(np.float32), (~found).astype(np.float32)),
        np.maximum(upper - rows, 0.0) / height,
    )


def water_that_wanders(wander: np.ndarray, region: np.ndarray) -> np.ndarray:
    """bool [h,w]: what wanders around a region, where the picture has two clear modes of wander; else the region.

    Change, or the colour of what streams, may have found too small a part of wide water: its quiet part has this mode.

    Args:
        wander: float32 [h,w], of `log_wander`.
        region: bool [h,w], the mask.
    """
    lively = wander > otsu_threshold(wander, float(wander.min()), float(wander.max()))
    upper, lower = wander[lively], wander[~lively]
    apart = float(upper.mean() - lower.mean()) / max(float(np.sqrt(0.5 * (upper.var() + lower.var()))), 1e-6)
    if apart < MODES_APART or (lively & region).sum() < MOSTLY * region.sum():
        return region
    parts = cv2.connectedComponents(lively.astype(np.uint8), connectivity=4)[1]
    held = np.bincount(parts[lively & region], minlength=parts.max() + 1)
    return parts == held.argmax()


def with_open_water(evidence: Evidence, region: np.ndarray, barred: np.ndarray) -> np.ndarray:
    """The region, bool [h,w], and the quiet water beside it where it is wide; else the same array.

    Nothing is taken away, and holes in the region stay as they are. A region that is not wide is held to be a part of
    wide water where what wanders around it is that (`water_that_wanders`).

    Args:
        evidence: of the clip.
        region: bool [h,w], the fluid's outline.
        barred: bool [h,w], what is no fluid in any case: rocks, hands, plants.
    """
    if not region.any():
        return region
    wander = log_wander(evidence)
    whole = region if region.mean() >= WIDE else water_that_wanders(wander, region)
    if not lies_open(whole, wander):
        return region
    picture = evidence.typical
    across, down = edge_weights(picture, STIFFNESS)
    closed = (barred | holes(region)) & ~region
    found = (region | whole) & ~closed
    for _ in range(ROUNDS):
        odds = np.clip(field_around(wander, picture, whole, found).odds, -SURE, SURE)
        odds[region], odds[closed] = GIVEN, -GIVEN
        larger = min_cut(odds, across, down) | region
        if np.array_equal(larger, found):
            break
        found = larger
    added = large_pieces(found & ~region, region)
    return clean_region(region | added) & ~(closed & ~region) if added.any() else region


def holes(region: np.ndarray) -> np.ndarray:
    """bool [h,w]: what the region surrounds."""
    framed = np.pad(~region, 1, constant_values=True).astype(np.uint8)
    parts = cv2.connectedComponents(framed, connectivity=4)[1]
    return ~region & (parts[1:-1, 1:-1] != parts[0, 0])


def large_pieces(added: np.ndarray, region: np.ndarray) -> np.ndarray:
    """bool [h,w]: the pieces of `added` that are no rim and no patch, and that go on from the region."""
    rim = disc(RIM * max(added.shape))
    thick = cv2.morphologyEx(added.astype(np.uint8), cv2.MORPH_OPEN, rim)
    parts, stats = cv2.connectedComponentsWithStats(thick, connectivity=4)[1:3]
    outline = (thick > 0) & (cv2.erode(thick, np.ones((3, 3), np.uint8)) == 0)
    near = cv2.dilate(region.astype(np.uint8), rim) > 0
    length, shared = (np.bincount(parts[line], minlength=len(stats)) for line in (outline, outline & near))
    large = (stats[:, cv2.CC_STAT_AREA] >= SMALLEST * added.size) & (shared >= TOUCHING * np.maximum(length, 1))
    large[0] = False
    return large[np.asarray(parts, int)]
