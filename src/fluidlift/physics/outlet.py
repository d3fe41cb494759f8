"""The free outlet (Dirichlet pressure): p = 0 at its rim, hydrostatic in columns of liquid that stand on the ground.

With p = 0 throughout, a river would pour over the outlet as over an edge and drain its own bed upstream. Columns of
OUTFLOW cells whose liquid rests on the bed therefore hold the pressure of a water level: that of the start (the stage
that the video shows; it lets surplus out and holds back where there is less), or where the column was dry at the start
its present one. Liquid that hangs over air (a fall that leaves the box) has p = 0.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, Num, UInt8
from numba import njit
from scipy import ndimage

from fluidlift.physics.boundaries import Walls
from fluidlift.physics.reseed import sort_by_mass
from fluidlift.physics.transfer import CellOrder
from fluidlift.types import CellType, FaceVelocity

OUTLET_CELLS = 3.0
"""cells of OUTFLOW that liquid passes before it is taken away: one for its level, one each side of it for gradients"""

OVERFULL = 3.0
"""of what an OUTFLOW cell holds, from which the surplus has left. The pressure is given there, so nothing keeps the
flow from converging, and particles that run together would gather for ever; one cell may take in what its neighbours in
the outlet lack"""


def thin_outlet(cell_types: UInt8[np.ndarray, "nx ny nz"]) -> UInt8[np.ndarray, "nx ny nz"]:
    """The cells with an outlet that is `OUTLET_CELLS` thick; what lies behind is EMPTY.

    An outlet that reaches on to the side of its box would carry liquid past the end that was seen.
    """
    outflow = cell_types == CellType.OUTFLOW
    before = ~outflow & (cell_types != CellType.SOLID)
    if not outflow.any() or not before.any():
        return cell_types
    behind = outflow & (ndimage.distance_transform_edt(~before) > OUTLET_CELLS)
    return np.where(behind, CellType.EMPTY, cell_types).astype(np.uint8)


def water_levels(wet: Bool[np.ndarray, "nx ny nz"], walls: Walls) -> Int[np.ndarray, "nx ny"]:
    """Index of the first cell of air above the liquid that stands on the ground, in columns with OUTFLOW cells; else
    -1. See `surface_heights` for the rest of the way to the surface."""
    columns = (walls.regions == CellType.OUTFLOW).any(axis=2)
    wet_here, floor = wet[columns], walls.openings[2][columns] == 0
    buried = walls.buried[columns]
    level = np.full(len(wet_here), -1, np.int64)
    below = np.zeros(len(wet_here), bool)
    for k in range(wet.shape[2]):
        stands = wet_here[:, k] & (floor[:, k] | below)
        level[stands] = k + 1
        below = stands | buried[:, k]  # slivers above the bed count as ground
    out = np.full(wet.shape[:2], -1, np.int64)
    out[columns] = level
    return out


def surface_heights(
    levels: Int[np.ndarray, "nx ny"], distance: Float[np.ndarray, "nx ny nz"], spacing: float
) -> Float[np.ndarray, "nx ny"]:
    """Height of the surface above the bottom of the box, in cells, where it lies in its cell; -1 without a level.

    Args:
        levels: of `water_levels`.
        distance: of `free_surface.LiquidSurface`, m.
        spacing: cell width, m.
    """
    top = np.maximum(levels - 1, 0)
    above = np.take_along_axis(distance, top[:, :, None], axis=2)[:, :, 0] / spacing
    return np.where(levels < 0, -1.0, top + 0.5 - np.clip(above, -0.5, 0.5))


def outlet_heads(
    levels: Num[np.ndarray, "nx ny"], start: Num[np.ndarray, "nx ny"], walls: Walls
) -> Float[np.ndarray, "nx ny nz"] | None:
    """Depth (m) of OUTFLOW cells below the water level, in columns that hold standing liquid now; else 0.

    Args:
        levels: of `surface_heights` now.
        start: the same at the start.
        walls: the boundaries.

    Returns:
        heads, or None where there is no such column.
    """
    if (levels < 0).all():
        return None
    stage = np.where(levels < 0, -1.0, np.where(start >= 0, start, levels))
    centers = np.arange(walls.grid.shape[2]) + 0.5
    depth = np.maximum(stage[:, :, None] - centers, 0.0) * walls.grid.spacing
    return np.where(walls.regions == CellType.OUTFLOW, depth, 0.0)


def hold_columns(
    velocity: FaceVelocity, known: Float[np.ndarray, "nx ny nz"], walls: Walls, *, weight: float
) -> FaceVelocity:
    """Subtract the gradient of the given q (m^2/s) on open faces between OUTFLOW cells.

    `weight` is q below one cell of liquid: at the top of a column q falls to 0 at the surface, inside the cell.
    """
    out = []
    outflow = walls.regions == CellType.OUTFLOW
    for axis, component in enumerate(velocity.components):
        q, here = np.moveaxis(known, axis, 0), np.moveaxis(outflow, axis, 0)
        opening = np.moveaxis(walls.openings[axis], axis, 0)
        new = component.copy()
        inner = np.moveaxis(new, axis, 0)[1:-1]
        change = np.diff(q, axis=0)
        if axis == 2 and weight > 0:
            change = np.where((q[:-1] > 0) & (q[1:] == 0), -weight, change)
        inner -= np.where(here[1:] & here[:-1] & (opening[1:-1] > 0), change / walls.grid.spacing, 0.0)
        out.append(new)
    return FaceVelocity(*out)


def surplus(
    masses: Float[np.ndarray, " n"], order: CellOrder, outflow: Bool[np.ndarray, "nx ny nz"], full: float
) -> Bool[np.ndarray, " n"]:
    """Particles that OUTFLOW cells hold beyond `OVERFULL`, the heaviest first: clumps merge.

    Args:
        masses: kg.
        order: from `transfer.sort_by_cell`, on the grid of `outflow`.
        outflow: the cells of the outlet.
        full: kg that a cell holds.
    """
    gone = np.zeros(len(masses), bool)
    _mark_surplus(masses, order.order, order.start, np.flatnonzero(outflow), OVERFULL * full, gone)
    return gone


@njit(cache=True)
def _mark_surplus(masses, order, start, cells, most, gone):
    for c in cells:
        here = order[start[c] : start[c + 1]]
        held = 0.0
        for p in here:
            held += masses[p]
        if held <= most:
            continue
        lightest_first = here[::-1].copy()
        sort_by_mass(lightest_first, masses)
        for p in lightest_first[::-1]:  # the heaviest first; equal ones in their order
            if held <= most:
                break
            gone[p] = True
            held -= masses[p]
