"""Nearest neighbours: in a k-d tree, or, where points lie about evenly, in the cells around a place."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from fluidlift.errors import require
from fluidlift.numerics.cell_list import CellList
from fluidlift.numerics.sharing import shared

WIDER = 3.0
"""times as wide are the cells in which places are looked up that are alone"""
MOST_PAIRS = 30_000_000
"""of places that are alone and points in the 27 cells around them, beyond which a tree is faster"""

FEW = 100
"""points, or places, up to which looking at all points is faster than a tree: the 8 nearest of 60,000 places in the
plane take 18 ms in a tree and 6 here of 8 points, 35 and 22 of 60, 38 and 33 of 150; for few places a tree of many
points is not built"""


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


def nearest_of_few(
    points: Float[np.ndarray, "m d"], places: Float[np.ndarray, "n d"], count: int, *, within: float = np.inf
) -> tuple[Float[np.ndarray, "n count"], Int[np.ndarray, "n count"]]:
    """As `nearest` with an array of 1 to `count`; where points or places are few (`FEW`), by looking at all points.

    Args:
        points: to search in.
        places: to search from, in the same unit.
        count: of neighbours, the nearest first.
        within: distance beyond which none is found: the distance is infinite then, and the index m.

    Raises:
        ValueError: no count.
    """
    require(count >= 1, f"{count} neighbours", "one or more")
    if min(len(points), len(places)) > FEW:
        return nearest(points, places, np.arange(1, count + 1), within=within)
    distance, index = np.empty((len(places), count)), np.empty((len(places), count), np.int64)
    _few_kernel(
        np.ascontiguousarray(places, np.float64), np.ascontiguousarray(points, np.float64), float(within), distance,
        index,
    )  # fmt: skip
    return distance, index


@shared(lambda places, *_: (0, len(places)), least=500)
def _few_kernel(begin, end, places, points, within, distance, index):
    """Insertion into a list that is sorted by the squared distance."""
    count = distance.shape[1]
    best, which = np.empty(count), np.empty(count, np.int64)
    for p in range(begin, end):
        best[:], which[:] = within * within, len(points)
        for n in range(len(points)):
            square = 0.0
            for axis in range(points.shape[1]):
                square += (points[n, axis] - places[p, axis]) ** 2
            if square < best[count - 1]:
                _insert(best, which, square, n)
        for slot in range(count):
            found = which[slot] < len(points)
            distance[p, slot] = math.sqrt(best[slot]) if found else np.inf
            index[p, slot] = which[slot]


def nearest_of_crowd(
    points: Float[np.ndarray, "m 3"], places: Float[np.ndarray, "n 3"], count: int, width: float
) -> tuple[Float[np.ndarray, "n count"], Int[np.ndarray, "n count"]]:
    """As `nearest` with a count, of points that lie about evenly, as particles of a liquid do: in half the time.

    Args:
        points: to search in, finite, at least `count` of them.
        places: to search from, finite, in the same unit.
        count: of neighbours, the nearest first.
        width: distance within which most places have that many neighbours. The others are looked up in wider cells.

    Raises:
        ValueError: too few points, or a width that is not positive.
    """
    require(0 < count <= len(points), f"{count} neighbours among {len(points)} points", "at most as many as there are")
    if not len(places):
        return np.empty((0, count)), np.empty((0, count), np.int64)
    distance, index = _in_cells(CellList.of(points, width), points, np.ascontiguousarray(places), count)
    # what is within a width of a place lies in the 27 cells around it; what is farther may not
    left = np.flatnonzero(distance[:, -1] > width)
    while len(left):
        width *= WIDER
        cells = CellList.of(points, width)
        held = len(points) / max(np.count_nonzero(np.diff(cells.starts)), 1)
        if 27.0 * held * len(left) > MOST_PAIRS:
            found = nearest(points, places[left], count, workers=-1)
            distance[left], index[left] = (np.reshape(a, (len(left), count)) for a in found)
            break
        found = _in_cells(cells, points, places.take(left, axis=0), count)
        distance[left], index[left] = found
        left = left[found[0][:, -1] > width]
    return distance, index


def _in_cells(cells: CellList, points: np.ndarray, places: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The nearest of the points in the 27 cells around each place; at infinity where there are too few."""
    distance, index = np.empty((len(places), count)), np.zeros((len(places), count), np.int64)
    # neighbouring places one after the other: what they look at is in the cache already
    turn = CellList.of(places, cells.width).order
    _nearest_kernel(
        places, turn, points.take(cells.order, axis=0), cells.order, cells.starts, cells.low, cells.width,
        cells.shape, distance, index,
    )  # fmt: skip
    return distance, index


@nb.njit(cache=True, nogil=True)
def _insert(best, which, d, n):
    slot = len(best) - 1
    while slot > 0 and best[slot - 1] > d:
        best[slot], which[slot] = best[slot - 1], which[slot - 1]
        slot -= 1
    best[slot], which[slot] = d, n


@shared(lambda places, *_: (0, len(places)), error_model="numpy")
def _nearest_kernel(begin, end, places, turn, points, order, starts, low, width, shape, distance, index):
    """Insertion into a list that is sorted by the squared distance, cell by cell from the middle one on."""
    count = distance.shape[1]
    best, which = np.empty(count, np.float32), np.empty(count, np.int64)
    cell, inside, gap = np.empty((3, 3), np.int64), np.empty(3), np.empty((3, 3), np.float32)
    for t in range(begin, end):
        p = turn[t]
        x, y, z = places[p, 0], places[p, 1], places[p, 2]
        for axis in range(3):
            along = (places[p, axis] - low[axis]) / width
            at = math.floor(along)
            inside[axis] = along - at
            for step in range(3):  # the middle, below, above
                cell[axis, step] = (np.int64(at) + (0, -1, 1)[step]) % shape[axis]
            gap[axis, 0] = 0.0
            gap[axis, 1] = np.float32((inside[axis] * width) ** 2)
            gap[axis, 2] = np.float32(((1.0 - inside[axis]) * width) ** 2)
        best[:], worst = np.inf, np.float32(np.inf)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    if gap[0, i] + gap[1, j] + gap[2, k] > worst:
                        continue
                    number = (cell[0, i] * shape[1] + cell[1, j]) * shape[2] + cell[2, k]
                    for n in range(starts[number], starts[number + 1]):
                        dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
                        d = dx * dx + dy * dy + dz * dz
                        if d < worst:
                            _insert(best, which, d, n)
                            worst = best[count - 1]
        for slot in range(count):
            distance[p, slot] = math.sqrt(best[slot])
            if best[slot] < np.inf:
                index[p, slot] = order[which[slot]]
