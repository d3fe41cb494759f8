"""Intermittently wetted rocks and banks: places that come back to one picture again and again; water never does.

A splash changes a rock more than the stream changes itself, so its mean change is the water's, and flow follows the
splash across it. What shows between two splashes is always the same: the colour that a place has most often (its
mode over time) is seen in far more of the frames than streaming water ever shows one of its own. Water so calm, or so
much in shade, that it has one colour for long keeps the fluid's colours, or is not surrounded by water that streams.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from fluidlift.shape.background import colour_bins, colour_histogram
from fluidlift.shape.colour_growth import DECISIVE, RARE, STIFFNESS
from fluidlift.shape.evidence import Evidence
from fluidlift.shape.min_cut import disc, edge_weights, min_cut, spread
from fluidlift.shape.moving_front import median_of_three
from fluidlift.shape.region import SMALLEST_SOLID
from fluidlift.shape.still_regions import FLOWS, LARGEST, STOPPED, SURE
from fluidlift.shape.waterline import BINS

COMPARED = 36
"""pictures of a clip that are compared"""
LEAST = 0.3
"""share of the frames below which what a place shows most often is not held to be what lies below"""
BESIDE = 0.025
"""part of the longer side: water must stream so near, twice the radius over which flow is pooled"""
BARE = 4.0
"""times the change that separates still from moving, within which a frame shows the ground: it is lit and wetted
differently from frame to frame, and what else is seen there differs by far more"""
BLUR = 1.0
"""px over which neighbours share what they saw"""


@dataclass(frozen=True)
class WashedGround:
    """What a place shows when nothing covers it."""

    where: np.ndarray
    """bool [h,w]"""
    picture: np.ndarray
    """float32 [h,w,3], opponent colours"""
    still: np.ndarray
    """float32 [h,w], grey levels: difference between two pictures of what does not move"""


def most_often(evidence: Evidence, still: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of the frames in which a place looks as it does most often, float32 [h,w], and that, float32 [h,w,3].

    Args:
        evidence: of the clip.
        still: float32 [h,w], difference within which two pictures are the same.
        where: bool [h,w], where to look; elsewhere the share is 1 and the picture the typical one.
    """
    kept = evidence.pictures
    picked = np.unique(np.linspace(0, len(kept) - 1, min(COMPARED, len(kept))).round().astype(int))
    seen, limit = np.moveaxis(kept[picked][:, where].astype(np.float32), -1, 1), still[where]
    alike = np.ones((len(seen), len(limit)), np.float32)
    for i in range(len(seen)):
        for j in range(i + 1, len(seen)):
            first, second, third = np.abs(seen[i] - seen[j])
            same = first + second + third < limit
            alike[i] += same
            alike[j] += same
    share, picture = np.ones(where.shape, np.float32), evidence.typical.copy()
    share[where] = alike.max(axis=0) / len(seen)
    picture[where] = np.take_along_axis(seen, alike.argmax(axis=0)[None, None], axis=0)[0].T
    return cv2.GaussianBlur(share, (0, 0), BLUR), picture


def washed_ground(evidence: Evidence, region: np.ndarray) -> WashedGround | None:
    """Ground in the region, bool [h,w], that waves wash over; None where there is none, or where nothing streams.

    How long streaming water keeps a colour is taken as normal about its median; washed ground may be bare for any
    share of the time. Colour only speaks against ground: what has the colours of sure water is water.
    """
    flowing = float(np.median(evidence.streaming[region])) if region.any() else 0.0
    if flowing < FLOWS or region.all():
        return None
    longest, still = max(region.shape), np.exp(evidence.level) * evidence.noise
    share, picture = most_often(evidence, still, spread(region, BESIDE * longest))
    streams = region & (evidence.streaming > STOPPED * flowing)
    usual, upper = np.quantile(share[streams], (0.5, 0.75))
    width = max(float(upper - usual) / 0.6745, 1.0 / COMPARED)
    above = np.maximum(share - usual, 0.0) / width
    water = np.clip(-0.5 * above**2 - np.log(width * np.sqrt(2.0 * np.pi)), -SURE, SURE)
    colour = against_ground(evidence, picture, streams & (above < 1.0), region)
    odds = np.where(region, water + np.maximum(colour, 0.0), -SURE)
    found = region & ~min_cut(odds, *edge_weights(picture, STIFFNESS))
    found = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, disc(0.004 * longest)) > 0
    count, parts = cv2.connectedComponents(found.astype(np.uint8), connectivity=4)
    where = np.zeros_like(region)
    for part in range(1, count):
        piece = parts == part
        if not SMALLEST_SOLID * region.size <= piece.sum() <= LARGEST * region.sum():
            continue
        beside = spread(piece, BESIDE * longest) & region & ~found
        washed = (beside & streams).sum() > 0.5 * beside.sum()
        if washed and np.median(share[piece]) > LEAST and colour[piece].mean() < 0.0:
            where |= piece
    return WashedGround(where, picture, still) if where.any() else None


def against_ground(evidence: Evidence, picture: np.ndarray, water: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Log odds, float32 [h,w], that a picture has the colours of sure water, bool [h,w], in any frame.

    Else it has those of the ground: of what lies around the region, or of rocks in it, as likely the one as the other.
    """
    open_ended = np.pad(region, 1, mode="edge")
    rocks = np.asarray(ndimage.binary_fill_holes(open_ended))[1:-1, 1:-1] & ~region
    wet = np.concatenate([frame[water] for frame in evidence.pictures[::4].astype(np.float32)])
    bins, shares = colour_bins(picture, bins=BINS), []
    for seen in (wet, picture[~region & ~rocks], picture[rocks]):
        counts = colour_histogram(seen, bins=BINS)
        shares.append(counts[bins] / max(float(counts.sum()), 1e-6) + RARE)
    ground = 0.5 * (shares[1] + shares[2]) if rocks.any() else shares[1]
    return np.clip(np.log(shares[0] / ground), -DECISIVE, DECISIVE)


def bare_over_time(evidence: Evidence, ground: WashedGround) -> Iterator[np.ndarray]:
    """Where nothing covers the washed ground, bool [h,w] for every frame."""
    limit = BARE * ground.still
    frames = (evidence.source[t].astype(np.float32) for t in range(len(evidence.source)))
    apart = (np.minimum(np.abs(frame - ground.picture).sum(axis=-1) / limit, 3.0) for frame in frames)
    for ratio in median_of_three(apart):
        yield ground.where & (cv2.GaussianBlur(ratio, (0, 0), BLUR) < 1.0)
