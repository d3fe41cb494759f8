"""Halving the resolution of a fit: a rollout costs 16 times less on cells twice as wide with steps twice as long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.types import CellType, FaceVelocity, Grid, Terrain


def coarse_grid(grid: Grid) -> Grid:
    """Cells twice as wide; odd counts round up."""
    nx, ny, nz = ((n + 1) // 2 for n in grid.shape)
    return Grid((nx, ny, nz), 2 * grid.spacing, grid.origin)


def _even(cells: np.ndarray) -> np.ndarray:
    """The last layer repeated where a count is odd."""
    return np.pad(cells, [(0, n % 2) for n in cells.shape], mode="edge")


def coarsen_cells(cell_types: np.ndarray) -> np.ndarray:
    """u8: one type for each 2 x 2 x 2 block.

    Blocks that are at least half solid are SOLID. Of the rest, in- and outflow win where they fill a quarter of the
    block (boundaries are thin), fluid where it fills half of what is not solid, else EMPTY.
    """
    even = _even(np.asarray(cell_types))
    nx, ny, nz = (n // 2 for n in even.shape)
    blocks = even.reshape(nx, 2, ny, 2, nz, 2).transpose(0, 2, 4, 1, 3, 5).reshape(nx, ny, nz, 8)
    count = {t: (blocks == t).sum(-1) for t in CellType}
    wet = count[CellType.FLUID] + count[CellType.INFLOW] + count[CellType.OUTFLOW]
    out = np.where(2 * wet >= 8 - count[CellType.SOLID], CellType.FLUID, CellType.EMPTY)
    out = np.where(count[CellType.OUTFLOW] >= 2, CellType.OUTFLOW, out)
    out = np.where(count[CellType.INFLOW] >= 2, CellType.INFLOW, out)
    return np.where(count[CellType.SOLID] >= 4, CellType.SOLID, out).astype(np.uint8)


def coarsen_velocity(velocity: FaceVelocity) -> FaceVelocity:
    """Each coarse face takes the mean of the four fine faces in it: the flux, and with it zero divergence, is kept."""
    out = []
    for axis, q in enumerate(velocity.components):
        pads = [(0, n % 2) for n in q.shape]
        pads[axis] = (0, (q.shape[axis] - 1) % 2)
        q = np.pad(q, pads, mode="edge")
        kept = np.take(q, range(0, q.shape[axis], 2), axis)
        for other in range(3):
            if other != axis:
                n = kept.shape[other]
                kept = 0.5 * (np.take(kept, range(0, n, 2), other) + np.take(kept, range(1, n, 2), other))
        out.append(np.ascontiguousarray(kept, q.dtype))
    return FaceVelocity(*out)


def coarsen_seen(
    velocity: FaceVelocity, observed: Bool[np.ndarray, "nx ny nz"]
) -> tuple[FaceVelocity, Bool[np.ndarray, "mx my mz"]]:
    """Coarse velocity from seen faces alone, and the coarse cells that count as seen.

    A face is seen where a cell beside it is. A coarse face takes the mean of the seen ones among its four (0 where
    there are none); a coarse cell is seen where at least half of its cells are, and each of its faces has a seen one.
    """
    if observed.all():
        return coarsen_velocity(velocity), np.ones([(n + 1) // 2 for n in observed.shape], bool)
    marks = []
    for axis, n in enumerate(observed.shape):
        wide = np.pad(observed, [(int(a == axis),) * 2 for a in range(3)])
        marks.append((np.take(wide, range(n + 1), axis) | np.take(wide, range(1, n + 2), axis)).astype(float))
    shares = coarsen_velocity(FaceVelocity(*marks)).components
    shown = [np.where(m > 0, q, 0.0) for q, m in zip(velocity.components, marks)]
    sums = coarsen_velocity(FaceVelocity(*shown)).components
    means = [np.where(m > 0, q / np.maximum(m, 0.25), 0.0) for q, m in zip(sums, shares)]
    even = _even(observed)
    nx, ny, nz = (n // 2 for n in even.shape)
    seen = even.reshape(nx, 2, ny, 2, nz, 2).sum(axis=(1, 3, 5)) >= 4
    for axis, n in enumerate(seen.shape):
        known = shares[axis] > 0
        seen &= np.take(known, range(n), axis) & np.take(known, range(1, n + 1), axis)
    return FaceVelocity(*(q.astype(c.dtype) for q, c in zip(means, velocity.components))), seen


def coarsen_terrain(terrain: Terrain) -> Terrain:
    """Every second node."""
    phi: Float[np.ndarray, "a b c"] = terrain.signed_distance
    wide = np.pad(phi, [(0, (n - 1) % 2) for n in phi.shape], mode="edge")
    nodes = np.ascontiguousarray(wide[::2, ::2, ::2])
    return replace(terrain, grid=coarse_grid(terrain.grid), signed_distance=nodes)
