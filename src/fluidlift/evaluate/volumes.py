"""Figures on volumes: occupancy, surfaces, velocities, parameters. Pure functions on arrays."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.numerics.nearest import nearest
from fluidlift.types import FaceVelocity, Grid, PinholeCamera, Similarity3, triple


def align_cameras(truth: PinholeCamera, other: PinholeCamera, scale: float) -> Similarity3:
    """truth_from_other: the camera axes of both worlds are laid on each other, lengths grow by `scale` about the eye.

    A single view fixes a scene up to exactly this one factor, so it must not be scored. Velocities are scaled with
    the lengths; gravity too, kinematic viscosity with the square.
    """
    t, o = truth.camera_from_world, other.camera_from_world
    rotation = t.rotation.T @ o.rotation
    return Similarity3(scale, rotation, t.rotation.T @ (scale * o.translation - t.translation))


def in_picture(points: Float[np.ndarray, "*n 3"], camera: PinholeCamera) -> Bool[np.ndarray, "*n"]:
    """Points (world, m) before the camera and inside its picture."""
    uv, z = camera.project(points)
    w, h = camera.size
    return (z > 0) & (uv[..., 0] >= 0) & (uv[..., 0] < w) & (uv[..., 1] >= 0) & (uv[..., 1] < h)


def behind(
    points: Float[np.ndarray, "*n 3"], depth: Float[np.ndarray, "h w"], camera: PinholeCamera, margin: float
) -> Bool[np.ndarray, "*n"]:
    """Points (world, m) in the picture that lie more than `margin` m behind a depth map (camera z, m; 0 = none)."""
    uv, z = camera.project(points)
    w, h = camera.size
    column = np.clip(uv[..., 0], 0, w - 1).astype(np.int64)
    row = np.clip(uv[..., 1], 0, h - 1).astype(np.int64)
    wall = depth[row, column].astype(np.float64)
    return in_picture(points, camera) & (wall > 0) & (z > wall + margin)


def lookup(
    values: np.ndarray, grid: Grid, points: Float[np.ndarray, "*n 3"], outside: float | bool | int = 0
) -> np.ndarray:
    """The value of the cell that each point lies in; `outside` beyond the grid."""
    require(values.shape == grid.shape, f"cell values {values.shape}", str(grid.shape))
    index = grid.cell_of(points)
    inside = np.all((index >= 0) & (index < np.asarray(grid.shape)), axis=-1)
    i = np.where(inside[..., None], index, 0)
    return np.where(inside, values[i[..., 0], i[..., 1], i[..., 2]], outside)


def sample_cells(
    velocity: FaceVelocity, fluid: Bool[np.ndarray, "nx ny nz"], grid: Grid, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Velocity (m/s) at points: trilinear between the centres of fluid cells alone, so that still air does not slow it.

    0 where no neighbour is fluid.
    """
    at = ((np.asarray(points) - grid.low) / grid.spacing - 0.5).T

    def linear(field: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(field.astype(np.float64), at, order=1, mode="grid-constant")

    weight = linear(fluid)
    values = velocity.at_centers() * fluid[..., None]
    sums = [
        ndimage.map_coordinates(values[..., a].astype(np.float64), at, order=1, mode="grid-constant") for a in range(3)
    ]
    return np.where(weight[:, None] > 1e-6, np.stack(sums, -1) / np.maximum(weight, 1e-6)[:, None], 0.0)


def occupancy_iou(
    occupied: Bool[np.ndarray, " n"],
    truth: Bool[np.ndarray, " n"],
    ignored: Bool[np.ndarray, " n"],
    stray: float = 0.0,
) -> float | None:
    """Intersection over union of two sets of equal cells without the `ignored`; `stray` cells count as wrong."""
    both = float((occupied & truth & ~ignored).sum())
    either = float(((occupied | truth) & ~ignored).sum()) + stray
    return both / either if either > 0 else None


def level_set_points(phi: Float[np.ndarray, "nx ny nz"], grid: Grid) -> Float[np.ndarray, "n 3"]:
    """Where a cell-centred level set crosses 0 between neighbouring centres (linear), m.

    Where the body runs out of the grid it ends at the grid's side.
    """
    phi = np.pad(np.asarray(phi, np.float64), 1, mode="edge")
    for axis in range(3):
        line = np.moveaxis(phi, axis, 0)
        line[0], line[-1] = np.where(line[1] < 0, -line[1], line[0]), np.where(line[-2] < 0, -line[-2], line[-1])
    wide = triple(n + 2 for n in grid.shape)
    centers = Grid(wide, grid.spacing, triple(grid.low - grid.spacing)).centers()
    found = []
    for axis in range(3):
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        a, b = phi[tuple(low)], phi[tuple(high)]
        cross = (a < 0) != (b < 0)
        t = a[cross] / (a[cross] - b[cross])
        step = np.zeros(3)
        step[axis] = grid.spacing
        found.append(centers[tuple(low)][cross] + t[:, None] * step)
    return np.concatenate(found)


def cell_surface_points(fluid: Bool[np.ndarray, "nx ny nz"], grid: Grid) -> Float[np.ndarray, "n 3"]:
    """Centres of the faces between fluid cells and all others, the border of the grid included, m."""
    padded = np.pad(fluid, 1)
    found = []
    for axis in range(3):
        crop = [slice(1, -1)] * 3
        crop[axis] = slice(None)
        line = np.moveaxis(padded[tuple(crop)], axis, 0)
        cross = np.moveaxis(line[1:] != line[:-1], 0, axis)
        found.append(grid.faces(axis)[cross])
    return np.concatenate(found)


def mean_nearest(points: Float[np.ndarray, "n 3"], others: Float[np.ndarray, "m 3"]) -> float | None:
    """Mean distance (m) from each point to the nearest of the others: half of the Chamfer distance."""
    if len(points) == 0 or len(others) == 0:
        return None
    return float(nearest(others, points)[0].mean())


def relative_l2(values: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "n 3"]) -> float | None:
    """|values - truth| / |truth| over all vectors; a field at rest scores 1."""
    norm = float(np.linalg.norm(truth))
    return float(np.linalg.norm(values - truth)) / norm if norm > 0 else None


def field_cosine(values: Float[np.ndarray, "*n 3"], truth: Float[np.ndarray, "*n 3"]) -> float | None:
    """Inner product of two fields over the product of their norms; 0 for a field at rest, None for a truth at rest."""
    a, b = float(np.linalg.norm(values)), float(np.linalg.norm(truth))
    if b == 0:
        return None
    return float((values * truth).sum()) / (a * b) if a > 0 else 0.0


def relative_divergence(
    divergence: Float[np.ndarray, "nx ny nz"], velocity: FaceVelocity, fluid: Bool[np.ndarray, "nx ny nz"], dx: float
) -> tuple[float, float] | None:
    """Max and mean of |div v| dx / mean speed over the fluid cells (`divergence` in 1/s, `dx` in m)."""
    if not fluid.any():
        return None
    speed = float(np.linalg.norm(velocity.at_centers()[fluid], axis=-1).mean())
    if speed == 0:
        return None
    scaled = np.abs(divergence[fluid]) * dx / speed
    return float(scaled.max()), float(scaled.mean())


def within(value: float, truth: float, sigma: float, sigmas: float = 2.0) -> bool:
    """Whether the truth lies inside the reported uncertainty."""
    return abs(value - truth) <= sigmas * sigma
