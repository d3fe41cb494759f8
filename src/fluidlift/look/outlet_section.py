"""The open ends of a stream: where what is simulated ends, a picture shows a clean section.

In its outlet liquid leaves the box. What is there thins out, and some of it lies about behind; in its inlet it fills up
only. None of that is what was seen or simulated, and drawn as it is the ends are ragged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fluidlift.types import CellType, Grid, TriangleMesh

BEYOND = 2
"""cells by which the liquid before the section is carried on for a surface: as far as its kernel reaches, so that it is
whole up to there"""
LEVEL = 0.3
"""horizontal part of the direction of flow from which a section stands upright across it"""


@dataclass(frozen=True)
class OpenEnd:
    """An upright plane across the stream."""

    along: Float[np.ndarray, "3"]
    """unit, horizontal, out of the body: downstream at the outlet, upstream at the inlet"""
    at: float
    """m along it"""
    spacing: float
    """m, of the cells"""

    @classmethod
    def of(
        cls,
        cells: UInt8[np.ndarray, "nx ny nz"],
        grid: Grid,
        mainstream: Float[np.ndarray, "3"],
        *,
        kind: CellType = CellType.OUTFLOW,
    ) -> OpenEnd | None:
        """Where liquid meets the outlet (or the inlet, `CellType.INFLOW`): half a cell into it; None where it meets
        none, or falls."""
        flat = np.array([mainstream[0], mainstream[1], 0.0])
        level = float(np.linalg.norm(flat))
        wet, out = cells == CellType.FLUID, cells == kind
        first = np.zeros(out.shape, bool)
        for axis in (0, 1):
            for step in (1, -1):
                beside = np.roll(wet, step, axis)
                np.moveaxis(beside, axis, 0)[0 if step == 1 else -1] = False
                first |= out & beside
        if level < LEVEL or not first.any():
            return None
        flat /= level if kind == CellType.OUTFLOW else -level
        return cls(flat, float(np.median(grid.centers()[first] @ flat)), grid.spacing)

    def before(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether points lie before the section."""
        return np.asarray(points) @ self.along < self.at

    def carried_on(self, points: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
        """The points before the section and, `BEYOND` times behind it, those of the last cell before it: which of them,
        and where.

        The liquid goes on as a prism, as wide and as high as at the section. What is there in truth thins out and
        spreads, and pushed onto the plane it would stand beside the section as a film.
        """
        points = np.asarray(points)
        over = points @ self.along - self.at
        last = np.flatnonzero((over < 0) & (over >= -self.spacing))
        which = [np.flatnonzero(over < 0), *[last] * BEYOND]
        places = [points[i] + k * self.spacing * self.along for k, i in enumerate(which)]
        return np.concatenate(which), np.concatenate(places).astype(points.dtype)

    def section(self, mesh: TriangleMesh) -> TriangleMesh:
        """A closed mesh with all that is behind the section pushed onto it: closed still, and flat there."""
        points = np.array(mesh.vertices)
        over = np.maximum(points @ self.along - self.at, 0.0)
        return TriangleMesh((points - over[:, None] * self.along).astype(points.dtype), mesh.faces, mesh.colors)
