"""What of a fountain stands in the air, and the pool that it rises from and falls back into.

In the air is what moves along the vertical, from the top of the outline over it down to where that motion ends. What is
wider than tall is several jets in a row, each no wider than tall: one round column would be as deep as the row is long.
What comes down lands in the pool, so the pool reaches at least as far as the columns do, seen or not.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.shape.jets import TRUSTED, JetOutline
from fluidlift.shape.region import largest_piece

MOVES = 0.25
"""of the speed (95th percentile) of the fluid: what is as fast along the vertical is in the air"""
STAND = 0.15
"""of the greatest height in the air at any column of the picture: what is less is splashes beside it"""
TALL = 0.3
"""of the height over where that motion ends, from which the outline stands in the air whether it is seen to move or
not: a pool seen from beside is flat"""
ROWS = 8
"""places along its height at which a column's width is taken, as a jet's (`shape.jets`)"""
BEYOND = 1.15
"""radii of a column that its pool reaches from its axis at least: what lands splashes"""
FEWEST = 6
"""px that a column is tall and wide, at least"""


def find_columns(
    mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
    *,
    pitch: float,
) -> tuple[list[JetOutline], Bool[np.ndarray, "h w"]]:
    """Columns of water in the air, and the pixels of their pool with what they hide of it; no columns where nothing
    moves along the vertical.

    Args:
        mask: fluid pixels.
        motion: mean over the clip, px per frame.
        trust: of it.
        pitch: degrees that the camera looks down; what lies is foreshortened by its sine.
    """
    whole = np.asarray(ndimage.binary_fill_holes(mask), bool)
    airborne = _in_the_air(whole, mask, motion, trust)
    if not airborne.any():
        return [], mask
    found: list[JetOutline] = []
    label, count = ndimage.label(airborne)
    for number in range(1, count + 1):
        part = label == number
        rows, columns = (np.flatnonzero(part.any(axis=a)) for a in (1, 0))
        tall, wide = len(rows), len(columns)
        if min(tall, wide) < FEWEST:
            continue
        for group in np.array_split(columns, max(round(wide / tall), 1)):
            own = part.copy()
            own[:, : group[0]] = False
            own[:, group[-1] + 1 :] = False
            found.append(_column(own, motion, trust))
    return found, _pool(whole, airborne, found, pitch) if found else mask


def _in_the_air(whole: np.ndarray, mask: np.ndarray, motion: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """bool [h,w]: from the top of the outline down to where motion along the vertical ends."""
    upright = np.abs(motion[..., 1])
    known = mask & (trust > TRUSTED)
    if not known.any():
        return np.zeros_like(whole)
    fast = known & (upright > MOVES * np.percentile(upright[known], 95))
    fast = ndimage.binary_opening(fast, np.ones((3, 3), bool))
    rows = np.arange(len(whole))[:, None]
    top = np.where(whole.any(axis=0), whole.argmax(axis=0), len(whole))
    end = np.where(fast, rows, -1).max(axis=0)
    tall = np.where(end >= 0, end - top + 1, 0)
    end = np.where(tall > STAND * tall.max(initial=0), end, -1)
    stands = np.flatnonzero(end >= 0)
    if not len(stands):
        return np.zeros_like(whole)
    # where a core is white throughout, or a jet too fast, no motion is seen: it ends where it does on both sides
    foot, highest = end.max(), top[stands].min()
    over = (end >= 0) | (top < foot - TALL * (foot - highest))
    piece, count = ndimage.label(ndimage.binary_closing(np.pad(over, FEWEST), np.ones(2 * FEWEST + 1, bool)))
    piece, columns = piece[FEWEST:-FEWEST], np.arange(len(end))
    for number in range(1, count + 1):
        here = columns[piece == number]
        known = here[end[here] >= 0]
        if not len(known):
            continue
        level = ndimage.median_filter(np.interp(here, known, end[known]), 2 * FEWEST + 1, mode="nearest")
        left, right = np.maximum.accumulate(level), np.maximum.accumulate(level[::-1])[::-1]
        end[here] = np.minimum(left, right)
    return whole & (rows >= top) & (rows <= end)


def _pool(whole: np.ndarray, airborne: np.ndarray, columns: list[JetOutline], pitch: float) -> np.ndarray:
    """bool [h,w]: what lies, with what the columns hide of it. Basins are convex, or cut by the picture's edge."""
    landing = np.any([_landing(column, whole.shape, pitch) for column in columns], axis=0)
    far = int(np.flatnonzero(landing.any(axis=1))[0])
    beside = np.flatnonzero(whole.any(axis=0) & ~airborne.any(axis=0))
    rows = np.arange(len(whole))[:, None]
    if len(beside) > 0.05 * whole.shape[1]:  # its far edge is seen
        far = min(far, int(np.percentile(whole[:, beside].argmax(axis=0), 10)))
    seen = largest_piece((whole & ~airborne & (rows >= far)) | landing)
    at = np.argwhere(seen)[:, ::-1].astype(np.int32)
    out = np.zeros(whole.shape, np.uint8)
    cv2.fillConvexPoly(out, cv2.convexHull(at), 1)
    return (out > 0) & (seen | (airborne & (rows >= far)))


def _column(part: np.ndarray, motion: np.ndarray, trust: np.ndarray) -> JetOutline:
    """Middle, width and nozzle of one column."""
    rows = np.flatnonzero(part.any(axis=1))
    top, foot = float(rows[0]), float(rows[-1] + 1)
    edges = np.linspace(top, foot, int(np.clip((foot - top) / 6.0, 2, ROWS)) + 1)
    centers, halves = [], []
    for low, high in zip(edges[:-1], edges[1:]):
        band = part[int(np.floor(low)) : max(int(np.ceil(high)), int(np.floor(low)) + 1)]
        share = band.sum(axis=0)
        places = np.repeat(np.arange(part.shape[1]) + 0.5, share)
        centers.append(float(places.mean()))
        halves.append(max(0.5 * float(share.sum()) / len(band), 0.5))
    at = np.concatenate([[top], 0.5 * (edges[1:] + edges[:-1]), [foot]])
    middle = np.full(len(at), np.average(centers, weights=halves))
    widths = np.concatenate([[0.5 * halves[0]], halves, [halves[-1]]])
    # its upper edge is where drops turn, no rim of a top
    return JetOutline(
        part, np.stack([middle, at], axis=1), widths, cut=True, nozzle=_nozzle(part, motion, trust, edges)
    )


def _nozzle(part: np.ndarray, motion: np.ndarray, trust: np.ndarray, edges: np.ndarray) -> tuple[float, float]:
    """Where the column rises from: below what goes up in the lower two thirds of it, else below its middle."""
    foot = float(edges[-1])
    columns = np.arange(part.shape[1]) + 0.5
    low = part & (np.arange(len(part))[:, None] > edges[0] + (edges[-1] - edges[0]) / 3.0)
    up = np.where(low & (trust > 0.0), np.maximum(-motion[..., 1], 0.0), 0.0)
    seen = float(up.sum()) > 0.02 * float(np.abs(motion[..., 1])[low].sum())
    weight = up.sum(axis=0) if seen else part.sum(axis=0)
    return float(np.average(columns, weights=np.maximum(weight, 1e-9))), foot


def _landing(column: JetOutline, shape: tuple[int, int], pitch: float) -> np.ndarray:
    """bool [h,w]: the circle that the column lands in, as the camera sees it."""
    (u, v), half = column.centers[-1], BEYOND * float(column.half_widths.max())
    flat = max(half * np.sin(np.radians(max(pitch, 3.0))), 2.0)
    y, x = np.mgrid[0.5 : shape[0], 0.5 : shape[1]]
    near = float(column.half_widths[-1]) * np.sin(np.radians(max(pitch, 3.0)))
    return ((x - u) / half) ** 2 + ((y - (v - near)) / flat) ** 2 < 1.0
