"""Nearest neighbours in a k-d tree."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree


def nearest(
    points: Float[np.ndarray, "m d"],
    places: Float[np.ndarray, "n d"],
    count: int | Int[np.ndarray, " k"] = 1,
    *,
    within: float = np.inf,
    workers: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Distance and index of the points nearest to each place, as arrays: what SciPy itself returns may be numbers.

    Args:
        points: to search in.
        places: to search from, in the same unit.
        count: of neighbours; [n] for the number 1, else [n,count]. An array names which of them (1 is the nearest).
        within: distance beyond which none is found: the distance is infinite then, and the index m.
        workers: threads; -1 for all processors.
    """
    distance, index = cKDTree(points).query(places, k=count, distance_upper_bound=within, workers=workers)
    return np.asarray(distance), np.asarray(index)
