"""Cells of small channels, and water for them."""

from __future__ import annotations

import numpy as np

from fluidlift.types import CellType, FluidParameters, Grid

WATER = FluidParameters(
    kinematic_viscosity=3e-3, gravity=(0.8, 0.1, -9.0), inflow_velocity=(1.0, 0.1, 0.0), inflow_fluctuation=0.1,
    outflow_velocity=0.9, restitution=0.3, wall_damping=0.2, time_step=0.02,
)  # fmt: skip
"""every parameter at work"""


def channel(nx: int = 20, ny: int = 8, nz: int = 8, depth: int = 5) -> tuple[np.ndarray, Grid]:
    """A straight channel along x: solid below, air above, in- and outflow at its ends, walls at its sides."""
    grid = Grid((nx, ny, nz), 0.1)
    types = np.full(grid.shape, CellType.EMPTY, np.uint8)
    types[:, :, 0] = CellType.SOLID
    types[:, :, 1 : depth + 1] = CellType.FLUID
    types[0, :, 1 : depth + 1] = CellType.INFLOW
    types[-1, :, 1 : depth + 1] = CellType.OUTFLOW
    return types, grid


def rocky_channel(shape: tuple[int, int, int] = (9, 6, 5), depth: int = 4) -> np.ndarray:
    """Bed, two banks, a rock, inflow on the left, outflow on the right, air above."""
    types = np.full(shape, CellType.EMPTY, np.uint8)
    types[:, :, :depth] = CellType.FLUID
    types[:, :, 0] = CellType.SOLID
    types[:, 0], types[:, -1] = CellType.SOLID, CellType.SOLID
    types[4, 2:4, :3] = CellType.SOLID
    types[0][types[0] == CellType.FLUID] = CellType.INFLOW
    types[-1][types[-1] == CellType.FLUID] = CellType.OUTFLOW
    return types
