"""What the silhouette says: where a body of smoke grows, its edge moves with the fluid.

Smoke has little texture and its stem looks the same from frame to frame, so optical flow reports a fraction of the
rise. The kinematic condition at the edge does not depend on texture: the cap goes up as fast as the fluid below it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

LARGEST_FACTOR = 3.0
"""flow is never sped up by more: beyond that the silhouette says more about the mask than about the fluid"""


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


def front_factor(displacement: Float[np.ndarray, "h w 2"], masks: Bool[np.ndarray, "t h w"], t: int) -> float:
    """By how much the flow of frame t must be sped up to carry the cap along: 1 to `LARGEST_FACTOR`.

    Args:
        displacement: completed flow, px per frame.
        masks: of the whole clip.
        t: the frame.
    """
    mask = masks[t]
    if not mask.any():
        return 1.0
    speed = cap_speed(masks, t)
    count = np.cumsum(mask.sum(axis=1))
    top = int(np.searchsorted(count, 0.03 * count[-1]))
    bottom = int(np.searchsorted(count, 0.25 * count[-1])) + 1
    cap = mask[top:bottom]
    rise = float(np.mean(-displacement[top:bottom, :, 1][cap])) if cap.any() else 0.0
    if speed <= 0.3 or rise <= 0.05:  # still, or below what masks and flow can tell
        return 1.0
    return float(np.clip(speed / rise, 1.0, LARGEST_FACTOR))
