"""Sums and lengths over a last axis of two or three: colours and vectors of pictures.

NumPy goes through such an axis pixel by pixel. Component by component it is ten times as fast, and the same to the bit,
as it adds them in this order too (320 x 200 x 3: 1.14 ms > 0.11 ms).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def summed(values: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n"]:
    """`values.sum(axis=-1)`, of a floating type."""
    total = values[..., 0]
    for k in range(1, values.shape[-1]):
        total = total + values[..., k]
    return total


def lengths(vectors: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n"]:
    """`numpy.linalg.norm(vectors, axis=-1)`, of a floating type."""
    return np.sqrt(summed(vectors**2))
