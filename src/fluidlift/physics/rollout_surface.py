"""Where the free surface lies between the cells of a rollout's layout."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.types import CellType

SMOOTHING = 1.0
"""cells: standard deviation of the blur that turns a staircase of cells into a surface"""
NEAREST_SURFACE = 0.25
"""cells: distance of the surface from a fluid cell's centre is not taken smaller (conditioning)"""


def sides(cells: np.ndarray, axis: int, outside: float = 0) -> tuple[np.ndarray, np.ndarray]:
    """Value of the cell on the low and on the high side of every face across `axis`."""
    pad = [(0, 0)] * 3
    pad[axis] = (1, 1)
    wide = np.pad(cells, pad, constant_values=outside)
    n = cells.shape[axis]
    return np.take(wide, range(n + 1), axis), np.take(wide, range(1, n + 2), axis)


def surface_distances(cell_types: np.ndarray) -> list[Float[np.ndarray, "fx fy fz"]]:
    """Where the surface lies on the way from a FLUID to an EMPTY cell's centre, in cells: 1 on all other faces.

    p = 0 at the centres of EMPTY cells would make stairs of a sloping surface, each of which pushes with a full g. The
    share of fluid is blurred instead (solids left out), and p = 0 where it passes one half (ghost fluid method, Enright
    et al. 2003; Gibou et al. 2002).
    """
    fluid = np.isin(cell_types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW)).astype(float)
    open_space = (cell_types != CellType.SOLID).astype(float)
    weight = ndimage.gaussian_filter(open_space, SMOOTHING, mode="nearest")
    share = ndimage.gaussian_filter(fluid * open_space, SMOOTHING, mode="nearest") / np.maximum(weight, 1e-6)
    level = 0.5 - share
    out = []
    for axis in range(3):
        low, high = sides(level, axis)
        wet_low, wet_high = sides(cell_types == CellType.FLUID, axis)
        # outside the box there is neither
        dry_low, dry_high = sides(cell_types == CellType.EMPTY, axis)
        inner, outer = np.where(wet_low, low, high), np.where(wet_low, high, low)
        crossing = (inner < 0) & (outer > 0)
        distance = np.where(crossing, -inner / np.where(crossing, outer - inner, 1.0), 0.5)
        surface = (wet_low & dry_high) | (dry_low & wet_high)
        out.append(np.where(surface, np.clip(distance, NEAREST_SURFACE, 1.0), 1.0))
    return out
