"""The solid that a fluid rests in, as a signed distance on the nodes of a grid and as a mesh, together with which cells
hold fluid and where it enters and leaves.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.numerics.isosurface import surface_nets
from fluidlift.types import Grid, TriangleMesh


def signed_distance_from(
    above: Float[np.ndarray, "nx ny nz"], spacing: float, slope: Float[np.ndarray, "#nx #ny #nz"] | float = 1.0
) -> Float[np.ndarray, "nx ny nz"]:
    """Distance (m, positive where `above` > 0) to the zero set of a height above ground.

    Near the surface the height over the slope's length is exact for a plane; away from it the distance transform of
    the sign takes over.
    """
    near = above / slope
    outside = above > 0
    if outside.all() or not outside.any():
        return near
    far = (ndimage.distance_transform_edt(outside) - ndimage.distance_transform_edt(~outside)) * spacing
    far = far - np.sign(far) * 0.5 * spacing
    return np.where(np.abs(far) > 2.0 * spacing, far, near)


def to_corners(cells: np.ndarray) -> np.ndarray:
    """Column values [nx, ny] averaged to the corners between columns."""
    p = np.pad(cells, 1, mode="edge")
    return 0.25 * (p[:-1, :-1] + p[1:, :-1] + p[:-1, 1:] + p[1:, 1:])


def at_cells(nodes: np.ndarray) -> np.ndarray:
    """Node values [nx+1, ny+1, nz+1] averaged to cell centres."""
    a = 0.5 * (nodes[1:] + nodes[:-1])
    a = 0.5 * (a[:, 1:] + a[:, :-1])
    return 0.5 * (a[:, :, 1:] + a[:, :, :-1])


def unit(direction) -> np.ndarray:
    """The direction at length 1; x where there is none."""
    d = np.asarray(direction, float)
    norm = np.linalg.norm(d)
    return d / norm if norm > 1e-12 else np.array([1.0, 0.0, 0.0])


def terrain_mesh(grid: Grid, phi: np.ndarray) -> TriangleMesh:
    """Triangles on the zero set of a signed distance, m."""
    vertices, faces = surface_nets(phi, spacing=grid.spacing, origin=grid.origin)
    return TriangleMesh(vertices, faces)
