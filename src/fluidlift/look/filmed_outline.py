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

from fluidlift.look.footage import AGREE, FluidFootage
from fluidlift.look.surface_axes import PictureAxes, SurfaceAxes
from fluidlift.look.surface_map import COLUMN, SurfaceMap, sampled
from fluidlift.numerics.short_axis import every
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

RIM = 0.75
"""px inside the outline at which the middles of the skin's splats end, so that what they cover ends at it: a half plane
of them (`surface_skin.WIDTH`, `OPACITY`, with the blur of the rasteriser) hides a half 0.70 to 0.81 px beyond the last
of them, for splats that are 0.85 to 1.7 px apart. Unless it is so thin that less than half of it would be left"""

HOLE = round(HOLES / COLUMN)

THIN = 2
"""px around a place in which its thickest place is looked for: what is three pixels wide is thick enough for `RIM`"""

FASTEST = 75.0
"""percentile of the columns of a fluid by which it is said to rise: its level does in most of them, that of drops on
its walls, or of a jet that comes over them, in few (a choice)"""

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
        rises: px above the fluid, in the picture, that are within its outline: a vessel goes on to fill. Nothing is
            added there.
    """

    def __init__(
        self, camera: PinholeCamera, outside: Float[np.ndarray, "h w"], cell: float, *, rises: int = 0
    ) -> None:
        self._camera, self._cell = camera, cell
        wet = outside <= 0
        self._above = None
        """0 in the film's fluid, 1 elsewhere, where the outline takes in more than that"""
        if rises:
            self._above = (~wet).astype(np.float32)
            below = np.pad(wet, ((0, rises), (0, 0)))
            wet = ndimage.maximum_filter1d(below.astype(np.uint8), rises + 1, axis=0, origin=-((rises + 1) // 2)) > 0
            wet = wet[: len(wet) - rises]
            outside = ndimage.distance_transform_edt(~wet)
        # to the outline, which runs half a pixel from the middles of those beside it; the picture's border is none
        inside = np.full(outside.shape, EVERYWHERE) if wet.all() else ndimage.distance_transform_edt(wet)
        self._away_px = np.where(wet, 0.5 - inside, outside - 0.5).astype(np.float32)
        thick = ndimage.maximum_filter(-self._away_px, 2 * THIN + 1)
        self._inset = np.clip(0.5 * thick, 0.0, RIM).astype(np.float32)

    def inside(self, world: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which middles (m) of a skin's splats are seen so far in the fluid that these end at its outline, or beyond
        `LEFT` cells from it, or not at all."""
        away, pixel, seen = self._away(world)
        return ~seen | (away <= -self._inset_at(world)) | (away * pixel > LEFT * self._cell)

    def room(self, world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Standard deviation (m) of splats at points at most; 0 where they are seen beside the fluid, within `LEFT`
        cells of it."""
        away, pixel, seen = self._away(world)
        beyond = away * pixel > LEFT * self._cell
        room = WIDEST * pixel * np.maximum(-away - self._inset_at(world), 0.0)
        return np.where(seen & ~beyond, room, np.inf)

    def cut(self, surface: SurfaceMap, axes: SurfaceAxes) -> SurfaceMap:
        """The map with its wet columns as the film shows them, within some cells of the simulated rim."""
        shape = surface.wet.shape
        middles = np.concatenate([surface.middles(), surface.height[..., None]], axis=-1).reshape(-1, 3)
        away, pixel, seen = (a.reshape(shape) for a in self._away(axes.world_points(middles)))
        near = ndimage.binary_dilation(surface.wet, iterations=reach(axes))
        near |= ndimage.binary_closing(np.pad(surface.wet, HOLE), iterations=HOLE)[HOLE:-HOLE, HOLE:-HOLE]
        # a column that the outline cuts is wet: its splats are sorted out by themselves (`inside`)
        cut = 0.5 * COLUMN * self._cell
        beside = seen & (away * pixel > cut) & (away * pixel <= LEFT * self._cell)
        added = near & seen & (away * pixel <= cut)
        if self._above is not None:
            uv = self._camera.project(axes.world_points(middles))[0]
            added &= (sampled(self._above, uv[:, ::-1] - 0.5) < 0.5).reshape(shape)
        return replace(surface, wet=(surface.wet & ~beside) | added)

    def _inset_at(self, world: np.ndarray) -> np.ndarray:
        """px inside the outline at which the middles of splats end, at points (m)."""
        return sampled(self._inset, self._camera.project(world)[0][:, ::-1] - 0.5)

    def _away(self, world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """px from the outline (negative within), m of a pixel there, and whether it is in the picture."""
        uv, depth = self._camera.project(world)
        inside = every((uv >= 0) & (uv <= np.array(self._camera.size))) & (depth > 0)
        return sampled(self._away_px, uv[:, ::-1] - 0.5), depth / self._camera.focal[0], inside


class FilmedOutlines:
    """The outline of a film's fluid from frame to frame.

    While the film lasts it is that of the frame, by the majority of it and its neighbours: a mask that failed once
    opens no hole. What sways or fills is then as wide as it is shown. After the film it is that of the instant which
    the surface shows, where it came back to what it was; else its last one holds, above which what fills goes on to
    rise as fast as it did.

    Args:
        camera: that took it, of the film's size.
        footage: the film.
        cell: width of the simulator's cells, m.
        rises: whether the last outline holds after the film, and what fills is within it.
    """

    def __init__(self, camera: PinholeCamera, footage: FluidFootage, cell: float, *, rises: bool) -> None:
        self._camera, self._cell, self._rises = camera, cell, rises
        self._footage = footage
        self._rate = _rise(footage) if rises else 0.0
        self._made: tuple[int, int, FilmedOutline] | None = None

    def at(self, instant: float, shown: float | None = None) -> FilmedOutline:
        """The outline at an instant.

        Args:
            instant: frames from the first one of the film.
            shown: instant of the film that the surface shows then; None: as far as it is known, the last.
        """
        last = len(self._footage) - 1
        after = instant > last
        if after and not self._rises and shown is not None:
            instant = shown
        frame = int(np.clip(round(instant), 0, last))
        higher = int(np.ceil(self._rate * (instant - last))) if after and self._rises else 0
        if self._made is None or self._made[:2] != (frame, higher):
            wet = self._footage.settled(frame)
            outside = ndimage.distance_transform_edt(~wet) if wet.any() else np.full(wet.shape, EVERYWHERE)
            self._made = frame, higher, FilmedOutline(self._camera, outside, self._cell, rises=higher)
        return self._made[2]


def _rise(footage: FluidFootage) -> float:
    """Px per frame by which the upper ends of a fluid's columns rise where they rise fastest: not where a jet stands
    on them, whose end does not."""
    last = len(footage) - 1
    first, final = footage.settled(0), footage.settled(last)
    both = first.any(axis=0) & final.any(axis=0)
    apart = last + 1 - AGREE
    if not both.any() or apart < 1:
        return 0.0
    rise = first.argmax(axis=0)[both] - final.argmax(axis=0)[both]
    return max(float(np.percentile(rise, FASTEST)), 0.0) / apart
