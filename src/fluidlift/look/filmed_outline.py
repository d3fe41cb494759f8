"""The waterline of a film on the surface of its simulation, finer than the simulator's cells.

A simulated rim lies somewhere in a cell, which is several pixels of the clip. Where the film shows fluid within one
cell of it, the surface ends where the film's does, and holes that are no wider than a few cells are closed: a sheet
thinner than a cell tears between its particles. A sheet in the air, seen as a map over the picture, is followed
further. What is further off stays as it is simulated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.look.surface_axes import PictureAxes, SurfaceAxes
from fluidlift.look.surface_map import COLUMN, SurfaceMap, sampled
from fluidlift.types import PinholeCamera

FINER = 1.0
"""cells by which the surface is extended to the film's outline"""

TORN = 6.0
"""the same of what falls, cells: a sheet or a jet that breaks up into drops is thinner than the simulator's cells,
which keep a few particles of it. As far as what a film of smoke shows may be from what is simulated
(`scene.smoke_appearance`)"""

LEFT = 2.0
"""cells from the filmed fluid within which nothing is shown that the film shows dry: the simulation takes out what is
further off (`scene.filmed_cells`: cells whose middle is more than one cell away)"""

HOLES = 2.0
"""cells, half the width of holes that are closed where the film shows fluid"""

RIM = 0.5
"""px: outline of a mask of whole pixels"""

HOLE = round(HOLES / COLUMN)

EVERYWHERE = 1e6
"""px to the outline of a fluid that fills the whole picture"""

WIDEST = 0.4
"""standard deviation of a splat at most, shares of its distance from the outline: what is seen of it ends there"""


def reach(axes: SurfaceAxes) -> int:
    """Columns of a map over some axes by which the surface is extended at most."""
    return round((TORN if isinstance(axes, PictureAxes) else FINER) / COLUMN)


class FilmedOutline:
    """Where a film shows fluid.

    Args:
        camera: that took it.
        outside: px from each pixel to the nearest one that shows fluid.
        cell: width of the simulator's cells, m.
        rises: what is above the fluid, in the picture, is within its outline: a vessel goes on to fill. Nothing is
            added then.
    """

    def __init__(
        self, camera: PinholeCamera, outside: Float[np.ndarray, "h w"], cell: float, *, rises: bool = False
    ) -> None:
        self._camera, self._cell, self._rises = camera, cell, rises
        wet = outside <= 0
        if rises:
            wet = np.logical_or.accumulate(wet[::-1], axis=0)[::-1]
            outside = ndimage.distance_transform_edt(~wet)
        # to the nearest pixel beside the fluid, as negative px inside; the picture's border is none
        inside = np.full(outside.shape, EVERYWHERE) if wet.all() else ndimage.distance_transform_edt(wet)
        self._away_px = np.where(wet, -inside, outside).astype(np.float32)

    def inside(self, world: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points (m) are seen in the fluid, or beyond `LEFT` cells from it, or not at all."""
        away, pixel, seen = self._away(world)
        return ~seen | (away <= RIM) | (away * pixel > LEFT * self._cell)

    def room(self, world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Standard deviation (m) of splats at points at most; 0 where they are seen beside the fluid, within `LEFT`
        cells of it."""
        away, pixel, seen = self._away(world)
        beyond = away * pixel > LEFT * self._cell
        return np.where(seen & ~beyond, WIDEST * pixel * np.maximum(RIM - away, 0.0), np.inf)

    def cut(self, surface: SurfaceMap, axes: SurfaceAxes) -> SurfaceMap:
        """The map with its wet columns as the film shows them, within some cells of the simulated rim."""
        shape = surface.wet.shape
        middles = np.concatenate([surface.middles(), surface.height[..., None]], axis=-1).reshape(-1, 3)
        away, pixel, seen = (a.reshape(shape) for a in self._away(axes.world_points(middles)))
        near = ndimage.binary_dilation(surface.wet, iterations=reach(axes))
        near |= ndimage.binary_closing(np.pad(surface.wet, HOLE), iterations=HOLE)[HOLE:-HOLE, HOLE:-HOLE]
        beside = seen & (away > RIM) & (away * pixel <= LEFT * self._cell)
        added = near & seen & (away <= RIM) & (not self._rises)
        return replace(surface, wet=(surface.wet & ~beside) | added)

    def _away(self, world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """px from the fluid, m of a pixel there, and whether it is in the picture."""
        uv, depth = self._camera.project(world)
        inside = ((uv >= 0) & (uv <= np.array(self._camera.size))).all(axis=1) & (depth > 0)
        return sampled(self._away_px, uv[:, ::-1] - 0.5), depth / self._camera.focal[0], inside
