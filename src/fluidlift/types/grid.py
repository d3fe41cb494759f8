"""The staggered (MAC) grid: index order x, y, z; velocity components live on cell faces."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require

T = TypeVar("T")


def triple(values: Iterable[T]) -> tuple[T, T, T]:
    """Three values, one per axis, as a tuple whose length a type checker knows.

    Raises:
        ValueError: more or fewer values.
    """
    x, y, z = values
    return x, y, z


class CellType(IntEnum):
    """What a cell holds."""

    EMPTY = 0
    FLUID = 1
    SOLID = 2
    INFLOW = 3
    OUTFLOW = 4


@dataclass(frozen=True)
class Grid:
    """A box of cubic cells."""

    shape: tuple[int, int, int]
    """nx, ny, nz cells"""
    spacing: float
    """cell width, m"""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """low corner of cell (0, 0, 0), m"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        object.__setattr__(self, "origin", tuple(float(x) for x in self.origin))
        object.__setattr__(self, "spacing", float(self.spacing))
        require(len(self.shape) == 3 and min(self.shape) >= 1, f"grid shape {self.shape}", "three positive counts")
        require(np.isfinite(self.spacing) and self.spacing > 0, f"grid spacing {self.spacing}", "positive metres")

    @property
    def low(self) -> Float[np.ndarray, "3"]:
        """Low corner, m."""
        return np.asarray(self.origin)

    @property
    def high(self) -> Float[np.ndarray, "3"]:
        """High corner, m."""
        return self.low + np.asarray(self.shape) * self.spacing

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    def centers(self) -> Float[np.ndarray, "nx ny nz 3"]:
        """Cell centres, m."""
        axes = [self.origin[a] + (np.arange(self.shape[a]) + 0.5) * self.spacing for a in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def nodes(self) -> Float[np.ndarray, "nx+1 ny+1 nz+1 3"]:
        """Cell corners, m."""
        axes = [self.origin[a] + np.arange(self.shape[a] + 1) * self.spacing for a in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def faces(self, axis: int) -> Float[np.ndarray, "fx fy fz 3"]:
        """Centres of the faces across `axis`, m."""
        axes = []
        for a in range(3):
            n = self.shape[a] + (a == axis)
            axes.append(self.origin[a] + (np.arange(n) + (0.0 if a == axis else 0.5)) * self.spacing)
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def face_shape(self, axis: int) -> tuple[int, int, int]:
        """Number of faces across `axis`."""
        nx, ny, nz = self.shape
        return (nx + (axis == 0), ny + (axis == 1), nz + (axis == 2))

    def cell_of(self, points: Float[np.ndarray, "*n 3"]) -> np.ndarray:
        """int64 [*n,3] cell indices (not clipped: may lie outside)."""
        return np.floor((np.asarray(points) - self.low) / self.spacing).astype(np.int64)

    def contains(self, points: Float[np.ndarray, "*n 3"], margin: float = 0.0) -> np.ndarray:
        """bool [*n]: inside the box, at least `margin` metres from its sides."""
        p, low, high = np.asarray(points), self.low + margin, self.high - margin
        x, y, z = ((p[..., a] >= low[a]) & (p[..., a] < high[a]) for a in range(3))  # all of an axis of three are slow
        return x & y & z


@dataclass(frozen=True)
class FaceVelocity:
    """Velocity components on the faces they cross, m/s."""

    u: Float[np.ndarray, "nx+1 ny nz"]
    v: Float[np.ndarray, "nx ny+1 nz"]
    w: Float[np.ndarray, "nx ny nz+1"]

    def __post_init__(self) -> None:
        nx, ny, nz = self.u.shape[0] - 1, self.u.shape[1], self.u.shape[2]
        require(
            self.v.shape == (nx, ny + 1, nz) and self.w.shape == (nx, ny, nz + 1),
            f"face arrays {self.u.shape}, {self.v.shape}, {self.w.shape}",
            "(nx+1,ny,nz), (nx,ny+1,nz), (nx,ny,nz+1)",
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells of the grid."""
        return (self.v.shape[0], self.u.shape[1], self.u.shape[2])

    @property
    def components(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """u, v, w."""
        return (self.u, self.v, self.w)

    @classmethod
    def zeros(cls, grid: Grid, dtype: type = np.float32) -> FaceVelocity:
        """A fluid at rest."""
        return cls(*(np.zeros(grid.face_shape(a), dtype) for a in range(3)))

    def at_centers(self) -> Float[np.ndarray, "nx ny nz 3"]:
        """Averages of opposite faces, m/s."""
        return np.stack(
            [
                0.5 * (self.u[1:] + self.u[:-1]),
                0.5 * (self.v[:, 1:] + self.v[:, :-1]),
                0.5 * (self.w[:, :, 1:] + self.w[:, :, :-1]),
            ],
            axis=-1,
        )
