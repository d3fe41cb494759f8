"""Points sorted into cubes of space, so that what is near a place is found in 27 of them (cell list, Numba).

The cells repeat in space, so that a stray particle far away costs no memory: what lies in a cell by that alone is far
off, and is told by its distance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require
from fluidlift.numerics.short_axis import highest, lowest

CELLS_PER_POINT = 4
"""at most, of the cells that are kept"""


class CellList(NamedTuple):
    """Cubes of `width` from `low` on (m); the points of cube number c are `order[starts[c]:starts[c + 1]]`."""

    low: Float[np.ndarray, "3"]
    width: float
    shape: Int[np.ndarray, "3"]
    """cells along each axis before they repeat: 3 or more, so that the 27 around a place differ"""
    order: Int[np.ndarray, " n"]
    starts: Int[np.ndarray, " cells+1"]

    @classmethod
    def of(cls, points: Float[np.ndarray, "n 3"], width: float) -> CellList:
        """Of points (m), finite.

        Raises:
            ValueError: no points, or a width that is not positive.
        """
        require(len(points) > 0, "no points", "one or more")
        require(np.isfinite(width) and width > 0, f"cells of {width}", "positive metres")
        low = lowest(points).astype(np.float64)
        shape = _cells(highest(points) - low, width, CELLS_PER_POINT * len(points) + 1000)
        cells = np.empty(len(points), np.int64)
        cells_kernel(points, low, float(width), shape, cells)
        order, starts = np.empty(len(points), np.int64), np.zeros(int(shape.prod()) + 1, np.int64)
        sort_kernel(cells, starts, order)
        return cls(low, float(width), shape, order, starts)


def _cells(extent: Float[np.ndarray, "3"], width: float, most: int) -> Int[np.ndarray, "3"]:
    shape = np.clip(np.floor(extent / width) + 1, 3, most)
    while shape.prod() > most and shape.max() > 3:
        longest = int(shape.argmax())
        shape[longest] = max(3, shape[longest] // 2)
    return shape.astype(np.int64)


@nb.njit(cache=True, nogil=True)
def cells_kernel(points, low, width, shape, cells):
    """The number of each point's cell."""
    for p in range(points.shape[0]):
        number = 0
        for axis in range(3):
            at = np.int64(math.floor((points[p, axis] - low[axis]) / width))
            if at < 0 or at >= shape[axis]:  # few are, and a remainder takes as long as all else here
                at %= shape[axis]
            number = number * shape[axis] + at
        cells[p] = number


@nb.njit(cache=True, nogil=True)
def sort_kernel(cells, starts, order):
    """Points in the order of their cells, those of one cell in their own, and where each cell begins (counting sort);
    `starts` holds zeros before."""
    for c in cells:
        starts[c + 1] += 1
    for c in range(len(starts) - 1):
        starts[c + 1] += starts[c]
    following = starts.copy()
    for p in range(len(cells)):
        order[following[cells[p]]] = p
        following[cells[p]] += 1
