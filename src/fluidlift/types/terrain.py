"""The solid world that a fluid runs over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from fluidlift.errors import require
from fluidlift.types.grid import Grid


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles with vertex colours, and with a texture where there is one."""

    vertices: Float[np.ndarray, "v 3"]
    """m"""
    faces: Int[np.ndarray, "f 3"]
    """counter-clockwise seen from outside"""
    colors: Float[np.ndarray, "v 3"] | None = None
    """sRGB in [0, 1]"""
    uv: Float[np.ndarray, "f 3 2"] | None = None
    """texture coordinates of each face's corners: (0, 0) is the texture's upper left corner, (1, 1) its lower right"""
    texture: UInt8[np.ndarray, "h w 3"] | None = None
    """sRGB; finer than the vertices' colours, which are for whom has no textures"""

    def __post_init__(self) -> None:
        require(self.vertices.ndim == 2 and self.vertices.shape[1] == 3, f"vertices {self.vertices.shape}", "[v,3]")
        require(self.faces.ndim == 2 and self.faces.shape[1] == 3, f"faces {self.faces.shape}", "[f,3]")
        require((self.uv is None) == (self.texture is None), "uv without a texture, or a texture without uv", "both")
        if self.uv is not None and self.texture is not None:
            require(self.uv.shape == (len(self.faces), 3, 2), f"uv {self.uv.shape}", f"[{len(self.faces)},3,2]")
            shape, kind = self.texture.shape, self.texture.dtype
            require(len(shape) == 3 and shape[2] == 3 and min(shape) > 0, f"texture {shape}", "[h,w,3]")
            require(kind == np.uint8, f"texture of {kind}", "8 bits")


@dataclass(frozen=True)
class VesselRim:
    """The rim of a vessel that a pour fills: a level circle."""

    center: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class Coat:
    """What a pour forms on something that it covers: a film around a solid of revolution."""

    top: float
    """z of its highest point, m"""
    radius: float
    """of its outside at its lower end, m"""
    thickness: float
    """m"""


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
    opaque: bool = False
    """of a pour: its vessel, or what it covers, hides what is in or behind it, where glass does not"""

    def __post_init__(self) -> None:
        shape = tuple(n + 1 for n in self.grid.shape)
        require(self.signed_distance.shape == shape, f"signed distance {self.signed_distance.shape}", str(shape))


@dataclass(frozen=True)
class Setting:
    """A fluid in its place at the first instant."""

    terrain: Terrain
    cell_types: UInt8[np.ndarray, "nx ny nz"]
    """values of `CellType`"""
    surface_height: Float[np.ndarray, "nx ny"] | None
    """z of the free surface over each column, m (fluids that lie on something)"""
    bed_height: Float[np.ndarray, "nx ny"]
    """z of the ground under each column, m"""
    pool_level: float | None = None
    """z below which a pour stands in its vessel, m"""
    rim: VesselRim | None = None
    """of that vessel where it is looked into, m"""
    coat: Coat | None = None
    """of a pour that covers something"""

    @property
    def held_below(self) -> float | None:
        """z below which a pour is held by something, and does not fall, m; None: it falls throughout."""
        return self.pool_level if self.coat is None else self.coat.top
