"""Trilinear interpolation of grid fields at points. Outside, the nearest sample is extrapolated."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.types import FaceVelocity, Grid


def _trilinear(
    field: np.ndarray, first: np.ndarray, spacing: float, points: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """The eight corner values of each point's cube (x slowest), and the local coordinates float64 [n,3] in [0,1]."""
    limits = np.asarray(field.shape[:3]) - 1
    coordinates = np.clip((np.asarray(points, np.float64) - first) / spacing, 0.0, limits)
    base = np.minimum(coordinates.astype(np.int64), np.maximum(limits - 1, 0))
    local = coordinates - base
    top = np.minimum(base + 1, limits)
    (i0, j0, k0), (i1, j1, k1) = base.T, top.T
    corners = [field[i, j, k] for i in (i0, i1) for j in (j0, j1) for k in (k0, k1)]
    return corners, local


def _interpolate(field: np.ndarray, first: np.ndarray, spacing: float, points: np.ndarray) -> np.ndarray:
    corners, local = _trilinear(field, first, spacing, points)
    fx, fy, fz = (local[:, a].reshape(-1, *[1] * (field.ndim - 3)) for a in range(3))
    along_z = [corners[c] * (1 - fz) + corners[c + 1] * fz for c in (0, 2, 4, 6)]
    along_y = [along_z[c] * (1 - fy) + along_z[c + 1] * fy for c in (0, 2)]
    out = along_y[0] * (1 - fx) + along_y[1] * fx
    return out.astype(np.result_type(field.dtype, np.float32))


def sample_nodes(field: Float[np.ndarray, "nx+1 ny+1 nz+1 ..."], grid: Grid, points: Float[np.ndarray, "n 3"]):
    """Values [n,...] of a field at the cell corners, interpolated at points (m)."""
    require(field.shape[:3] == tuple(n + 1 for n in grid.shape), f"node field {field.shape}", "one more than the cells")
    return _interpolate(field, grid.low, grid.spacing, points)


def sample_centers(field: Float[np.ndarray, "nx ny nz ..."], grid: Grid, points: Float[np.ndarray, "n 3"]):
    """Values [n,...] of a field at the cell centres, interpolated at points (m)."""
    require(field.shape[:3] == grid.shape, f"cell field {field.shape}", str(grid.shape))
    return _interpolate(field, grid.low + 0.5 * grid.spacing, grid.spacing, points)


def sample_faces(velocity: FaceVelocity, grid: Grid, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Velocity (m/s) at points (m)."""
    require(velocity.shape == grid.shape, f"velocity on {velocity.shape} cells", str(grid.shape))
    out = []
    for axis, component in enumerate(velocity.components):
        offset = np.full(3, 0.5)
        offset[axis] = 0.0
        out.append(_interpolate(component, grid.low + offset * grid.spacing, grid.spacing, points))
    return np.stack(out, axis=-1)


def gradient_nodes(
    field: Float[np.ndarray, "nx+1 ny+1 nz+1"], grid: Grid, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Gradient (per m) at points of the trilinear interpolant of a field at the cell corners."""
    require(field.shape == tuple(n + 1 for n in grid.shape), f"node field {field.shape}", "one more than the cells")
    (c000, c001, c010, c011, c100, c101, c110, c111), local = _trilinear(field, grid.low, grid.spacing, points)
    x, y, z = local.T

    def blend(a, b, c, d, s, t):
        return (a * (1 - s) + c * s) * (1 - t) + (b * (1 - s) + d * s) * t

    gx = blend(c100 - c000, c101 - c001, c110 - c010, c111 - c011, y, z)
    gy = blend(c010 - c000, c011 - c001, c110 - c100, c111 - c101, x, z)
    gz = blend(c001 - c000, c011 - c010, c101 - c100, c111 - c110, x, y)
    out = np.stack([gx, gy, gz], axis=-1) / grid.spacing
    return out.astype(np.result_type(field.dtype, np.float32))
