"""The V-cycle of `multigrid` in plain NumPy: the readable twin of its kernels.

Arrays are [nx+2, ny+2, nz+2] with a ring of ghost cells. Couplings join a cell with its neighbour on the low side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.numerics.multigrid_assembly import AIR_LIMIT, AIR_SHARE, COARSEST_CELLS
from fluidlift.numerics.multigrid_cycle import COARSEST_SWEEPS

INNER = (slice(1, -1),) * 3


def _towards(array: np.ndarray, axis: int, step: int) -> np.ndarray:
    """The value of the neighbour one cell further along `axis`, at the inner cells."""
    cut = list(INNER)
    cut[axis] = slice(1 + step, array.shape[axis] - 1 + step)
    return array[tuple(cut)]


@dataclass(frozen=True)
class PlainLevel:
    """diagonal x - sum over neighbours of coupling times their x."""

    couplings: tuple[np.ndarray, np.ndarray, np.ndarray]
    air: np.ndarray
    """what the diagonal holds beyond the couplings, at the inner cells"""

    def diagonal(self) -> np.ndarray:
        """At the inner cells."""
        return self.air + np.sum([_towards(c, a, s) for a, c in enumerate(self.couplings) for s in (0, 1)], axis=0)

    def neighbours(self, x: np.ndarray) -> np.ndarray:
        """Sum of coupling times x over the neighbours of the inner cells."""
        parts = [
            _towards(c, a, 0) * _towards(x, a, -1) + _towards(c, a, 1) * _towards(x, a, 1)
            for a, c in enumerate(self.couplings)
        ]
        return np.sum(parts, axis=0)


def finest_level(
    unknown: Bool[np.ndarray, "nx ny nz"], weights: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> PlainLevel:
    """Couplings between unknown cells; weights towards other cells are air."""
    couplings, air = [], np.zeros(unknown.shape)
    for axis, w in enumerate(weights):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        cell = np.moveaxis(np.pad(unknown, pad), axis, 0)
        face = np.moveaxis(np.asarray(w, np.float64), axis, 0)
        joined = np.moveaxis(np.where(cell[1:] & cell[:-1], face, 0.0), 0, axis)
        rim = [(1, 1)] * 3
        rim[axis] = (1, 0)
        couplings.append(np.pad(joined, rim))
        towards_known = np.moveaxis(face - np.moveaxis(joined, axis, 0), 0, axis)
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        air += towards_known[tuple(low)] + towards_known[tuple(high)]
    return PlainLevel((couplings[0], couplings[1], couplings[2]), np.where(unknown, air, 0.0))


def _sum_of_eight(cells: np.ndarray) -> np.ndarray:
    """Sums over blocks of 2^3 cells; a block at the end may have fewer."""
    even = np.pad(cells, [(0, n % 2) for n in cells.shape])
    nx, ny, nz = (n // 2 for n in even.shape)
    return even.reshape(nx, 2, ny, 2, nz, 2).sum(axis=(1, 3, 5))


def coarser_level(fine: PlainLevel) -> PlainLevel:
    """See `multigrid_assembly` for the factors."""
    couplings = []
    for axis, c in enumerate(fine.couplings):
        first = np.zeros_like(fine.air)  # the couplings across the low sides of coarse cells
        every_second = [slice(None)] * 3
        every_second[axis] = slice(0, None, 2)
        first[tuple(every_second)] = c[INNER][tuple(every_second)]
        couplings.append(np.pad(0.5 * _sum_of_eight(first), 1))
    largest = np.max(
        [part for a, c in enumerate(fine.couplings) for part in (_towards(c, a, 0), _towards(c, a, 1))], axis=0
    )
    air = np.where(largest > 0, np.minimum(fine.air, AIR_LIMIT * largest), fine.air)
    return PlainLevel((couplings[0], couplings[1], couplings[2]), AIR_SHARE * _sum_of_eight(air))


def plain_levels(
    unknown: Bool[np.ndarray, "nx ny nz"], weights: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> list[PlainLevel]:
    """The operator in units of 1 / h^2, finest first. The grid of unknown cells begins at cell 0."""
    levels = [finest_level(unknown, weights)]
    while max(levels[-1].air.shape) > COARSEST_CELLS:
        levels.append(coarser_level(levels[-1]))
    return levels


def _half_sweep(level: PlainLevel, x: np.ndarray, rhs: np.ndarray, color: int) -> None:
    diagonal = level.diagonal()
    i, j, k = np.indices(diagonal.shape)
    # ghost cells count in the colour of the kernels, and rows of odd length: cell (1, 1, 1) is black
    chosen = (diagonal > 0) & ((i + j + k + 1) % 2 == color)
    x[INNER][chosen] = (rhs + level.neighbours(x))[chosen] / diagonal[chosen]


def plain_v_cycle(
    levels: list[PlainLevel], rhs: Float[np.ndarray, "nx ny nz"], depth: int = 0
) -> Float[np.ndarray, "nx ny nz"]:
    """An approximate solution of A x = rhs on level `depth`."""
    level = levels[depth]
    x = np.zeros(tuple(n + 2 for n in rhs.shape))
    coarsest = depth == len(levels) - 1
    sweeps = COARSEST_SWEEPS if coarsest else 2
    for color in (0, 1) * sweeps:
        _half_sweep(level, x, rhs, color)
    if not coarsest:
        residual = np.where(level.diagonal() > 0, rhs - level.diagonal() * x[INNER] + level.neighbours(x), 0.0)
        coarse = plain_v_cycle(levels, _sum_of_eight(residual), depth + 1)
        fine = coarse.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
        x[INNER] += np.where(level.diagonal() > 0, fine[tuple(slice(n) for n in rhs.shape)], 0.0)
    for color in (1, 0) * sweeps:
        _half_sweep(level, x, rhs, color)
    return x[INNER]
