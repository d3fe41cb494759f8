"""Trilinear interpolation of grid fields at points. Outside, the nearest sample is extrapolated."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.numerics.sharing import shared
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


def interpolate_plain(
    field: Float[np.ndarray, "nx ny nz ..."], first: Float[np.ndarray, "3"], spacing: float,
    points: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n ..."]:  # fmt: skip
    """Values [n,...] of a field at points (m), in array operations; its first sample is at `first` (m)."""
    corners, local = _trilinear(field, first, spacing, points)
    fx, fy, fz = (local[:, a].reshape(-1, *[1] * (field.ndim - 3)) for a in range(3))
    along_z = [corners[c] * (1 - fz) + corners[c + 1] * fz for c in (0, 2, 4, 6)]
    along_y = [along_z[c] * (1 - fy) + along_z[c + 1] * fy for c in (0, 2)]
    out = along_y[0] * (1 - fx) + along_y[1] * fx
    return out.astype(np.result_type(field.dtype, np.float32))


def interpolate(
    field: Float[np.ndarray, "nx ny nz ..."], first: Float[np.ndarray, "3"], spacing: float,
    points: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n ..."]:  # fmt: skip
    """The same bits as `interpolate_plain`, point by point."""
    if field.dtype not in (np.float32, np.float64):
        return interpolate_plain(field, first, spacing, points)
    channels = np.ascontiguousarray(field).reshape(*field.shape[:3], -1)
    out = np.empty((len(points), channels.shape[3]), field.dtype)
    _interpolate_kernel(
        np.ascontiguousarray(points, np.float64), channels, np.asarray(first, np.float64), float(spacing), out
    )
    return out.reshape(len(points), *field.shape[3:])


@shared(lambda points, *_: (0, len(points)), least=500)
def _interpolate_kernel(begin, end, points, field, first, spacing, out):
    """All channels at once."""
    base, top, local = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3)
    for p in range(begin, end):
        for axis in range(3):
            limit = field.shape[axis] - 1
            at = (points[p, axis] - first[axis]) / spacing
            at = min(at, np.float64(limit)) if at > 0.0 else 0.0  # so is what is not a number
            base[axis] = min(np.int64(at), max(limit - 1, 0))
            local[axis] = at - base[axis]
            top[axis] = min(base[axis] + 1, limit)
        (i0, j0, k0), (i1, j1, k1) = base, top
        x, y, z = local
        for c in range(field.shape[3]):
            near = field[i0, j0, k0, c] * (1 - z) + field[i0, j0, k1, c] * z
            far = field[i0, j1, k0, c] * (1 - z) + field[i0, j1, k1, c] * z
            low = near * (1 - y) + far * y
            near = field[i1, j0, k0, c] * (1 - z) + field[i1, j0, k1, c] * z
            far = field[i1, j1, k0, c] * (1 - z) + field[i1, j1, k1, c] * z
            out[p, c] = low * (1 - x) + (near * (1 - y) + far * y) * x


def sample_nodes(field: Float[np.ndarray, "nx+1 ny+1 nz+1 ..."], grid: Grid, points: Float[np.ndarray, "n 3"]):
    """Values [n,...] of a field at the cell corners, interpolated at points (m)."""
    require(field.shape[:3] == tuple(n + 1 for n in grid.shape), f"node field {field.shape}", "one more than the cells")
    return interpolate(field, grid.low, grid.spacing, points)


def sample_centers(field: Float[np.ndarray, "nx ny nz ..."], grid: Grid, points: Float[np.ndarray, "n 3"]):
    """Values [n,...] of a field at the cell centres, interpolated at points (m)."""
    require(field.shape[:3] == grid.shape, f"cell field {field.shape}", str(grid.shape))
    return interpolate(field, grid.low + 0.5 * grid.spacing, grid.spacing, points)


def sample_faces(velocity: FaceVelocity, grid: Grid, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Velocity (m/s) at points (m)."""
    require(velocity.shape == grid.shape, f"velocity on {velocity.shape} cells", str(grid.shape))
    out = []
    for axis, component in enumerate(velocity.components):
        offset = np.full(3, 0.5)
        offset[axis] = 0.0
        out.append(interpolate(component, grid.low + offset * grid.spacing, grid.spacing, points))
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
