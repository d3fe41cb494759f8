"""Vegetation that waves in front of a fluid or beside it: they change as much as it does, but hang on to their place.

A stem or a leaf has few ways to move, and they are slow: half a second later a patch of it looks much as before, or as
it did some swings ago. Water in the same patch has many eddies and ripples, none of which waits so long. So a picture
of the patch is compared with all others that are at least `APART` from it: the nearest of them lies closer to it
than a typical one does by the more, the fewer ways the patch has to move. Light that rises and falls over the whole
patch is left out: spray and clouds do that. A plant must also have the ground's colours and go nowhere: a fluid as
slow as that has its own colours.
"""

from __future__ import annotations

import cv2
import numpy as np

from fluidlift.shape.colour_growth import STIFFNESS, colour_odds
from fluidlift.shape.evidence import Evidence
from fluidlift.shape.min_cut import disc, edge_weights, min_cut
from fluidlift.shape.region import clean_region
from fluidlift.shape.still_regions import SURE

APART = 0.45
"""s between pictures that are compared: the period of plants is about one, half of it brings the other end"""
SHORTEST = 4.0
"""of these intervals in a clip, below which too few pictures are apart"""
COMPARED = 40
"""pictures of a clip that are compared"""
PATCH = 0.012
"""standard deviation of a patch, part of the longer side: that of `evidence.flow_evidence`"""
FEW = 0.5
"""nearest over typical distance of patches that have few ways to move: random ones with six of them come to it"""
STEP = 0.02
"""of that ratio per log odds: among patches of one fluid it is 0.65 +- 0.06, and that density falls so fast at `FEW`"""
STREAMS = 0.3
"""streaming from which a place shows how the fluid of this clip comes back"""


def coming_back(evidence: Evidence, interval: float) -> np.ndarray:
    """float32 [h,w] in [0,1]: distance of a patch to its nearest other picture over that to a typical one (rms).

    Noise differs between any two pictures, so a place that hardly changes has nearly 1.

    Args:
        evidence: of the clip.
        interval: s between frames.
    """
    kept, (height, width) = evidence.pictures, evidence.noise.shape
    size, sigma = (max(width // 2, 8), max(height // 2, 8)), 0.5 * PATCH * max(height, width)
    picked = np.unique(np.linspace(0, len(kept) - 1, min(COMPARED, len(kept))).round().astype(int))
    pictures = [cv2.resize(kept[k].astype(np.float32), size, interpolation=cv2.INTER_AREA) for k in picked]
    even = [cv2.GaussianBlur(picture, (0, 0), sigma) for picture in pictures]
    moments = evidence.source.sampled[picked] * interval
    nearest = np.full((len(picked), size[1], size[0]), np.inf, np.float32)
    total, pairs = np.zeros((size[1], size[0]), np.float32), 0
    for i, moment in enumerate(moments):
        for j in np.flatnonzero(moments >= moment + APART - 1e-6):
            square = cv2.GaussianBlur(((pictures[j] - pictures[i]) ** 2).sum(axis=-1), (0, 0), sigma)
            apart = np.maximum(square - ((even[j] - even[i]) ** 2).sum(axis=-1), 0.0)
            np.minimum(nearest[i], apart, out=nearest[i])
            np.minimum(nearest[j], apart, out=nearest[j])
            total, pairs = total + apart, pairs + 1
    some = np.isfinite(nearest[:, 0, 0])
    ratio = nearest[some].mean(axis=0) / np.maximum(total / max(pairs, 1), 1e-3)
    return cv2.resize(np.sqrt(ratio), (width, height))


def without_plants(evidence: Evidence, score: np.ndarray, region: np.ndarray, interval: float) -> np.ndarray:
    """The region, bool [h,w], without what waves in it; as it is in a short clip, and where nothing streams.

    Nothing comes back sooner than it does where the fluid of the clip streams: then (a clip that repeats itself, a wave
    that stands) coming back says nothing.

    Args:
        evidence: of the clip.
        score: float32 [h,w], log odds of fluid.
        region: bool [h,w], the fluid's outline.
        interval: s between frames.
    """
    streams = region & (evidence.streaming > STREAMS)
    if len(evidence.source) * interval < SHORTEST * APART or streams.mean() < 2e-3:
        return region
    back = coming_back(evidence, interval)
    few = min(FEW, float(np.quantile(back[streams], 0.05)))
    waves = np.maximum(few - back, 0.0) / STEP * (1.0 - evidence.streaming)
    if not (region & (waves > 1.0)).any():
        return region
    picture = evidence.typical
    colour = colour_odds(picture, (region & (waves == 0.0)).astype(np.float32), (~region).astype(np.float32))
    odds = np.where(region, np.clip(score, -SURE, SURE) + colour - waves, -SURE)
    plants = region & ~min_cut(odds, *edge_weights(picture, STIFFNESS))
    plants = cv2.morphologyEx(plants.astype(np.uint8), cv2.MORPH_OPEN, disc(0.008 * max(region.shape)))
    count, parts = cv2.connectedComponents(plants, connectivity=4)
    kept = region.copy()
    for part in range(1, count):
        piece = parts == part
        if np.median(waves[piece]) > 1.0 and colour[piece].mean() < 0.0:
            kept &= ~piece
    return kept if np.array_equal(kept, region) else clean_region(kept)
