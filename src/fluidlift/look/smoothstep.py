"""From 0 to 1 with level ends (smoothstep), for arrays and for compiled loops."""

from __future__ import annotations

import numba as nb
import numpy as np
from jaxtyping import Float


def smoothstep(
    values: Float[np.ndarray, "*n"],
    low: float | Float[np.ndarray, "*n"] = 0.0,
    high: float | Float[np.ndarray, "*n"] = 1.0,
) -> Float[np.ndarray, "*n"]:
    """0 up to `low`, 1 from `high` on, t^2 (3 - 2 t) between them."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@nb.njit(cache=True, inline="always")
def eased(share):
    """`smoothstep` of one number from 0 to 1, compiled."""
    t = min(max(share, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)
