"""The air around smoke: it must give way and follow, or a plume that starts to move in still air is braked at once."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from fluidlift.motion.volume_projection import weighted_projection
from fluidlift.physics.pressure import build_system
from fluidlift.types import CellType, FaceVelocity, Grid, SolveReport, Terrain

SMOKE_MOBILITY = 0.02
"""how freely faces of the smoke, whose motion was seen, change, against 1 for those of the air, which was not"""


def with_air(
    velocity: FaceVelocity, cell_types: UInt8[np.ndarray, "nx ny nz"], terrain: Terrain | None, grid: Grid
) -> tuple[FaceVelocity, SolveReport]:
    """The divergence-free field of the whole box nearest to the smoke's velocity; air moves as little as it can.

    Args:
        velocity: m/s, zero outside the smoke.
        cell_types: FLUID and INFLOW cells hold smoke.
        terrain: solid ground; None: walls by cell type.
        grid: of both.
    """
    smoke = (cell_types == CellType.FLUID) | (cell_types == CellType.INFLOW)
    types = np.where(cell_types == CellType.EMPTY, CellType.FLUID, cell_types).astype(np.uint8)
    system = build_system(types, terrain, grid, open_border=True)
    mobility, start = [], []
    for axis, component in enumerate(velocity.components):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        wide = np.pad(smoke, pad)
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        touches = wide[tuple(low)] | wide[tuple(high)]
        mobility.append(np.where(touches, SMOKE_MOBILITY, 1.0).astype(np.float32))
        start.append(np.where(touches, component, 0.0).astype(np.float32))
    return weighted_projection(FaceVelocity(*start), system, tuple(mobility))
