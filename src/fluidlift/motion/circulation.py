"""Standing water: what of its seen motion is motion of water, and what is waves that pass over it.

Optical flow follows crests. They travel at the phase speed, sqrt(g / k tanh k h), through water that goes round and
comes back to where it was (orbits of a few per cent of that speed, after Stokes). Water that stays cannot follow them:
nothing passes its outline, and its level is the same in the mean. With the depth h(x, y) and the mean u over it,

    div(h u) = 0 in the outline,    h u . n = 0 on it.

Of all fields that hold to this, u = v - grad q is the one nearest to the seen motion v (weighted with h; Helmholtz):
-div(h grad q) = -div(h v). A train of waves that crosses a basin, also one that slows down towards a shore, is the
gradient of something: all of it goes. A whirl has no gradient in it: all of it stays. What wells up in a boiling pot
and flows apart has one and goes, too: its way back below the surface is not seen.

Waves that are seen here and not there leave whirls that are none. What cannot be water, grad q, says how much of that
there is: errors have no preference for fields with or without divergence, so as much power as goes is in what stays. It
is taken off (Wiener): u is multiplied by (1 - <|grad q|^2> / <|u|^2>), or 0 where that is negative.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from fluidlift.motion.extrapolation import harmonic_extension, sample_weight, splat_samples
from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.types import CellType, Grid, SurfaceMotion

TOLERANCE = 1e-4
"""relative residual of the solve: that of the volume's projection, which follows"""


def circulating(
    surface: SurfaceMotion, cell_types: UInt8[np.ndarray, "nx ny nz"], grid: Grid
) -> tuple[SurfaceMotion, float]:
    """The part of the seen motion that stays within the water's outline, and its share of the whole.

    Args:
        surface: of standing water, m and m/s.
        cell_types: `CellType` of the water at rest.
        grid: of the cells.

    Returns:
        the motion, level, at the same points; root mean square of its speed over that of the seen one, 0 to 1.

    Raises:
        ValueError: no column of water.
    """
    wet = np.asarray(cell_types) == CellType.FLUID
    depth = np.asarray(wet.sum(axis=2) * grid.spacing, np.float32)
    plan = Grid((*grid.shape[:2], 1), grid.spacing, grid.origin)
    columns = (depth > 0)[..., None]
    flat = np.array(surface.points, np.float64)
    flat[:, 2] = grid.origin[2] + 0.5 * grid.spacing
    weight = sample_weight(surface)
    values, known = splat_samples(flat, np.asarray(surface.velocities)[:, :2], weight, columns, plan)
    if not known.any():
        return replace(surface, velocities=np.zeros_like(surface.velocities)), 0.0
    seen = harmonic_extension(values, known, columns, grid.spacing)[..., 0, :]
    kept = _projected(seen, depth, grid.spacing)
    stays, goes = (float((np.square(f).sum(axis=-1) * depth).sum()) for f in (kept, seen - kept))
    kept = kept * (max(1.0 - goes / stays, 0.0) if stays > 0 else 0.0)
    at = np.clip(plan.cell_of(flat)[:, :2], 0, np.array(plan.shape[:2]) - 1)
    velocities = np.zeros_like(surface.velocities)
    velocities[:, :2] = kept[tuple(at.T)]
    whole = float((np.square(seen).sum(axis=-1) * depth).sum())
    left = float((np.square(kept).sum(axis=-1) * depth).sum())
    return replace(surface, velocities=velocities), (float(np.sqrt(left / whole)) if whole > 0 else 0.0)


def _projected(velocity: np.ndarray, depth: np.ndarray, spacing: float) -> np.ndarray:
    """Column velocities [nx,ny,2] (m/s) made free of divergence over a depth [nx,ny] (m), with walls where it is 0."""
    nx, ny = depth.shape
    faces, weights = [], []
    for axis, shape in enumerate(((nx + 1, ny), (nx, ny + 1))):
        weight, face = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        inner = tuple(slice(1, -1) if a == axis else slice(None) for a in (0, 1))
        low, high = (np.moveaxis(depth, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        mean = 0.5 * (np.moveaxis(velocity[..., axis], axis, 0)[:-1] + np.moveaxis(velocity[..., axis], axis, 0)[1:])
        open_ = np.minimum(low, high)
        weight[inner] = np.moveaxis(open_, 0, axis)
        face[inner] = np.moveaxis(np.where(open_ > 0, mean, 0.0), 0, axis)
        faces.append(face)
        weights.append(weight)
    scale = max(float(depth.max()), 1e-12)
    u, v = (w / scale * f for w, f in zip(weights, faces, strict=True))
    outflow = (u[1:] - u[:-1] + v[:, 1:] - v[:, :-1]) / spacing
    wx, wy = (np.ascontiguousarray(w[..., None] / scale) for w in weights)
    system = PoissonSystem((depth > 0)[..., None], wx, wy, np.zeros((nx, ny, 2), np.float32), spacing)
    q = solve(system, -outflow[..., None].astype(np.float32), tolerance=TOLERANCE)[0][..., 0]
    q = np.where(depth > 0, q, 0.0)
    for axis, (face, weight) in enumerate(zip(faces, weights, strict=True)):
        inner = tuple(slice(1, -1) if a == axis else slice(None) for a in (0, 1))
        face[inner] -= np.where(weight[inner] > 0, np.diff(q, axis=axis) / spacing, 0.0)
    u, v = faces
    return np.stack([0.5 * (u[1:] + u[:-1]), 0.5 * (v[:, 1:] + v[:, :-1])], axis=-1)
