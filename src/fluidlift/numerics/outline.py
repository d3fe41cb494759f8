"""Where an outline ends."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

UPPER = 0.03
"""share of an outline's area above its upper end: what is less is a wisp, or noise of the mask"""


def upper_end(rows: Float[np.ndarray, " h"] | Int[np.ndarray, " h"]) -> float:
    """Row above which `UPPER` of an outline lies, whose area per row is given; between rows where it falls there."""
    total = np.concatenate([[0.0], np.cumsum(rows)])
    return float(np.interp(UPPER * total[-1], total, np.arange(len(total))))
