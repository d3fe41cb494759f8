"""Moving front of a silhouette: where a body of smoke grows, its edge moves with the fluid.

Smoke has little texture and its stem looks the same from frame to frame, so optical flow reports a fraction of the
rise. The kinematic condition at the edge does not depend on texture: the cap goes up as fast as the fluid below it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.numerics.outline import upper_end

LARGEST_FACTOR = 3.0
"""nothing is raised beyond so many times the best seen rise: from there the silhouette says more about the mask than
about the fluid"""
COURSE = 0.5
"""of the body's height, that the cap rises by while its speed is measured. A starting plume's cap slows down as the
cube root of its height (Turner 1962): by an eighth over such a course"""
KNOWN = 0.9
"""share of the cap's speed that the flow must see somewhere, or all of it is too slow; the rest is the error of the
cap's speed"""
STEM_TO_CAP = 1.25
"""mean speed of a row of the stem over that of the cap that it feeds: on the axis of a starting plume 1 / 0.61 (Turner
1962), of which the mean over the width of a bell is three quarters. Where flow sees the stem of a plume of a clip it is
1.2 to 1.7, in a simulated one 1.2 to 1.8"""
NARROW = 0.5
"""of the widest row: what is narrower, and below it, is the stem"""
STILL = 0.3
"""px per frame: the growth of a silhouette cannot be told from noise below this"""
UNSEEN, SEEN = 0.25, 0.75
"""shares of the cap's speed: rows of the flow that rise by less than the first are raised to it, those above the second
are left alone. On a simulated plume whose flow sees all of the rise near the cap and a quarter in the stem, the mean
error falls from 2.0 px to 1.5 (1.6 for 0.1 and 0.4, 1.45 for 0.5 and 0.75); where the flow sees most of it everywhere
nothing changes, but 0.5 and 0.75 then cost 4 % in the wake of an obstacle, which is truly slower than the cap."""
ROWS = 0.03
"""height of the window over which a row's rise is averaged, as a share of the body's height"""


def cap_speed(masks: Bool[np.ndarray, "t h w"], t: int) -> float:
    """Speed (px per frame, positive upwards) of the upper end of the silhouette around frame t.

    The slope of the upper end (`numerics.outline`) over a window is a median of pairwise slopes (Theil-Sen), so that
    single bad masks do not count. The window grows from six frames on either side until the end has risen by
    `COURSE` of the body's height: a thing that stands before the cap, or is taken for smoke, holds up the mask, and not
    the smoke. 0 where the silhouette touches the upper border.
    """
    ends = np.array([_upper_end(mask) for mask in masks])
    rows = np.flatnonzero(masks[t].any(axis=1))
    if not len(rows):
        return 0.0
    goal = COURSE * (rows[-1] - rows[0] + 1)
    for half in range(6, max(len(masks), 7)):
        first, last = max(t - half, 0), min(t + half + 1, len(masks))
        speed = _slope(np.arange(first, last), ends[first:last])
        if speed * (last - first - 1) >= goal or last - first == len(masks):
            break
    return speed


def _upper_end(mask: np.ndarray) -> float:
    """Row of the upper end of a silhouette; not a number where there is none, or it is cut off."""
    count = mask.sum(axis=1)
    if count.sum() == 0 or mask[:2].any():
        return np.nan
    return upper_end(count)


def _slope(frames: np.ndarray, rows: np.ndarray) -> float:
    """Upward speed, 0 where too few rows are known."""
    known = np.isfinite(rows)
    y, x = rows[known], frames[known].astype(float)
    if len(y) < 4:
        return 0.0
    i, j = np.triu_indices(len(x), 1)
    return float(-np.median((y[j] - y[i]) / (x[j] - x[i])))


def raised_flow(
    displacement: Float[np.ndarray, "h w 2"], masks: Bool[np.ndarray, "t h w"], t: int
) -> tuple[Float[np.ndarray, "h w 2"], float]:
    """The flow of frame t with rows that hardly rise raised to the speed of the cap, and by how much the body gained.

    What is below a rising cap rises with it, or the body would tear; flow that finds no motion there has found no
    texture. The missing speed is added to the whole row, so that what was seen of its eddies stays. A stem that is
    narrower than the cap that it feeds is faster than it (`STEM_TO_CAP`). Where not even the swiftest rows are as fast
    as the cap, the flow sees a part of all motion, and is scaled first.

    Args:
        displacement: completed flow, px per frame.
        masks: of the frames around t.
        t: index of the frame among the masks.

    Returns:
        displacement float32, and its mean rise over that before, 1 to `LARGEST_FACTOR` (1 where nothing was raised).
    """
    d, mask = np.asarray(displacement, np.float32), np.asarray(masks[t], bool)
    speed = cap_speed(masks, t)
    if not mask.any() or speed <= STILL:
        return d, 1.0
    rise, total = row_rise(d, mask), float(-d[mask, 1].mean())
    best = float(np.percentile(rise[mask.any(axis=1)], 90))
    target = min(speed, LARGEST_FACTOR * best)
    if target <= 0.0:
        return d, 1.0
    scale = max(KNOWN * target / best, 1.0)
    d, rise = (np.where(mask[..., None], d * np.float32(scale), d), rise * scale) if scale > 1.0 else (d, rise)
    raised = np.clip((SEEN - rise / target) / (SEEN - UNSEEN), 0.0, 1.0) * np.maximum(target - rise, 0.0)
    missing = np.where(_stem(mask), np.maximum(STEM_TO_CAP * target - rise, 0.0), raised)
    out = d.copy()
    out[..., 1] -= np.where(mask, missing[:, None], 0.0).astype(np.float32)
    return out, float(np.clip(-out[mask, 1].mean() / total, 1.0, LARGEST_FACTOR)) if total > 0 else LARGEST_FACTOR


def _stem(mask: np.ndarray) -> np.ndarray:
    """bool per row: below the widest row, and narrow."""
    width = mask.sum(axis=1)
    return (np.arange(len(width)) > int(width.argmax())) & (width < NARROW * width.max())


def row_rise(displacement: Float[np.ndarray, "h w 2"], mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, " h"]:
    """Mean upward motion of the mask around each row, px per frame; 0 where there is no fluid."""
    rows = np.flatnonzero(mask.any(axis=1))
    side = 2 * int(0.5 * ROWS * (rows[-1] - rows[0] + 1)) + 1
    window = np.ones(side)
    total = np.convolve((-displacement[..., 1] * mask).sum(axis=1), window, mode="same")
    count = np.convolve(mask.sum(axis=1).astype(np.float64), window, mode="same")
    return np.where(mask.any(axis=1), total / np.maximum(count, 1.0), 0.0)
