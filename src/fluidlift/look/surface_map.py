"""The free surface of a liquid that lies, as a map over the plan: where it is, how high it stands, how it moves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.numerics.sharing import shared
from fluidlift.numerics.short_axis import highest, lowest
from fluidlift.types.rows import rows

COLUMN = 0.5
"""width of a column of the map, cells: each holds particles where there is liquid (eight per cell)"""

SPRAY = 1.0
"""cells above its surroundings from which a particle is spray, or a jet, and not the surface"""

FEW = 0.01
"""of the surrounding columns whose heights count, below which they have no mean: it would be the map's zero, which over
the picture is the camera itself"""

SKIN = 1.5
"""cells below the surface whose motion is that of the surface"""

SMOOTH = 1.5
"""standard deviation of the blur before a slope is taken, columns"""

MARGIN = 4
"""empty columns around the liquid"""


@dataclass(frozen=True)
class SurfaceMap:
    """Columns of `pitch` metres from `low` on (x, y)."""

    low: Float[np.ndarray, "2"]
    pitch: float
    wet: Bool[np.ndarray, "nx ny"]
    """where the surface is; the space between two splashes is not"""
    height: Float[np.ndarray, "nx ny"]
    """z, m; beside the liquid that of the nearest"""
    velocity: Float[np.ndarray, "nx ny 3"]
    """m/s"""

    @classmethod
    def of(
        cls,
        positions: Float[np.ndarray, "n 3"],
        velocities: Float[np.ndarray, "n 3"],
        cell: float,
        *,
        margin: int = MARGIN,
    ) -> SurfaceMap:
        """The surface of the particles at some positions (m) with velocities (m/s).

        Args:
            positions: one or more.
            velocities: of each of them.
            cell: width of the simulator's cells, m.
            margin: empty columns around the liquid.

        Raises:
            ValueError: no particles, or another number of velocities.
        """
        require(len(positions) > 0, "no particles", "one or more")
        require(len(positions) == len(velocities), f"{len(velocities)} velocities", f"{len(positions)}")
        pitch, z = COLUMN * cell, np.asarray(positions[:, 2], np.float64)
        low = lowest(positions[:, :2]).astype(np.float64) - (margin + 0.5) * pitch
        size = np.ceil((highest(positions[:, :2]) - low) / pitch).astype(int) + margin + 1
        row, along = (np.floor((positions[:, a] - low[a]) / pitch).astype(int) for a in (0, 1))
        column = row * size[1] + along
        top = np.full(size.prod(), -np.inf)
        np.maximum.at(top, column, z)
        top = top.reshape(size)
        wet, height = _level(top, SPRAY * cell)
        near = np.flatnonzero(np.abs(z - height.ravel()[column]) < SKIN * cell)
        column, moving = column[near], rows(velocities, near)
        count = np.bincount(column, minlength=size.prod()).reshape(size).astype(np.float64)
        moved = [np.bincount(column, moving[:, a], minlength=size.prod()).reshape(size) for a in range(3)]
        velocity = np.stack([_mean(m, count, 1.5) for m in moved], axis=-1)
        return cls(low, pitch, wet, height, velocity)

    def at(self, field: Shaped[np.ndarray, "nx ny ..."], places: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """A field of the map at some places (x, y in m), between its columns by their distance."""
        return sampled(field, np.asarray(places, np.float64), first=self.low, apart=self.pitch, middle=0.5)

    def column_of(self, places: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the columns that hold places (x, y in m), or are nearest to them."""
        row, column = np.clip(((places - self.low) / self.pitch).astype(np.int64), 0, np.array(self.wet.shape) - 1).T
        return row, column

    def mean(
        self, values: Float[np.ndarray, " n"], places: Float[np.ndarray, "n 2"], elsewhere: float
    ) -> Float[np.ndarray, "nx ny"]:
        """Field of the map with the mean of the values of the places (x, y in m) in each column; `elsewhere` in columns
        without any."""
        column, n = np.ravel_multi_index(self.column_of(places), self.wet.shape), self.wet.size
        count = np.bincount(column, minlength=n)
        found = np.where(count > 0, np.bincount(column, values, minlength=n) / np.maximum(count, 1), elsewhere)
        return found.reshape(self.wet.shape)

    def presence(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """How much of the surroundings of places (m) is liquid: 1/2 on a straight shore."""
        return self.at(self._share, places)

    def height_and_presence(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2 n"]:
        """Of the surface at places (m), as `at` and `presence` have them, in one go."""
        return self.at(self._height_and_share, places).T

    @cached_property
    def _height_and_share(self) -> Float[np.ndarray, "nx ny 2"]:
        return np.stack([self.height, self._share], axis=-1)

    @cached_property
    def _share(self) -> Float[np.ndarray, "nx ny"]:
        """Of the surroundings of each column that is wet: asked for again and again in a frame."""
        return ndimage.gaussian_filter(self.wet.astype(np.float64), 0.7)

    def slope(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Gradient of the height at places (m), of what is wider than a cell."""
        return self.at(self._slopes, places)

    @cached_property
    def _slopes(self) -> Float[np.ndarray, "nx ny 2"]:
        """Of each column: asked for as often."""
        smooth = ndimage.gaussian_filter(self.height, SMOOTH)
        return np.stack([*np.gradient(smooth, self.pitch)], axis=-1)

    def columns(self) -> Float[np.ndarray, "m 2"]:
        """Middles (x, y in m) of the wet columns."""
        return (np.argwhere(self.wet) + 0.5) * self.pitch + self.low

    def middles(self) -> Float[np.ndarray, "nx ny 2"]:
        """Middles (x, y in m) of all columns."""
        return (np.moveaxis(np.indices(self.wet.shape), 0, -1) + 0.5) * self.pitch + self.low


def sampled(
    field: Float[np.ndarray, "nx ny ..."] | Int[np.ndarray, "nx ny ..."],
    index: Float[np.ndarray, "n 2"],
    *,
    first: Float[np.ndarray, "2"] | tuple[float, float] = (0.0, 0.0),
    apart: float = 1.0,
    middle: float = 0.0,
) -> np.ndarray:
    """Bilinear, at fractional indices, or at places whose index is (place - first) / apart - middle; the nearest value
    outside."""
    if field.dtype not in (np.float32, np.float64):
        return ndimage.map_coordinates(field, ((index - first) / apart - middle).T, order=1, mode="nearest")
    channels = field[..., None] if field.ndim == 2 else field
    out = np.empty((len(index), channels.shape[-1]), field.dtype)
    lattice = np.array([*first, apart, middle], np.float64)
    sampled_kernel(np.ascontiguousarray(channels), np.ascontiguousarray(index, np.float64), lattice, out)
    return out[:, 0] if field.ndim == 2 else out


@shared(lambda field, index, *_: (0, len(index)), error_model="numpy")
def sampled_kernel(begin, end, field, places, lattice, out):
    """All channels of a picture at once: SciPy finds place and weights again for each. The same bits."""
    height, width, channels = field.shape
    first_row, first_column, apart, middle = lattice[0], lattice[1], lattice[2], lattice[3]
    for i in range(begin, end):
        y, x = (places[i, 0] - first_row) / apart - middle, (places[i, 1] - first_column) / apart - middle
        y, x = y if y > 0.0 else 0.0, x if x > 0.0 else 0.0  # so is what is not a number
        y, x = min(y, height - 1.0), min(x, width - 1.0)
        r, c = int(y), int(x)
        below, right = min(r + 1, height - 1), min(c + 1, width - 1)
        fy, fx = y - r, x - c
        for k in range(channels):
            total = field[r, c, k] * (1.0 - fy) * (1.0 - fx) + field[r, right, k] * (1.0 - fy) * fx
            total += field[below, c, k] * fy * (1.0 - fx)
            total += field[below, right, k] * fy * fx
            out[i, k] = total


def _mean(total: np.ndarray, count: np.ndarray, width: float) -> np.ndarray:
    """Weighted mean over a neighbourhood (standard deviation in columns) of sums and counts per column."""
    return ndimage.gaussian_filter(total, width) / np.maximum(ndimage.gaussian_filter(count, width), 1e-6)


def _level(top: np.ndarray, spray: float) -> tuple[np.ndarray, np.ndarray]:
    """Wet columns and the height of the surface from the highest particle of each column (-inf: none)."""
    have = np.isfinite(top)
    z, around = np.where(have, top, 0.0), ndimage.uniform_filter(have.astype(np.float64), 3)
    wet = (have & (around > 0.3)) | (around > 0.6)
    counted, rough = have.astype(np.float64), z
    for _ in range(2):  # where all is spray, as its mean
        rough = np.where(ndimage.gaussian_filter(counted, 2.0) > FEW, _mean(z * counted, counted, 2.0), rough)
        counted = (have & (np.abs(z - rough) < spray)).astype(np.float64)
    fine = _mean(z * counted, counted, 1.0)
    height = np.where(ndimage.gaussian_filter(counted, 1.0) > 0.05, fine, rough)
    if wet.any():
        nearest = ndimage.distance_transform_edt(~wet, return_distances=False, return_indices=True)
        height = height[tuple(nearest)]
    return wet, height
