"""The free outlet: p = 0 at its rim, hydrostatic pressure inside columns of liquid that stand on the ground.

With p = 0 throughout, a river would pour over the outlet as over an edge and drain its own bed upstream. A column in
OUTFLOW cells that rests on the bed therefore keeps the pressure of its own depth: its liquid passes through at the
speed it has. Liquid that hangs over air (a fall that leaves the box) has p = 0.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.physics.boundaries import Walls
from fluidlift.types import CellType, FaceVelocity


def column_heads(wet: Bool[np.ndarray, "nx ny nz"], walls: Walls) -> Float[np.ndarray, "nx ny nz"] | None:
    """Depth (m) below the first cell of air above, in wet OUTFLOW cells of columns that stand on the ground; else 0.

    None where there is no such column. The depth counts whole cells, as the pressure of the liquid beside it does.
    """
    outflow = walls.regions == CellType.OUTFLOW
    if not (outflow & wet).any():
        return None
    nz = wet.shape[2]
    columns = outflow.any(axis=2)
    wet_here, floor = wet[columns], walls.openings[2][columns] == 0
    stands = np.zeros_like(wet_here)
    below = np.zeros(len(wet_here), bool)
    for k in range(nz):
        stands[:, k] = below = wet_here[:, k] & (floor[:, k] | below)
    head = np.zeros(wet_here.shape)
    above = np.zeros(len(wet_here))
    for k in range(nz - 1, -1, -1):
        head[:, k] = above = np.where(stands[:, k], above + walls.grid.spacing, 0.0)
    heads = np.zeros(wet.shape)
    heads[columns] = head
    heads[~outflow] = 0.0
    return heads if heads.any() else None


def hold_columns(
    velocity: FaceVelocity, known: Float[np.ndarray, "nx ny nz"], unknown: Bool[np.ndarray, "nx ny nz"], walls: Walls
) -> FaceVelocity:
    """Subtract the gradient of the given q (m^2/s) on open faces between cells of which neither is unknown."""
    out = []
    for axis, component in enumerate(velocity.components):
        q, free = np.moveaxis(known, axis, 0), np.moveaxis(~unknown, axis, 0)
        opening = np.moveaxis(walls.openings[axis], axis, 0)
        new = component.copy()
        inner = np.moveaxis(new, axis, 0)[1:-1]
        inner -= np.where(free[1:] & free[:-1] & (opening[1:-1] > 0), np.diff(q, axis=0) / walls.grid.spacing, 0.0)
        out.append(new)
    return FaceVelocity(*out)
