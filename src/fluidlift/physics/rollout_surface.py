"""The free surface (a level set) of a rollout's liquid, between the cells of its layout, for ghost-fluid pressure.

p = 0 holds on the surface, a share of a cell away from the centre of the liquid's last cell: ghost fluid, second order
(Enright et al. 2003; Gibou et al. 2002), as in `pressure`. With a distance that is linear near the surface the weight
of the liquid is balanced exactly, whatever the tilt of the surface against the grid, so a pool at rest stays at rest.
A surface that is wrong by e(x) instead drives the flow by g grad e, and no later step can tell that from gravity.

The distance is given where it is known (a level set, for instance). Else it is estimated from the cell types:
`liquid_distance`. Cells tell the surface to half a cell; a surface inclined by 1 : n leaves stairs n cells long.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.physics.free_surface import Faces, pressure_cells, surface_gaps
from fluidlift.types import CellType

NEAR_OUTLET = 4
"""cells: as far before the outlet the surface is looked at for its normal"""
NEIGHBOURHOOD = 2.0
"""cells: standard deviation of the weights in the local fit of a plane; stairs up to about ten cells become a slope"""
ROUNDS = 10
"""of fitting planes: more change little (mean residual acceleration within a fifth of 20 rounds')"""
FLATTEST, STEEPEST = 0.25, 2.0
"""a fitted distance is divided by its slope within these bounds; below them the fit sees both sides of a sheet"""
SPREAD = 1e-9
"""cells^2, added to the variance of positions: a layout one cell thick has none"""
INSIDE = 1e-3
"""cells: a liquid cell's centre is at least so far inside, an empty one's outside"""


def sides(cells: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Value of the cell on the low and on the high side of every face across `axis`."""
    pad = [(0, 0)] * 3
    pad[axis] = (1, 1)
    wide = np.pad(cells, pad)
    n = cells.shape[axis]
    return np.take(wide, range(n + 1), axis), np.take(wide, range(1, n + 2), axis)


def surface_cells(
    cell_types: UInt8[np.ndarray, "nx ny nz"],
    distance: Float[np.ndarray, "nx ny nz"],
    openings: Faces,
    spacing: float,
) -> tuple[UInt8[np.ndarray, "nx ny nz"], Float[np.ndarray, "nx ny nz"]]:
    """The layout that goes with a known surface, by `free_surface.pressure_cells`.

    FLUID cells with their centre above the surface become EMPTY (they move with the liquid below), EMPTY cells with
    their centre below it FLUID.

    Args:
        cell_types: `CellType`.
        distance: m, to the surface, negative in the liquid.
        openings: open share of the faces (`boundaries.face_fractions`, or of `pressure.build_system`).
        spacing: cell width, m.

    Returns:
        the types, and the distance to hand to `prepare_domain` with them, m.

    Raises:
        ValueError: a distance of the wrong shape, or one that is not finite.
    """
    types, level = np.asarray(cell_types, np.uint8), np.asarray(distance, np.float32)
    require(level.shape == types.shape, f"distance {level.shape}", str(types.shape))
    require(bool(np.isfinite(level).all()), "a distance that is not finite", "finite metres")
    return pressure_cells(types, level, openings, spacing)


def surface_distances(
    cell_types: np.ndarray, distance: Float[np.ndarray, "nx ny nz"] | None = None
) -> list[Float[np.ndarray, "fx fy fz"]]:
    """Where the surface lies on the way from a FLUID to an EMPTY cell's centre, in cells: 1 on all other faces.

    Args:
        cell_types: u8 [nx,ny,nz], `CellType`.
        distance: of cell centres to the surface in any unit, from `surface_cells`; None: estimated from the types.

    Raises:
        ValueError: a distance of the wrong shape.
    """
    types = np.asarray(cell_types)
    if distance is None:
        distance = liquid_distance(types)
    require(distance.shape == types.shape, f"distance {distance.shape}", str(types.shape))
    return [np.asarray(gap, float) for gap in surface_gaps(distance, types)]


def depth_at_outlet(
    cell_types: np.ndarray, distance: Float[np.ndarray, "nx ny nz"]
) -> tuple[Float[np.ndarray, "nx ny nz"], Float[np.ndarray, "3"]]:
    """Depth of FLUID cells below the surface over them, in cells, and the surface's normal near the outlet.

    The depth is counted along the axis nearest to the normal: that is how the pressure of liquid at rest adds up on the
    grid. It is 0 where there is no surface above, and everywhere where there is no outlet.

    Args:
        cell_types: u8 [nx,ny,nz], `CellType`.
        distance: of cell centres to the surface in cells, negative in the liquid.
    """
    types = np.asarray(cell_types)
    depths, normal = np.zeros(types.shape), np.zeros(3)
    behind, fluid, dry = (types == t for t in (CellType.OUTFLOW, CellType.FLUID, CellType.EMPTY))
    near = np.asarray(ndimage.binary_dilation(behind, iterations=NEAR_OUTLET)) & fluid if behind.any() else behind
    for axis in range(3):
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        below, above = tuple(low), tuple(high)
        # the steps of a staircase add up to the area of the slope, seen along each axis
        normal[axis] = float((near[below] & dry[above]).sum()) - float((near[above] & dry[below]).sum())
    size = float(np.sqrt(np.square(normal).sum()))
    if size == 0:
        return depths, normal
    normal = normal / size
    up = int(np.abs(normal).argmax())
    order = slice(None, None, -1 if normal[up] > 0 else 1)
    # from the air downwards; not a number where the way to the air is not through liquid
    depth, air = np.full(fluid.shape[:up] + fluid.shape[up + 1 :], np.nan), False
    for wet, open_air, level, out in zip(*(np.moveaxis(a, up, 0)[order] for a in (fluid, dry, distance, depths))):
        depth = np.where(air, np.maximum(-level, 0.0), depth + abs(normal[up]))
        depth, air = np.where(wet, depth, np.nan), open_air
        out[...] = np.nan_to_num(depth)
    return depths, normal


def outlet_head(
    cell_types: np.ndarray, depth: Float[np.ndarray, "nx ny nz"], normal: Float[np.ndarray, "3"], axis: int
) -> Float[np.ndarray, "3 fx fy fz"]:
    """Share of gravity by which the liquid behind an outlet pushes each face across `axis` of FLUID beside OUTFLOW.

    An outlet cuts a stream that goes on: behind it p / density = -(g . n) depth, as under a flat surface with the
    normal n. With p = 0 there the section would be sucked out by the weight of the liquid in it.

    Args:
        cell_types: u8 [nx,ny,nz], `CellType`.
        depth: of FLUID cells, cells, from `depth_at_outlet`.
        normal: from there, too.
        axis: of the faces.
    """
    types = np.asarray(cell_types)
    (fluid_low, fluid_high), (out_low, out_high) = (sides(types == t, axis) for t in (CellType.FLUID, CellType.OUTFLOW))
    depth_low, depth_high = sides(depth, axis)
    ahead = np.where(fluid_low & out_high & (depth_low > 0), np.maximum(depth_low - normal[axis], 0.0), 0.0)
    back = np.where(fluid_high & out_low & (depth_high > 0), np.maximum(depth_high + normal[axis], 0.0), 0.0)
    return normal[:, None, None, None] * (ahead - back)


def liquid_distance(cell_types: np.ndarray) -> Float[np.ndarray, "nx ny nz"]:
    """Distance (cells, negative in the liquid) to the smoothest surface that parts liquid cells from empty ones.

    A binary volume shows its surface as stairs. As in Whitaker 2000, "Reducing aliasing artifacts in iso-surfaces of
    binary volumes", the surface relaxes as long as no cell changes sides; here towards local planes instead of least
    area, so that inclined surfaces keep their slope up to walls. Each round replaces the distance by a linear fit to
    its Gaussian neighbourhood (solids and what is outside the box left out), divided by its slope.
    """
    types = np.asarray(cell_types)
    wet = np.isin(types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW))
    dry = types == CellType.EMPTY
    if not (wet.any() and dry.any()):
        return np.full(types.shape, -1.0 if wet.any() else 1.0)
    to_dry = np.asarray(ndimage.distance_transform_edt(~dry))
    to_wet = np.asarray(ndimage.distance_transform_edt(~wet))
    low = np.where(wet, -to_dry, np.where(dry, INSIDE, -np.inf))
    high = np.where(wet, -INSIDE, np.where(dry, to_wet, np.inf))
    distance = np.where(wet, 0.5 - to_dry, to_wet - 0.5)
    plane = _LocalPlane(types != CellType.SOLID)
    for _ in range(ROUNDS):
        distance = np.clip(plane.fit(distance), low, high)
    return distance


class _LocalPlane:
    """Weighted linear regression of a field around every cell; the moments of the weights are found once."""

    def __init__(self, known: np.ndarray) -> None:
        self.known = known.astype(float)
        axes = np.meshgrid(*(np.arange(n, dtype=float) for n in known.shape), indexing="ij", sparse=True)
        # about the middle: second moments are differences, and would cancel far from the origin
        self.at = [np.broadcast_to(a - 0.5 * (n - 1), known.shape) for a, n in zip(axes, known.shape)]
        self.mass = np.maximum(self._blur(self.known), 1e-9)
        self.mean = [self._blur(self.known * a) / self.mass for a in self.at]
        spread = np.empty((*known.shape, 3, 3))
        for i in range(3):
            for j in range(i, 3):
                product = self._blur(self.known * self.at[i] * self.at[j]) / self.mass
                spread[..., i, j] = spread[..., j, i] = product - self.mean[i] * self.mean[j]
            spread[..., i, i] += SPREAD
        self.inverse = np.linalg.inv(spread)
        self.offset = np.stack([a - m for a, m in zip(self.at, self.mean)], axis=-1)

    @staticmethod
    def _blur(field: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(field, NEIGHBOURHOOD, mode="constant", truncate=3.0)

    def fit(self, field: np.ndarray) -> np.ndarray:
        """The plane's value at each cell over its slope: a distance."""
        weighted = self.known * field
        mean = self._blur(weighted) / self.mass
        covariance = [self._blur(weighted * a) / self.mass - m * mean for a, m in zip(self.at, self.mean)]
        slope = np.einsum("...ij,...j->...i", self.inverse, np.stack(covariance, axis=-1))
        value = mean + (self.offset * slope).sum(axis=-1)
        return value / np.clip(np.linalg.norm(slope, axis=-1), FLATTEST, STEEPEST)
