"""The active region of the grid, which a substep works on: cost follows the liquid, not the box.

The region is the bounding box of the particles with a margin, rounded outwards to whole blocks so that it seldom
changes. It depends on the present particles only, not on the past. Beyond it there is air, as far as the liquid of
one substep can feel: the margin exceeds the longest way of a particle plus the layers of continued velocity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.numerics.sharing import shared
from fluidlift.physics.boundaries import Walls, beside_closed_faces
from fluidlift.types import Grid, triple

MARGIN = 4
"""cells between the outermost particle and the region's side"""
BLOCK = 8
"""cells: regions begin and end at multiples of it"""
CHUNK = 4096

Box = tuple[slice, slice, slice]
"""ranges of cells along x, y, z"""


@shared(lambda positions, lows, *_: (0, len(lows)))
def _extremes(begin, end, positions, lows, highs):
    n = len(positions)
    for chunk in range(begin, end):
        first = chunk * CHUNK
        for p in range(first, min(first + CHUNK, n)):
            for a in range(3):
                lows[chunk, a] = min(lows[chunk, a], positions[p, a])
                highs[chunk, a] = max(highs[chunk, a], positions[p, a])


def region_around(
    positions: Float[np.ndarray, "n 3"], grid: Grid, kept: tuple[np.ndarray, np.ndarray] | None = None
) -> Box:
    """The region of particles (at least one); `kept` is a range of cells (low, high exclusive) that it must hold."""
    chunks = (len(positions) + CHUNK - 1) // CHUNK
    lows, highs = np.full((chunks, 3), np.inf, np.float32), np.full((chunks, 3), -np.inf, np.float32)
    _extremes(positions, lows, highs)
    return region_of_extent(lows.min(axis=0), highs.max(axis=0), grid, kept)


def region_of_extent(
    lowest: Float[np.ndarray, "3"],
    highest: Float[np.ndarray, "3"],
    grid: Grid,
    kept: tuple[np.ndarray, np.ndarray] | None = None,
) -> Box:
    """`region_around` particles whose least and largest coordinates are known, float32, m."""
    low = np.floor((lowest - grid.low) / grid.spacing) - MARGIN
    high = np.floor((highest - grid.low) / grid.spacing) + 1 + MARGIN
    if kept is not None:
        low, high = np.minimum(low, kept[0]), np.maximum(high, kept[1])
    last = np.asarray(grid.shape)
    low = np.clip(np.floor(low / BLOCK) * BLOCK, 0, last - 1).astype(int)
    high = np.clip(np.ceil(high / BLOCK) * BLOCK, low + 1, last).astype(int)
    return triple(slice(int(a), int(b)) for a, b in zip(low, high))


def face_box(box: Box, axis: int) -> Box:
    """The faces across `axis` of the region's cells."""
    return triple(slice(s.start, s.stop + (a == axis)) for a, s in enumerate(box))


def inner_grid(grid: Grid, box: Box) -> Grid:
    """The region's own grid."""
    shape = triple(s.stop - s.start for s in box)
    return Grid(shape, grid.spacing, triple(o + s.start * grid.spacing for o, s in zip(grid.origin, box)))


def crop_walls(walls: Walls, box: Box) -> Walls:
    """The walls inside a region, on the region's own grid."""
    inner = inner_grid(walls.grid, box)
    nodes = tuple(slice(s.start, s.stop + 1) for s in box)
    solid, buried, regions = (np.ascontiguousarray(c[box]) for c in (walls.solid, walls.buried, walls.regions))
    return Walls(
        inner, np.ascontiguousarray(walls.signed_distance[nodes]),
        triple(np.ascontiguousarray(o[face_box(box, a)]) for a, o in enumerate(walls.openings)),
        triple(np.ascontiguousarray(n[face_box(box, a)]) for a, n in enumerate(walls.normals)),
        solid, buried, regions, walls.open_sides,
    )  # fmt: skip


@dataclass(frozen=True)
class ActiveRegion:
    """What a substep knows about its region."""

    box: Box
    walls: Walls
    """cut to the region"""
    capacity: Float[np.ndarray, "nx ny nz"]
    """of `boundaries.cell_capacity`"""
    wall_cells: Bool[np.ndarray, "nx ny nz"]
    """cells with a face that is mostly closed"""

    @property
    def grid(self) -> Grid:
        """Of the region."""
        return self.walls.grid

    @property
    def first(self) -> tuple[int, int, int]:
        """Indices of the region's first cell in the whole box."""
        return tuple(s.start for s in self.box)


def open_region(box: Box, walls: Walls, capacity: Float[np.ndarray, "nx ny nz"]) -> ActiveRegion:
    """The region `box` onto walls and capacity of the whole box."""
    inner = crop_walls(walls, box)
    return ActiveRegion(box, inner, np.ascontiguousarray(capacity[box]), beside_closed_faces(inner))


def moved_to(
    values: Float[np.ndarray, "nx ny nz"], old: tuple[int, int, int], new: tuple[int, int, int], shape: tuple[int, ...]
) -> Float[np.ndarray, "mx my mz"]:
    """Cell values of the region that begins at `old`, on the region of `shape` that begins at `new`; 0 where new."""
    out = np.zeros(shape, values.dtype)
    source, target = [], []
    for axis in range(3):
        low = max(old[axis], new[axis])
        high = max(min(old[axis] + values.shape[axis], new[axis] + shape[axis]), low)
        source.append(slice(low - old[axis], high - old[axis]))
        target.append(slice(low - new[axis], high - new[axis]))
    out[tuple(target)] = values[tuple(source)]
    return out
