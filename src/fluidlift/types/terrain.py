"""The solid world that a fluid runs over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require
from fluidlift.types.grid import Grid


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles with vertex colours."""

    vertices: Float[np.ndarray, "v 3"]
    """m"""
    faces: Int[np.ndarray, "f 3"]
    """counter-clockwise seen from outside"""
    colors: Float[np.ndarray, "v 3"] | None = None
    """sRGB in [0, 1]"""

    def __post_init__(self) -> None:
        require(self.vertices.ndim == 2 and self.vertices.shape[1] == 3, f"vertices {self.vertices.shape}", "[v,3]")
        require(self.faces.ndim == 2 and self.faces.shape[1] == 3, f"faces {self.faces.shape}", "[f,3]")


@dataclass(frozen=True)
class Terrain:
    """Bed, banks and rocks."""

    grid: Grid
    signed_distance: Float[np.ndarray, "nx+1 ny+1 nz+1"]
    """m at the grid's nodes, positive outside the solid"""
    mainstream: Float[np.ndarray, "3"]
    """unit direction of the bulk flow in the world"""
    mesh: TriangleMesh
    """the surface of the solid, for pictures and export"""

    def __post_init__(self) -> None:
        shape = tuple(n + 1 for n in self.grid.shape)
        require(self.signed_distance.shape == shape, f"signed distance {self.signed_distance.shape}", str(shape))
