"""Null space of the pressure: connected components without a Dirichlet cell, where p has a free constant.

Cells are gathered into runs: unknown cells above each other, joined by open faces. A run beside air is not closed, and
nearly all are; only the others are joined with their neighbours (union-find), so that the search costs little more
than one look at each cell. `poisson.label_components` is the plain twin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from fluidlift.numerics.sharing import shared


@dataclass(frozen=True)
class ClosedComponents:
    """Closed components of more than one cell."""

    runs: Int[np.ndarray, "r 4"]
    """i, j, first k, last k + 1 of each run of cells"""
    labels: Int[np.ndarray, " r"]
    """component of each run, 0 to c-1"""
    sizes: Int[np.ndarray, " c"]
    """cells of each component"""


@dataclass(frozen=True)
class FreeConstants:
    """What rigid bodies leave of the free constants of closed components.

    The operator's null space lies in the constants of the closed components. A body that feels the pressure of such a
    constant gives way to it: then the constant, or one combination of several, is determined.
    """

    sizes: Int[np.ndarray, " c"]
    """cells of each component"""
    touched: Int[np.ndarray, " t"]
    """components whose constant some body feels"""
    projector: Float[np.ndarray, "t t"]
    """onto what stays free among them, in units of sqrt(cells)"""

    def means(self, sums: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """What each component loses per cell, given the sum over its cells, so that nothing free is left."""
        roots = np.sqrt(np.maximum(self.sizes, 1))
        scaled = sums / roots
        if len(self.touched):
            scaled[self.touched] = (self.projector * scaled[self.touched]).sum(axis=1)
        return scaled / roots


def free_constants(
    sizes: Int[np.ndarray, " c"],
    forces: Float[np.ndarray, "b c 6"],
    magnitudes: Float[np.ndarray, "b c 6"],
    inverse_mass: Float[np.ndarray, "b 6 6"],
) -> FreeConstants:
    """The constants that stay free, from the force of pressure 1 in each component on each body.

    Args:
        sizes: cells of each component.
        forces: sum of J over the cells of each component.
        magnitudes: sum of |J|, the measure of what counts as no force: the surface of a body that is wholly inside a
            component is closed, so that a constant pressure exerts none but for rounding.
        inverse_mass: of each body.
    """
    felt = np.einsum("bcm,bml,bdl->cd", forces, inverse_mass, forces)
    scale = np.einsum("bcm,bml,bcl->c", magnitudes, np.abs(inverse_mass), magnitudes)
    touched = np.flatnonzero(felt.diagonal() > 1e-10 * scale)  # 1e-5 of the force
    if len(touched) == 0:
        return FreeConstants(sizes, touched, np.zeros((0, 0)))
    roots = np.sqrt(sizes[touched])
    values, vectors = np.linalg.eigh(felt[np.ix_(touched, touched)] / roots[:, None] / roots)
    free = vectors[:, values < 1e-10 * values[-1]]
    return FreeConstants(sizes, touched, np.einsum("im,jm->ij", free, free))


@shared(lambda unknown, wz, low, high, *_: (low[0], high[0]))
def _count_runs(begin, end, unknown, wz, low, high, out):
    """int64 [nx,ny]: runs of unknown cells along z, cut at closed faces; only looked for from low to high - 1."""
    for i in range(begin, end):
        for j in range(low[1], high[1]):
            count = 0
            for k in range(low[2], high[2]):
                if unknown[i, j, k] and not (k > 0 and unknown[i, j, k - 1] and wz[i, j, k] > 0):
                    count += 1
            out[i, j] = count


@shared(lambda unknown, *_: (0, unknown.shape[0]))
def _fill_runs(begin, end, unknown, wz, beside_known, offset, runs, grounded):
    """First and last cell of each run, and whether it borders on a known cell."""
    _, ny, nz = unknown.shape
    for i in range(begin, end):
        for j in range(ny):
            r = offset[i * ny + j]
            k = 0
            while r < offset[i * ny + j + 1]:
                while not unknown[i, j, k]:
                    k += 1
                first = k
                k += 1
                while k < nz and unknown[i, j, k] and wz[i, j, k] > 0:
                    k += 1
                runs[r, 0], runs[r, 1], runs[r, 2], runs[r, 3] = i, j, first, k
                for cell in range(k - 1, first - 1, -1):  # from above, where the air is
                    if beside_known[i, j, cell]:
                        grounded[r] = True
                        break
                r += 1


@njit(cache=True)
def _root(parent, r):
    while parent[r] != r:
        parent[r] = parent[parent[r]]
        r = parent[r]
    return r


@njit(cache=True)
def _join_neighbours(wx, wy, offset, runs, grounded, parent, r):
    """Join a run with the runs beside it, until it is known not to be closed. The lower index becomes the root."""
    ny, nx = wx.shape[1], wy.shape[0]
    i, j, low, high = runs[r]
    for side in range(4):
        ni, nj = i + (side == 1) - (side == 0), j + (side == 3) - (side == 2)
        if not (0 <= ni < nx and 0 <= nj < ny):
            continue
        for other in range(offset[ni * ny + nj], offset[ni * ny + nj + 1]):
            a, b = _root(parent, r), _root(parent, other)
            if grounded[a]:
                return
            if a == b or runs[other, 2] >= high:
                continue
            for k in range(max(low, runs[other, 2]), min(high, runs[other, 3])):
                w = wx[max(i, ni), j, k] if side < 2 else wy[i, max(j, nj), k]
                if w > 0:
                    parent[max(a, b)] = min(a, b)
                    grounded[min(a, b)] = grounded[a] or grounded[b]
                    break


@njit(cache=True)
def _closed_labels(wx, wy, offset, runs, grounded):
    """int64 [runs]: number of the closed component of each run, -1 where there is none. Changes `grounded`."""
    parent = np.arange(len(runs))
    for r in range(len(runs)):
        if not grounded[r]:
            _join_neighbours(wx, wy, offset, runs, grounded, parent, r)
    size = np.zeros(len(runs), np.int64)
    for r in range(len(runs)):
        size[_root(parent, r)] += runs[r, 3] - runs[r, 2]
    label = np.full(len(runs), -1, np.int64)
    count = 0
    for r in range(len(runs)):
        root = _root(parent, r)
        # one cell without any open face is no equation at all
        if not grounded[root] and size[root] > 1:
            if label[root] < 0:
                label[root] = count
                count += 1
            label[r] = label[root]
    return label


def closed_components(
    unknown: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray, np.ndarray],
    beside_known: np.ndarray,
    box: tuple[np.ndarray, np.ndarray] | None = None,
) -> ClosedComponents:
    """The closed components, numbered in the order of their first cells.

    Args:
        unknown: bool [nx,ny,nz].
        weights: face fractions across x, y, z.
        beside_known: bool [nx,ny,nz], unknown cells with an open face to a known cell or out of the grid.
        box: first index and last + 1 of the unknown cells along each axis, which saves time.
    """
    wx, wy, wz = weights
    if unknown.size == 0:
        return ClosedComponents(np.zeros((0, 4), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
    low, high = box if box is not None else (np.zeros(3, np.int64), np.array(unknown.shape))
    counts = np.zeros(unknown.shape[:2], np.int64)
    _count_runs(unknown, wz, low, high, counts)
    offset = np.concatenate([[0], np.cumsum(counts)])
    runs, grounded = np.empty((offset[-1], 4), np.int64), np.zeros(offset[-1], bool)
    _fill_runs(unknown, wz, beside_known, offset, runs, grounded)
    if grounded.all():
        runs, labels = runs[:0], np.zeros(0, np.int64)
    else:
        labels = _closed_labels(wx, wy, offset, runs, grounded)
        runs, labels = runs[labels >= 0], labels[labels >= 0]
    sizes = np.bincount(labels, weights=runs[:, 3] - runs[:, 2]).astype(np.int64)
    return ClosedComponents(runs, labels, sizes)


@njit(cache=True)
def _paint(runs, labels, out):
    for r in range(len(runs)):
        out[runs[r, 0], runs[r, 1], runs[r, 2] : runs[r, 3]] = labels[r]


def component_of_cells(
    components: ClosedComponents, cells: Int[np.ndarray, "n 3"], shape: tuple[int, int, int]
) -> Int[np.ndarray, " n"]:
    """The closed component of each cell, -1 where there is none."""
    label = np.full(shape, -1, np.int64)
    _paint(components.runs, components.labels, label)
    return label[tuple(cells.T)]
