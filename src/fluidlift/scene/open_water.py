"""Where on a fluid there is room for something new: not in the ground, the inlet, or what was put there before."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.types import CellType, FluidAsset


def open_water(
    asset: FluidAsset, width: float, taken: Sequence[tuple[Float[np.ndarray, "2"], float]] = ()
) -> Float[np.ndarray, "3"]:
    """A place on which a body can be put without touching ground or another one, the nearest to the fluid's middle.

    Args:
        asset: as lifted.
        width: m, of the body in plan.
        taken: middle [2] and width (m) in plan of the bodies that are there already.

    Returns:
        [3] m, on the surface at the first instant; where there is no such place, that with the most room.
    """
    terrain, means = asset.terrain, np.asarray(asset.rest.means, np.float64)
    grid = terrain.grid
    means = means[grid.contains(means)]
    if not len(means):
        return np.array([*0.5 * (grid.low + grid.high)[:2], grid.high[2]])
    column = grid.cell_of(means)[:, :2]
    top = np.full(grid.shape[:2], -np.inf)
    np.maximum.at(top, tuple(column.T), means[:, 2])
    wet = np.argwhere(np.isfinite(top))
    at = np.column_stack([_middles(asset, wet), top[tuple(wet.T)]])
    room = sample_nodes(terrain.signed_distance, grid, at + [0.0, 0.0, 0.5 * width])
    room = np.minimum(room, np.minimum(at[:, :2] - grid.low[:2], grid.high[:2] - at[:, :2]).min(axis=1))
    inlet = np.argwhere((asset.cell_types == CellType.INFLOW).any(axis=2))
    if len(inlet):  # a body there would dam it, or hang above the mouth of a jet
        away = np.linalg.norm(at[:, None, :2] - _middles(asset, inlet), axis=2).min(axis=1)
        room = np.minimum(room, away - grid.spacing)
    for middle, size in taken:
        room = np.minimum(room, np.linalg.norm(at[:, :2] - middle, axis=1) - 0.5 * size)
    low, high = np.percentile(means[:, :2], [2, 98], axis=0)
    far = np.linalg.norm(at[:, :2] - 0.5 * (low + high), axis=1)
    roomy = room >= 0.5 * width + grid.spacing
    return at[np.argmin(np.where(roomy, far, np.inf))] if roomy.any() else at[np.argmax(room)]


def _middles(asset: FluidAsset, columns: np.ndarray) -> np.ndarray:
    """[n,2] m of columns [n,2] of cells."""
    grid = asset.grid
    return grid.low[:2] + (columns + 0.5) * grid.spacing
