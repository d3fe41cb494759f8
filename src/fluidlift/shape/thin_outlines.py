"""Outlines of what is as thin as a jet, where its change has fallen to half: that far from its middle a blur reaches.

An edge that a lens, the codec and our own smoothing blurred lies where the step is half done. Evidence of change is
held against the noise of what stands, and a jet changes by twenty times that: its flanks pass far outside of it, and
its mask is twice as wide as it is. A river loses a pixel by that, a jet half of its outline.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool

from fluidlift.shape.evidence import Evidence, lagged_change
from fluidlift.shape.min_cut import disc, spread

THIN = 0.03
"""part of the longer side: what is narrower (radius) is thin, which counts what the flanks add"""
RIDGE = 0.02
"""part of the longer side, over which the middle of a thin thing is looked for: its widest half"""
HALF = 0.5
"""of the change in the middle at which the outline lies"""
BLUR = 0.7
"""px over which single frames' grain is shared"""
BESIDE = 2.0
"""px from what is wide, within which nothing is taken: what falls into a pool ends there"""
GAP = 0.008
"""part of the longer side: gaps along a jet that are narrower (radius) are of its own pattern"""


def slimmed(evidence: Evidence, region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The region with its thin parts as wide as they are seen to change by half of what their middle does.

    Nothing is taken where half of that is no more than what parts still from moving.

    Args:
        evidence: of the clip.
        region: the fluid's outline.
    """
    longest = max(region.shape)
    wide = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_OPEN, disc(THIN * longest)) > 0
    thin = region & ~spread(wide, BESIDE)
    if not thin.any():
        return region
    change = np.maximum(lagged_change(evidence.pictures, evidence.source.pairs(1)) - evidence.noise, 0.0)
    change = cv2.GaussianBlur(change, (0, 0), BLUR)
    middle = cv2.dilate(np.where(thin, change, np.float32(0.0)), disc(RIDGE * longest))
    middle = cv2.GaussianBlur(middle, (0, 0), RIDGE * longest)
    limit = HALF * middle
    kept = ~thin | (change > limit) | (limit < np.exp(evidence.level) * evidence.noise)
    closed = cv2.morphologyEx((region & kept).astype(np.uint8), cv2.MORPH_CLOSE, disc(GAP * longest)) > 0
    return region & closed
