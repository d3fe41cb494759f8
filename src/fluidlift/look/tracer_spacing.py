"""Which tracers on a plane stand too near to an older one, and which points of a lattice none is near: compiled.

A search tree over all tracers finds the same, and takes most of the time of a skin of a hundred thousand. The spacing
is known here, so a look at the neighbouring cells is enough.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from fluidlift.errors import require
from fluidlift.numerics.cell_list import CellList
from fluidlift.numerics.sharing import shared


def not_crowded(places: Float[np.ndarray, "n 2"], ids: Int[np.ndarray, " n"], apart: float) -> Bool[np.ndarray, " n"]:
    """Which places stay so that of each pair at most `apart` (m) from each other the younger, of the larger id, goes.

    Raises:
        ValueError: a distance that is not positive.
    """
    keep = np.ones(len(places), bool)
    if len(places):
        flat = np.zeros((len(places), 3))
        flat[:, :2] = places
        cells = CellList.of(flat, apart)
        _keep(flat, ids, cells.order, cells.starts, cells.low, cells.width, cells.shape, keep)
    return keep


def bare_points(
    places: Float[np.ndarray, "n 2"], first: Float[np.ndarray, "2"], spacing: float, shape: tuple[int, int],
    within: float,
) -> Bool[np.ndarray, "nx ny"]:  # fmt: skip
    """Which points of a lattice have no place nearer than a distance.

    Args:
        places: m.
        first: number of the lattice's first point, whose place is (first + 1/2) spacing along each axis.
        spacing: of the lattice, m.
        shape: points along each axis.
        within: m.

    Raises:
        ValueError: a spacing or distance that is not positive.
    """
    require(spacing > 0 and within > 0, f"a lattice of {spacing} m, looked around for {within} m", "positive metres")
    bare = np.ones(shape, bool)
    _cover(np.asarray(places, np.float64), np.asarray(first, np.float64), float(spacing), float(within), bare)
    return bare


@shared(lambda points, *_: (0, len(points)), error_model="numpy")
def _keep(begin, end, points, ids, order, starts, low, width, shape, keep):
    around = np.empty((2, 3), np.int64)
    for t in range(begin, end):
        p = order[t]
        x, y = points[p, 0], points[p, 1]
        for axis in range(2):
            at = np.int64(math.floor((points[p, axis] - low[axis]) / width))
            for step in range(3):
                around[axis, step] = (at + step - 1) % shape[axis]
        for a in range(3):
            for b in range(3):
                number = (around[0, a] * shape[1] + around[1, b]) * shape[2]
                for n in range(starts[number], starts[number + 1]):
                    other = order[n]
                    dx, dy = points[other, 0] - x, points[other, 1] - y
                    if dx * dx + dy * dy <= width * width and ids[other] < ids[p]:
                        keep[p] = False


@njit(cache=True, nogil=True)
def _cover(places, first, spacing, within, bare):
    reach = int(math.ceil(within / spacing))
    for p in range(len(places)):
        x, y = places[p, 0], places[p, 1]
        i, j = math.floor(x / spacing - 0.5 - first[0]), math.floor(y / spacing - 0.5 - first[1])
        for a in range(max(i - reach, 0), min(i + reach + 2, bare.shape[0])):
            dx = (first[0] + a + 0.5) * spacing - x
            for b in range(max(j - reach, 0), min(j + reach + 2, bare.shape[1])):
                dy = (first[1] + b + 0.5) * spacing - y
                if dx * dx + dy * dy < within * within:
                    bare[a, b] = False
