"""The shape of a plume seen from the side: round across its rise, and seen as far as its smoke lets the eye in."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

SIGHT = 0.4
"""share of a plume's thickness behind its near side at which it is seen in the mean: that of a density that falls off
like a bell (taken to end at 5 % of its middle) at an optical depth of 2. It is 0.45 at 1 and 0.32 at 4"""
JOINED = 0.1
"""gaps across a section that are narrower than this share of the usual width are folds of one body"""
LEAST_TURN = 1.0
"""degrees of roll from which the picture is turned upright first"""


def section_half_thickness(mask: Bool[np.ndarray, "h w"], roll: float = 0.0) -> Float[np.ndarray, "h w"]:
    """Half the extent along the view, px, of a body whose level sections are circles.

    What rises is mixed with the air around it alike on all sides: over many plumes its section is round about its
    middle, whatever its outline is at one instant. The radius is that of the section, not the distance to the nearest
    point of the outline, as for a body that is round about a curved middle line.

    Args:
        mask: silhouette.
        roll: degrees that the picture is turned clockwise.
    """
    if abs(roll) > LEAST_TURN:
        turned = ndimage.rotate(np.pad(mask, 1), roll, order=0)
        half = ndimage.rotate(section_half_thickness(turned), -roll, order=1)
        top, left = ((b - a) // 2 for a, b in zip(mask.shape, half.shape, strict=True))
        return np.where(mask, np.maximum(half[top : top + mask.shape[0], left : left + mask.shape[1]], 0.0), 0.0)
    widths = mask.sum(axis=1)
    usual = float(np.median(widths[widths > 0])) if widths.any() else 0.0
    body = _joined(mask, max(round(0.5 * JOINED * usual), 1))
    half = np.zeros(mask.shape)
    for row in np.flatnonzero(body.any(axis=1)):
        edges = np.flatnonzero(np.diff(np.pad(body[row].astype(np.int8), 1)))
        for first, end in edges.reshape(-1, 2):
            across = np.arange(first, end) + 0.5 - 0.5 * (first + end)
            half[row, first:end] = np.sqrt(0.25 * (end - first) ** 2 - across**2)
    # neighbouring sections share their eddies, which are not smaller than a tenth of the width
    return ndimage.gaussian_filter(half, (max(JOINED * usual / 2, 0.5), 0.5)) * mask


def _joined(mask: np.ndarray, reach: int) -> np.ndarray:
    """The mask with folds of up to twice the reach closed, and its holes filled."""
    wide = np.pad(mask, 2 * reach + 1, mode="edge")  # a plume cut by the picture's edge goes on beyond it
    grown = _distance(~wide) <= reach if not wide.all() else wide
    closed = _distance(grown) > reach if not grown.all() else grown
    inside = (slice(2 * reach + 1, -2 * reach - 1),) * 2
    return np.asarray(ndimage.binary_fill_holes(closed[inside] | mask))


def _distance(inside: np.ndarray) -> np.ndarray:
    return np.asarray(ndimage.distance_transform_edt(inside))
