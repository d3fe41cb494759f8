"""Speed of what falls, where the picture moves too fast for optical flow to follow.

A fall or a jet is often a blur without features, or moves on by more than its own texture's wavelength between two
frames; flow then reports a small fraction of the motion. Energy gives what it should be: v^2 = v0^2 + 2 g (z0 - z).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.types import Grid, SurfaceMotion

BELIEVABLE = 0.3
"""share of the expected speed below which a measured motion counts as failed: friction takes at most half (below)"""

ENERGY_SHARE = {"pour": 0.95, "fall": 0.35}
"""share of the drop's energy that is left: almost all in the air, a third over rock (a choice)"""


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
    kind: str, top: float, gravity: float,
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:  # fmt: skip
    """Expected velocity and where it should replace the measured one.

    Args:
        points: on the surface, m.
        downhill: unit direction of steepest descent along the surface there (straight down in the air).
        measured: m/s.
        kind: pour or fall.
        top: height from which the fluid falls, m.
        gravity: m/s^2, positive.
    """
    steep = np.clip(-downhill[:, 2], 0.0, 1.0)
    drop = np.maximum(top - points[:, 2], 0.0)
    speed = np.sqrt(2.0 * gravity * ENERGY_SHARE[kind] * drop) * steep
    expected = speed[:, None] * downhill
    along = (measured * downhill).sum(axis=1)
    replaced = (steep > 0.5) & (speed > 0) & (along < BELIEVABLE * speed)
    return expected, replaced


def with_free_fall(
    surface: SurfaceMotion,
    downhill: Float[np.ndarray, "n 3"],
    *,
    kind: str,
    gravity: float = 9.81,
    entry: float = 0.15,
) -> tuple[SurfaceMotion, float]:
    """The surface motion with free fall where steep parts seem to stand nearly still.

    Args:
        surface: as measured.
        downhill: see `falling_share`; [n,3].
        kind: pour or fall.
        gravity: m/s^2.
        entry: share of the whole drop that the fluid has already fallen where it enters the picture.

    Returns:
        The motion, and the share of the steep points that was replaced. Replaced points are not `observed`.

    Raises:
        ValueError: another kind, or arrays of different lengths.
    """
    require(kind in ENERGY_SHARE, f"kind '{kind}'", "pour or fall")
    require(downhill.shape == surface.points.shape, f"downhill {downhill.shape}", str(surface.points.shape))
    if len(surface.points) == 0:
        return surface, 0.0
    low, high = np.percentile(surface.points[:, 2], [2, 98])
    expected, replaced = falling_share(
        surface.points, downhill, surface.velocities, kind=kind, top=high + entry * (high - low), gravity=gravity
    )
    steep = -downhill[:, 2] > 0.5
    share = float(replaced[steep].mean()) if steep.any() else 0.0
    velocities = np.where(replaced[:, None], expected, surface.velocities)
    return SurfaceMotion(surface.points, velocities, surface.observed & ~replaced), share
