"""Rocks in a stream, and strips of its banks, that its own change hides: still places of the ground's colours, past
which water streams.

The window in which change is pooled, and shade and splashes on a stone, make a small one look nearly as lively as the
water, and so does a wet bank. Two things still tell them: nothing goes anywhere, and the colours are those of what is
no fluid.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from fluidlift.shape.colour_growth import STIFFNESS, colour_odds
from fluidlift.shape.evidence import Evidence
from fluidlift.shape.min_cut import disc, edge_weights, min_cut, spread
from fluidlift.shape.region import SMALLEST_SOLID

FLOWS = 0.3
"""median streaming of the fluid, below which standing still says nothing: most of a still pool does"""
STOPPED = 0.4
"""of the fluid's typical streaming: less goes nowhere"""
SURE = 3.0
"""log odds at which motion is held to say no more"""
LARGEST = 0.1
"""of the fluid: what is larger is seen as still without this"""


def without_ground(evidence: Evidence, region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The region without strips of its banks and without the rocks in it, and these rocks, both bool [h,w].

    What hangs together with the ground around the fluid, or with a rock that was found before, leaves the region; a
    rock of its own must have water streaming past most of it. Nothing is taken from a clip whose fluid goes nowhere,
    and no more than `LARGEST` in one piece.

    Args:
        evidence: of the clip.
        region: bool [h,w], the fluid's outline.
    """
    rocks, longest = np.zeros_like(region), max(region.shape)
    if not region.any() or region.all():
        return region, rocks
    flowing = float(np.median(evidence.streaming[region]))
    if flowing < FLOWS:
        return region, rocks
    pace = evidence.streaming / (STOPPED * flowing)
    picture = evidence.typical
    colour = colour_odds(picture, (region & (pace > 1.0)).astype(np.float32), (~region).astype(np.float32))
    odds = colour + np.clip(SURE * (pace - 1.0), -SURE, SURE)
    ground = region & ~min_cut(odds, *edge_weights(picture, STIFFNESS))
    ground = cv2.morphologyEx(ground.astype(np.uint8), cv2.MORPH_OPEN, disc(0.004 * longest))
    count, parts = cv2.connectedComponents(ground, connectivity=4)
    lively = float(np.median(evidence.fine_activity[region]))
    ashore = cv2.dilate((~region).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    kept = region.copy()
    for part in range(1, count):
        piece = ndimage.binary_fill_holes(parts == part)
        if not SMALLEST_SOLID * region.size <= piece.sum() <= LARGEST * region.sum():
            continue
        if colour[piece].mean() >= 0.0 or np.median(evidence.fine_activity[piece]) >= lively:
            continue
        if (piece & ashore).any():
            kept &= ~piece
            continue
        ring = spread(piece, 0.01 * longest) & ~piece
        if (ring & region & (pace > 1.0)).sum() > 0.5 * ring.sum():
            rocks |= piece
    threads = cv2.morphologyEx(kept.astype(np.uint8), cv2.MORPH_OPEN, disc(0.004 * longest)) > 0
    return threads & ~rocks, rocks
