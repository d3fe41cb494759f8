"""What the silhouette says: where a body of smoke grows, its edge moves with the fluid.

Smoke has little texture and its stem looks the same from frame to frame, so optical flow reports a fraction of the
rise. The kinematic condition at the edge does not depend on texture: the cap goes up as fast as the fluid below it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

LARGEST_FACTOR = 3.0
"""nothing is raised beyond so many times the best seen rise: from there the silhouette says more about the mask than
about the fluid"""
STILL = 0.3
"""px per frame: the growth of a silhouette cannot be told from noise below this"""
UNSEEN, SEEN = 0.25, 0.75
"""shares of the cap's speed: rows of the flow that rise by less than the first are raised to it, those above the second
are left alone. On a simulated plume whose flow sees all of the rise near the cap and a quarter in the stem, the mean
error falls from 2.0 px to 1.5 (1.6 for 0.1 and 0.4, 1.45 for 0.5 and 0.75); where the flow sees most of it everywhere
nothing changes, but 0.5 and 0.75 then cost 4 % in the wake of an obstacle, which is truly slower than the cap."""
ROWS = 0.03
"""height of the window over which a row's rise is averaged, as a share of the body's height"""


def cap_speed(masks: Bool[np.ndarray, "t h w"], t: int, *, half_window: int = 6) -> float:
    """Speed (px per frame, positive upwards) of the upper end of the silhouette around frame t.

    The upper end is the row above which 3 % of the silhouette lie; its slope over the window is a median of pairwise
    slopes (Theil-Sen), so that single bad masks do not count. 0 where the silhouette touches the upper border.
    """
    first, last = max(t - half_window, 0), min(t + half_window + 1, len(masks))
    rows, frames = [], []
    for k in range(first, last):
        count = masks[k].sum(axis=1)
        if count.sum() == 0 or masks[k][:2].any():
            continue
        rows.append(float(np.searchsorted(np.cumsum(count), 0.03 * count.sum())))
        frames.append(k)
    if len(rows) < 4:
        return 0.0
    y, x = np.array(rows), np.array(frames, float)
    i, j = np.triu_indices(len(x), 1)
    return float(-np.median((y[j] - y[i]) / (x[j] - x[i])))


def raised_flow(
    displacement: Float[np.ndarray, "h w 2"], masks: Bool[np.ndarray, "t h w"], t: int
) -> tuple[Float[np.ndarray, "h w 2"], float]:
    """The flow of frame t with rows that hardly rise raised to the speed of the cap, and by how much the body gained.

    What is below a rising cap rises with it, or the body would tear; flow that finds no motion there has found no
    texture. The missing speed is added to the whole row, so that what was seen of its eddies stays. A starting plume's
    stem is faster than its cap: this is the least that it must be.

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
    missing = np.clip((SEEN - rise / target) / (SEEN - UNSEEN), 0.0, 1.0) * np.maximum(target - rise, 0.0)
    out = d.copy()
    out[..., 1] -= np.where(mask, missing[:, None], 0.0).astype(np.float32)
    return out, float(np.clip(-out[mask, 1].mean() / total, 1.0, LARGEST_FACTOR)) if total > 0 else LARGEST_FACTOR


def row_rise(displacement: Float[np.ndarray, "h w 2"], mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, " h"]:
    """Mean upward motion of the mask around each row, px per frame; 0 where there is no fluid."""
    rows = np.flatnonzero(mask.any(axis=1))
    side = 2 * int(0.5 * ROWS * (rows[-1] - rows[0] + 1)) + 1
    window = np.ones(side)
    total = np.convolve((-displacement[..., 1] * mask).sum(axis=1), window, mode="same")
    count = np.convolve(mask.sum(axis=1).astype(np.float64), window, mode="same")
    return np.where(mask.any(axis=1), total / np.maximum(count, 1.0), 0.0)
