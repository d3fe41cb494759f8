"""Speed of what falls, where the picture moves too fast for optical flow to follow.

A fall or a jet is often a blur without features, or moves on by more than its own texture's wavelength between two
frames; flow then reports a small fraction of the motion. Energy gives what it should be: v^2 = v0^2 + 2 g (z0 - z).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require, required
from fluidlift.types import GRAVITY, FluidKind, Grid, SurfaceMotion, kind_of

BELIEVABLE = 0.3
"""share of the expected speed below which a measured motion counts as failed: friction takes at most half (below)"""

FALLEN = 0.15
"""share of the whole drop that the fluid has already fallen where it enters the picture"""
FEWEST = 60
"""points that a lean is read from"""
LAYERS = 16
"""of height, over which the way of a fall is followed"""
QUARTILES = (0.25, 0.75)
"""of the water in a layer, whose ways are followed: its edges would be those of spray and of threads beside it"""
MOSTLY = 0.5
"""share of the steep part that flow could not follow, from which its drift is not believed in the rest either: one
sheet drifts at one speed, or it would not stay whole"""
SIDEWAYS = 1.0
"""drift over the speed of the fall at its foot, at most"""


def downhill_of(
    points: Float[np.ndarray, "n 3"],
    grid: Grid,
    surface_height: Float[np.ndarray, "nx ny"] | None,
    pool_level: float | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Unit direction of steepest descent of the surface at points; straight down for bodies in the air.

    Args:
        points: m.
        grid: of the columns.
        surface_height: z of the surface over each column, m; None for what is in the air.
        pool_level: z below which a body in the air stands in its vessel and does not fall, m.
    """
    if surface_height is None:
        down = np.tile([0.0, 0.0, -1.0], (len(points), 1))
        if pool_level is not None:
            down[points[:, 2] < pool_level] = [1.0, 0.0, 0.0]
        return down
    gx, gy = np.gradient(surface_height, grid.spacing)
    cell = np.clip(grid.cell_of(points)[:, :2], 0, np.array(grid.shape[:2]) - 1)
    slope = np.stack([gx[cell[:, 0], cell[:, 1]], gy[cell[:, 0], cell[:, 1]]], axis=-1)
    squared = (slope**2).sum(axis=1)
    steepest = np.concatenate([-slope, -squared[:, None]], axis=1)
    return steepest / np.maximum(np.linalg.norm(steepest, axis=1, keepdims=True), 1e-12)


def falling_share(
    points: Float[np.ndarray, "n 3"], downhill: Float[np.ndarray, "n 3"], measured: Float[np.ndarray, "n 3"], *,
    kind: str | FluidKind, top: float,
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:  # fmt: skip
    """Expected velocity and where it should replace the measured one.

    Args:
        points: on the surface, m.
        downhill: unit direction of steepest descent along the surface there (straight down in the air).
        measured: m/s.
        kind: of the fluid, which falls freely.
        top: height from which the fluid falls, m.
    """
    kept = required(kind_of(kind).energy_share, f"the kind '{kind}'", "a fluid that falls freely")
    steep = np.clip(-downhill[:, 2], 0.0, 1.0)
    drop = np.maximum(top - points[:, 2], 0.0)
    speed = np.sqrt(2.0 * GRAVITY * kept * drop) * steep
    expected = speed[:, None] * downhill
    along = (measured * downhill).sum(axis=1)
    replaced = (steep > 0.5) & (speed > 0) & (along < BELIEVABLE * speed)
    return expected, replaced


def drift_of(
    points: Float[np.ndarray, "n 3"], downhill: Float[np.ndarray, "n 3"], speed: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Level velocity across the fall that makes it stand where it is seen, m/s; 0 where too little falls.

    A steady fall keeps its outline, so no water passes it: a quarter of the water stays on either side of the way that
    the quartiles of its points take from layer to layer of height. In the air nothing pushes sideways; a way that was
    fallen for a time t has drifted by w t (a parabola), and w is the slope of the line through drift and time.

    Args:
        points: on the surface, m.
        downhill: unit direction of the fall without drift.
        speed: m/s along it, as expected.
    """
    out = np.zeros_like(points, dtype=np.float64)
    steep = (-downhill[:, 2] > 0.5) & (speed > 0)
    if steep.sum() < FEWEST:
        return out
    flat = downhill[steep, :2].mean(axis=0)
    if np.linalg.norm(flat) < 0.05:  # in the air: across is where it is wide
        flat = np.linalg.svd(points[steep, :2] - points[steep, :2].mean(axis=0), full_matrices=False)[2][1]
    across = np.array([-flat[1], flat[0]]) / np.linalg.norm(flat)
    c, z = points[:, :2] @ across, points[:, 2]
    low, high = np.percentile(z[steep], [2, 98])
    edges = np.linspace(high, low, LAYERS + 1)
    layer = np.where(steep, np.searchsorted(-edges, -z, side="right") - 1, -1)
    filled = [k for k in range(LAYERS) if (layer == k).sum() >= max(5, FEWEST // LAYERS)]
    if len(filled) < LAYERS // 2:
        return out
    middle = 0.5 * (edges[1:] + edges[:-1])
    fall = np.array([np.median((speed * -downhill[:, 2])[layer == k]) for k in filled])
    step = -np.diff(middle[filled]) / (0.5 * (fall[1:] + fall[:-1]))
    time = np.concatenate([[0.0], np.cumsum(step)])
    ways = np.array([np.quantile(c[layer == k], QUARTILES) for k in filled])
    drifts = [_middle_slope(time, way) for way in ways.T]
    # between the quartiles, and a little beyond, the drift changes evenly
    clock = np.interp(-z, -middle[filled], time)
    starts = [np.median(way - w * time) for way, w in zip(ways.T, drifts)]
    low, high = (start + w * clock for start, w in zip(starts, drifts))
    share = np.clip((c - low) / np.maximum(high - low, 1e-9), -0.5, 1.5)
    limit = SIDEWAYS * float(fall.max())
    drift = np.clip(drifts[0] + share * (drifts[1] - drifts[0]), -limit, limit)
    out[:, :2] = np.where(steep, drift, 0.0)[:, None] * across
    return out


def _middle_slope(time: np.ndarray, way: np.ndarray) -> float:
    """Median of the slopes between all pairs (Theil 1950, Sen 1968)."""
    i, j = np.triu_indices(len(time), 1)
    return float(np.median((way[j] - way[i]) / np.maximum(time[j] - time[i], 1e-12)))


def with_free_fall(
    surface: SurfaceMotion,
    downhill: Float[np.ndarray, "n 3"],
    *,
    kind: str | FluidKind,
) -> tuple[SurfaceMotion, float]:
    """The surface motion with free fall where steep parts seem to stand nearly still. It leans as the fluid is seen to.

    Args:
        surface: as measured.
        downhill: see `falling_share`; [n,3].
        kind: of the fluid, which falls freely.

    Returns:
        The motion, and the share of the steep points that was replaced. Replaced points are not `observed`.

    Raises:
        ValueError: a kind that does not fall freely, or arrays of different lengths.
    """
    require(kind_of(kind).falls_freely, f"the kind '{kind}'", "a fluid that falls freely")
    require(downhill.shape == surface.points.shape, f"downhill {downhill.shape}", str(surface.points.shape))
    if len(surface.points) == 0:
        return surface, 0.0
    low, high = np.percentile(surface.points[:, 2], [2, 98])
    top = high + FALLEN * (high - low)
    expected, replaced = falling_share(surface.points, downhill, surface.velocities, kind=kind, top=top)
    drift = drift_of(surface.points, downhill, np.linalg.norm(expected, axis=1))
    steep = -downhill[:, 2] > 0.5
    share = float(replaced[steep].mean()) if steep.any() else 0.0
    velocities = np.where(replaced[:, None], expected + drift, surface.velocities)
    if share > MOSTLY:
        size = np.linalg.norm(drift, axis=1, keepdims=True)
        across = drift / np.maximum(size, 1e-12)
        sideways = (velocities * across).sum(axis=1, keepdims=True)
        velocities = np.where((size > 0) & ~replaced[:, None], velocities + drift - sideways * across, velocities)
    return SurfaceMotion(surface.points, velocities, surface.observed & ~replaced), share
