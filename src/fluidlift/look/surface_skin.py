"""Surface appearance: a skin of small splats over the free surface of a liquid.

Particles that a simulation moves are drawn apart in one place and crowded in another, sink and come up. The splats that
they carry show the fluid at rest well and a moving surface poorly. The skin's splats are tracers: they float with the
surface, new ones come where they have been drawn apart, and some go where they are crowded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.look.surface_map import SurfaceMap
from fluidlift.look.tracer_spacing import bare_points, not_crowded
from fluidlift.look.whitewater_splats import kinds_of
from fluidlift.numerics.nearest import nearest
from fluidlift.types import Gaussians, sh_from_rgb
from fluidlift.types.rows import rows

PITCH = 0.25
"""cells between tracers, at the coarsest level"""

FINEST = 4
"""levels, each finer than the one before by the square root of 2: at the last one 16 tracers stand for one"""

WIDTH = 0.55
"""standard deviation of a splat along the surface, spacings of the tracers: no gaps, no blur"""

THICKNESS = 0.04
"""across the surface, cells: a third of the width. Seen from 15 degrees above a splat is then as high as it would be
without any thickness, to 10 %; three times as thick, a weir's finest band lost 7 %"""

OPACITY = 0.98
"""of each. Seen from straight above they let 2 % of what is below through (0.9: 4 %), at the same sharpness"""

STEEPEST = 4.0
"""by how much a splat is drawn out along a slope at most: one of 76 degrees"""

ALIKE = 1e-3
"""by how much a splat's size may differ from the skin's: files hold logarithms in single precision"""
UNDER = 1.5
"""cells below the skin that have its colours where no skin is drawn: as deep as a surface of particles mixes them"""
SEEN, HIDING = 3.0, 0.5
"""cells: of depth over which what is seen of dye under a skin falls to 1/e; of pure dye that let 1/e through"""
CROWDED, BARE = 0.55, 0.75
"""spacings to the next tracer below which one of two goes, and above which a new one comes"""
JUMP, SPEEDS = 1.0, 4.0
"""cell, beyond so many times its own way in a frame, by which a tracer's height changes at most: where it changes by
more, what it lay on is gone, and it would be seen to fly to what lies behind (`io.frame_checks` asks the same)"""


def of_skin(gaussians: Gaussians, cell: float) -> Bool[np.ndarray, " n"]:
    """Which splats are a skin's or white water's, by their size, which no other splat has. They are no liquid, but
    paint on it, and count for nothing in its volume, its surface and its shadow.

    Args:
        gaussians: of a frame.
        cell: width of the simulator's cells, m.
    """
    wanted = cell * np.array([THICKNESS, WIDTH * PITCH, WIDTH * PITCH])
    least = gaussians.scales.min(axis=1)
    found = np.zeros(len(gaussians), bool)
    for level in range(FINEST + 1):
        size = wanted * finer(level)
        like = np.flatnonzero(np.abs(least - size[0]) < ALIKE * size[0])
        apart = np.sort(gaussians.scales[like], axis=1) / size - 1.0
        drawn_out = (apart[:, 2] > -ALIKE) & (apart[:, 2] < STEEPEST - 1.0 + ALIKE)
        found[like] |= (np.abs(apart[:, :2]) < ALIKE).all(axis=1) & drawn_out
    return found | (kinds_of(gaussians, cell) >= 0)


def level_for(apart: Float[np.ndarray, " n"], wanted: float) -> Int[np.ndarray, " n"]:
    """The coarsest level at which tracers that would be `apart` at level 0 are at most `wanted` apart, to `FINEST`."""
    level = np.ceil(2.0 * np.log2(np.maximum(apart / wanted, 1.0)) - 1e-6).astype(np.int64)
    return np.minimum(level, FINEST)


def finer(level: Int[np.ndarray, "*n"] | int) -> Any:
    """Sizes at a level, shares of those at level 0."""
    return 2.0 ** (-0.5 * np.asarray(level))


def without_skin(gaussians: Gaussians, cell: float) -> Gaussians:
    """The splats that stand for liquid."""
    skin = of_skin(gaussians, cell)
    return gaussians.select(~skin) if skin.any() else gaussians


def painted_liquid(gaussians: Gaussians, cell: float) -> Gaussians:
    """The splats that stand for liquid, in the colours of the skin where they lie under it.

    Args:
        gaussians: of a frame.
        cell: width of the simulator's cells, m.
    """
    found = of_skin(gaussians, cell)
    if not found.any():
        return gaussians
    liquid, skin = gaussians.select(~found), gaussians.select(found)
    away, above = nearest(skin.means, liquid.means, within=UNDER * cell)
    under = np.isfinite(away)
    sh = liquid.sh.copy()
    sh[under] = skin.sh[above[under]]
    return replace(liquid, sh=sh)


def dyed(
    colors: Float[np.ndarray, "n 3"],
    points: Float[np.ndarray, "n 3"],
    surface: SurfaceMap,
    liquid: Gaussians,
    own: Bool[np.ndarray, " m"],
    cell: float,
) -> Float[np.ndarray, "n 3"]:
    """Colours of the skin with the liquid that brings a colour of its own, as dye does, where it is seen through it.

    Dye is a pigment: `HIDING` of it, pure, leaves 1/e of what is behind; and what lies deeper under the skin is seen
    less, as light is lost on its way down and back (`SEEN`). By the skin alone, dye that a jet carries down would
    never be seen.

    Args:
        colors: sRGB, of the skin's tracers.
        points: where they are, m.
        surface: the map that they float on.
        liquid: splats of the particles, eight to a cell, of which only places and colours count.
        own: which of them bring a colour of their own.
        cell: width of the simulator's cells, m.
    """
    if not own.any() or not len(points):
        return colors
    dye, shape = liquid.select(own), surface.wet.shape
    place = np.floor((dye.means[:, :2] - surface.low) / surface.pitch).astype(int)
    depth = (surface.at(surface.height, dye.means[:, :2]) - dye.means[:, 2]) / cell
    there = ((place >= 0) & (place < shape)).all(axis=1) & (depth > -1.0)  # a jet stands over the skin
    column = place[there, 0] * shape[1] + place[there, 1]
    weight = np.exp(-np.maximum(depth[there], 0.0) / SEEN) * (cell / surface.pitch) ** 2 / 8.0

    def summed(values: np.ndarray) -> np.ndarray:
        total = np.bincount(column, values, minlength=shape[0] * shape[1]).reshape(shape)
        return surface.at(ndimage.gaussian_filter(total, 1.0), points[:, :2])

    layer = np.maximum(summed(weight), 0.0)
    rgb = np.clip(dye.rgb[there], 0.0, 1.0)
    mean = np.stack([summed(weight * rgb[:, k]) for k in range(3)], axis=-1) / np.maximum(layer, 1e-9)[:, None]
    share = 1.0 - np.exp(-layer[:, None] / HIDING)
    return (1.0 - share) * colors + share * np.clip(mean, 0.0, 1.0)


class SurfaceSkin:
    """Tracers on a surface.

    Args:
        cell: width of the simulator's cells, m.
        level_at: (places [n,2] m) -> level of the tracers there, 0 to `FINEST`; None: 0 everywhere. It is asked for the
            middles of the map's columns, all of whose tracers are of that level.

    Raises:
        ValueError: a width that is not positive.
    """

    def __init__(self, cell: float, level_at: Callable[[np.ndarray], np.ndarray] | None = None) -> None:
        require(cell > 0, f"cell {cell}", "positive metres")
        self.places: Float[np.ndarray, "n 2"] = np.zeros((0, 2))
        self.ids: Int[np.ndarray, " n"] = np.zeros(0, np.int64)
        self.levels: Int[np.ndarray, " n"] = np.zeros(0, np.int64)
        self.heights: Float[np.ndarray, " n"] = np.zeros(0)
        """m, at which they were last; nan: not yet"""
        self.next_id = 0
        self._floats_on: SurfaceMap | None = None
        """the map at which `heights` were taken"""
        self._cell, self._level_at = cell, level_at

    def __len__(self) -> int:
        return len(self.ids)

    def advance(self, surface: SurfaceMap, interval: float, rng: np.random.Generator) -> None:
        """Float with the surface for an interval (s), and fill what has come apart."""
        columns, velocity = self._levels(surface), surface.at(surface.velocity, self.places)
        self.places = self.places + interval * velocity[:, :2]
        levels, (height, presence) = columns[surface.column_of(self.places)], surface.height_and_presence(self.places)
        risen = np.abs(height - np.where(np.isfinite(self.heights), self.heights, height))
        stays = risen <= JUMP * self._cell + SPEEDS * interval * np.linalg.norm(velocity, axis=1)
        self.heights, self._floats_on = height, surface
        self._keep((presence > 0.5) & (levels == self.levels) & stays)
        if surface.wet.any():
            self._fill_all(surface, columns, rng)

    def _fill_all(self, surface: SurfaceMap, columns: Int[np.ndarray, "nx ny"], rng: np.random.Generator) -> None:
        found = np.unique(columns[surface.wet])
        self._thin_out(found)
        for level in found:
            self._fill(surface, int(level), columns == level, rng)

    def _thin_out(self, found: Int[np.ndarray, " k"]) -> None:
        """Tracers of some levels go where they are crowded."""
        keep = np.ones(len(self), bool)
        for level in found:
            own = np.flatnonzero(self.levels == level)
            if len(own) > 1:
                spacing = PITCH * self._cell * float(finer(int(level)))
                keep[own] = not_crowded(rows(self.places, own), self.ids[own], CROWDED * spacing)
        self._keep(keep)

    def _fill(
        self, surface: SurfaceMap, level: int, where: Bool[np.ndarray, "nx ny"], rng: np.random.Generator
    ) -> None:
        """Tracers of a level come where they are drawn apart, in some of the columns of the map."""
        spacing, own = PITCH * self._cell * float(finer(level)), np.flatnonzero(self.levels == level)
        low = np.floor(surface.low / spacing)
        count = np.ceil(np.array(surface.wet.shape) * surface.pitch / spacing).astype(int) + 1
        # few are bare: only these are asked where they are
        bare = bare_points(rows(self.places, own), low, spacing, (int(count[0]), int(count[1])), BARE * spacing)
        column = [
            np.clip(np.floor(((low[a] + np.arange(n) + 0.5) * spacing - surface.low[a]) / surface.pitch), 0, most - 1)
            for a, (n, most) in enumerate(zip(bare.shape, where.shape, strict=True))
        ]
        bare &= where[np.ix_(*(c.astype(int) for c in column))]
        lattice = (low + np.argwhere(bare) + 0.5) * spacing
        lattice = lattice[surface.presence(lattice) > 0.5]
        fresh = lattice + rng.uniform(-0.25, 0.25, lattice.shape) * spacing
        self.places = np.concatenate([self.places, fresh])
        self.ids = np.concatenate([self.ids, self.next_id + np.arange(len(fresh))])
        self.levels = np.concatenate([self.levels, np.full(len(fresh), level)])
        self.heights = np.concatenate([self.heights, surface.at(surface.height, fresh)])
        self.next_id += len(fresh)

    def _levels(self, surface: SurfaceMap) -> Int[np.ndarray, "nx ny"]:
        """That of the tracers in each column of the map."""
        if self._level_at is None:
            return np.zeros(surface.wet.shape, np.int64)
        return self._level_at(surface.middles().reshape(-1, 2)).reshape(surface.wet.shape)

    def _keep(self, index: np.ndarray) -> None:
        if index.all():
            return
        kept = np.flatnonzero(index)
        self.places, self.ids = rows(self.places, kept), self.ids[kept]
        self.levels, self.heights = self.levels[kept], self.heights[kept]

    def points(self, surface: SurfaceMap) -> Float[np.ndarray, "n 3"]:
        """Where the tracers are, m."""
        heights = self.heights if surface is self._floats_on else surface.at(surface.height, self.places)
        return np.concatenate([self.places, heights[:, None]], axis=1)

    def splats(self, surface: SurfaceMap, colors: Float[np.ndarray, "n 3"]) -> Gaussians:
        """Flat splats that lie on the surface now, in sRGB colours (of each tracer) from any side."""
        n = len(self)
        normal = np.concatenate([-surface.slope(self.places), np.ones((n, 1))], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        # x along the steepest way, then the shortest turn from z to the normal
        half = 0.5 * np.arctan2(-normal[:, 1], -normal[:, 0])
        c, s, up = np.cos(half), np.sin(half), 1 + normal[:, 2]
        x, y = normal[:, 0] * s - normal[:, 1] * c, normal[:, 0] * c + normal[:, 1] * s
        quats = np.stack([up * c, x, y, up * s], axis=-1)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        scales = finer(self.levels)[:, None] * self._cell * np.array([WIDTH * PITCH, WIDTH * PITCH, THICKNESS])
        # tracers are as far apart on the map wherever they are: on a slope, farther in space
        scales[:, 0] *= np.minimum(1.0 / normal[:, 2], STEEPEST)
        scales = scales.astype(np.float32)
        return Gaussians(
            self.points(surface).astype(np.float32), quats.astype(np.float32), scales,
            np.full(n, OPACITY, np.float32), sh_from_rgb(np.clip(colors, 0.0, 1.0)),
        )  # fmt: skip
