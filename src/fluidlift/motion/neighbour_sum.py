"""The paper's interpolation of failed flow as it stands there: a sum over observed pixels, by distance and angle.

    v_k = sum over i in B(k) of w(i) max(0, n_k . v_i / |v_i|) v_i

The paper leaves w and B open. Here B are the `NEIGHBOURS` nearest observed pixels, and w falls with the distance as a
Gaussian whose width is their mean distance, and adds up to one over B; the sum with the cosine in it is then no faster
than they are. It knows neither banks nor jumps of depth: `motion.mainstream`, the default, does.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from fluidlift.motion.direction import checked_flow
from fluidlift.motion.mainstream import OBSERVED_CONFIDENCE

NEIGHBOURS = 64
"""observed pixels that one failed pixel asks: as many as a patch of the flow is wide, along its nearest rim"""
AT_ONCE = 20_000
"""failed pixels whose neighbours are held in memory together: 30 MB"""


def complete_by_sum(
    displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    direction: Float[np.ndarray, "h w 2"],
) -> tuple[Float[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
    """Motion of the failed pixels by the paper's sum; observed ones stay.

    Args:
        displacement: px/frame.
        confidence: 0 to 1.
        mask: the fluid.
        direction: n, unit, from `mainstream_direction`.

    Returns:
        completed float32 [H,W,2] px/frame, 0 outside the mask; observed bool [H,W]. Without a single observed pixel
        the flow is returned as it is, with nothing observed.

    Raises:
        ValueError: an empty mask or shapes that do not fit.
    """
    d, mask = checked_flow(displacement, confidence, mask)
    speed = np.hypot(d[..., 0], d[..., 1])
    observed = mask & (np.asarray(confidence) >= OBSERVED_CONFIDENCE) & (speed > 0)
    failed = mask & ~observed
    out = np.where(mask[..., None], d, 0.0).astype(np.float32)
    if not observed.any() or not failed.any():
        return out, observed
    known = np.argwhere(observed)
    v = d[observed].astype(np.float64)
    unit = v / speed[observed][:, None]
    tree, places, n = cKDTree(known), np.argwhere(failed), np.asarray(direction, np.float64)[failed]
    count = min(NEIGHBOURS, len(known))
    filled = np.empty((len(places), 2))
    for begin in range(0, len(places), AT_ONCE):
        part = slice(begin, begin + AT_ONCE)
        distance, index = (np.reshape(found, (-1, count)) for found in tree.query(places[part], k=count))
        weight = np.exp(-0.5 * (distance / distance.mean(axis=1, keepdims=True)) ** 2)
        weight /= weight.sum(axis=1, keepdims=True)
        weight *= np.maximum(0.0, (n[part][:, None] * unit[index]).sum(axis=-1))
        filled[part] = (weight[..., None] * v[index]).sum(axis=1)
    out[failed] = filled
    return out, observed
