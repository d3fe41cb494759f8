"""Sums, lengths and extremes over a last axis of two or three, and boxes around points: colours and vectors.

NumPy goes through such an axis pixel by pixel. Component by component it is ten times as fast, and the same to the bit,
as it adds them in this order too (320 x 200 x 3: 1.14 ms > 0.11 ms). Down long columns of few numbers it is as slow
(the lowest corner of 90,000 points: 2.6 ms > 0.13 ms).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Shaped


def summed(values: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n"]:
    """`values.sum(axis=-1)`, of a floating type."""
    total = values[..., 0]
    for k in range(1, values.shape[-1]):
        total = total + values[..., k]
    return total


def mean_of(values: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n"]:
    """`values.mean(axis=-1)`, of single or double precision."""
    return summed(values) / values.shape[-1]


def least(values: Shaped[np.ndarray, "*n k"]) -> Shaped[np.ndarray, "*n"]:
    """`values.min(axis=-1)`, of numbers that are all numbers."""
    found = values[..., 0]
    for k in range(1, values.shape[-1]):
        found = np.minimum(found, values[..., k])
    return found


def most(values: Shaped[np.ndarray, "*n k"]) -> Shaped[np.ndarray, "*n"]:
    """`values.max(axis=-1)`, of numbers that are all numbers."""
    found = values[..., 0]
    for k in range(1, values.shape[-1]):
        found = np.maximum(found, values[..., k])
    return found


def every(conditions: Bool[np.ndarray, "*n k"]) -> Bool[np.ndarray, "*n"]:
    """`conditions.all(axis=-1)`."""
    found = conditions[..., 0]
    for k in range(1, conditions.shape[-1]):
        found = found & conditions[..., k]
    return found


def lowest(points: Shaped[np.ndarray, "n k"]) -> Shaped[np.ndarray, " k"]:
    """`points.min(axis=0)`, of one point or more.

    Raises:
        ValueError: no points.
    """
    return np.array([points[:, k].min() for k in range(points.shape[1])], points.dtype)


def highest(points: Shaped[np.ndarray, "n k"]) -> Shaped[np.ndarray, " k"]:
    """`points.max(axis=0)`, of one point or more.

    Raises:
        ValueError: no points.
    """
    return np.array([points[:, k].max() for k in range(points.shape[1])], points.dtype)


def lengths(vectors: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n"]:
    """`numpy.linalg.norm(vectors, axis=-1)`, of a floating type."""
    return np.sqrt(summed(vectors**2))
