"""The surface that particles make, and what a camera sees of it: ray casting on a number density."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import ndimage, special

from fluidlift.numerics.nearest import nearest
from fluidlift.numerics.sampling import sample_centers
from fluidlift.types import Grid, PinholeCamera, triple

HALF = 0.5
"""the surface is where the density has fallen to this share of its value inside"""

BLUR = 1.6
"""standard deviation of the smoothing of the density, in fine cells (half of a cell of the simulation)"""

SPREAD = 0.4
"""standard deviation of what sharing particles out to cells adds, in fine cells"""

ScalarField = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]
"""values at positions in m"""


@dataclass(frozen=True)
class LiquidDensity:
    """A liquid as a density on a grid twice as fine as the simulation's."""

    grid: Grid
    level: Float[np.ndarray, "nx ny nz"]
    """0.5 minus the smoothed share of the rest density: negative inside"""

    def values(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """The level at points (m)."""
        return sample_centers(self.level, self.grid, points)

    def normals(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Unit normals out of the liquid at points (m), by central differences over one fine cell."""
        steps = self.grid.spacing * np.eye(3)
        slope = np.stack([self.values(points + s) - self.values(points - s) for s in steps], axis=-1)
        return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)

    def signed_cells(self, grid: Grid) -> Float[np.ndarray, "nx ny nz"]:
        """Signed distance at the cell centres of `grid` in its cells, clipped to 3; exact to a fraction of a cell.

        Near the surface the level is that of a flat surface smoothed by a Gaussian, which is inverted; elsewhere it
        is the distance to the nearest fine cell of the other side.
        """
        inside = self.level < 0
        away = ndimage.distance_transform_edt(~inside) if inside.any() else np.full(inside.shape, np.inf)
        within = ndimage.distance_transform_edt(inside) if not inside.all() else np.full(inside.shape, np.inf)
        coarse = np.where(inside, 0.5 - within, away - 0.5)
        flat = np.hypot(BLUR, SPREAD) * special.ndtri(np.clip(self.level + HALF, 1e-3, 1 - 1e-3))
        distance = np.where(np.abs(coarse) <= 2, flat, coarse)
        ratio = self.grid.spacing / grid.spacing
        clipped = (np.clip(distance * ratio, -3, 3)).astype(np.float32)
        return sample_centers(clipped, self.grid, grid.centers().reshape(-1, 3)).reshape(grid.shape)


def finer(grid: Grid) -> Grid:
    """Twice the cells along each axis."""
    return Grid(triple(2 * n for n in grid.shape), grid.spacing / 2, grid.origin)


def deposit(points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"], grid: Grid) -> np.ndarray:
    """Sum of the weights of points (m) at cell centres, shared out trilinearly."""
    at = (np.asarray(points, np.float64) - grid.low) / grid.spacing - 0.5
    base = np.floor(at).astype(np.int64)
    local = at - base
    out = np.zeros(grid.cells)
    for corner in np.ndindex(2, 2, 2):
        index = base + corner
        share = np.prod(np.where(np.array(corner) == 1, local, 1 - local), axis=-1) * weights
        inside = ((index >= 0) & (index < np.asarray(grid.shape))).all(axis=-1)
        flat = np.ravel_multi_index(tuple(index[inside].T), grid.shape)
        out += np.bincount(flat, share[inside], grid.cells)
    return out.reshape(grid.shape)


def open_share(solid_distance: Float[np.ndarray, "nx ny nz"], spacing: float) -> Float[np.ndarray, "nx ny nz"]:
    """Share of each cell that is not solid, from the signed distance (m, positive outside) at its centre."""
    return np.clip(0.5 + solid_distance / spacing, 0.0, 1.0)


def body_of(
    positions: Float[np.ndarray, "n 3"],
    volume: float | Float[np.ndarray, " n"],
    grid: Grid,
    opening: Float[np.ndarray, "fx fy fz"],
) -> LiquidDensity:
    """The liquid of particles.

    Args:
        positions: m.
        volume: of one particle or of each, m^3.
        grid: of the simulation; the body lives on `finer(grid)`.
        opening: open share of the cells of `finer(grid)`. The density is taken over the open space alone, so that
            the liquid reaches its walls.
    """
    fine = finer(grid)
    amount = deposit(positions, np.full(len(positions), volume / fine.spacing**3), fine)
    smooth = ndimage.gaussian_filter(amount, BLUR, mode="nearest")
    room = ndimage.gaussian_filter(opening, BLUR, mode="nearest")
    density = smooth / np.maximum(room, 0.25)
    return LiquidDensity(fine, (HALF - np.minimum(density, 1.5)).astype(np.float32))


def box_range(grid: Grid, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Camera depths at which rays of unit camera depth enter and leave the box of a grid (enter > leave: missed)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (grid.low - eye) / rays, (grid.high - eye) / rays
    low, high = np.nanmax(np.minimum(a, b), axis=-1), np.nanmin(np.maximum(a, b), axis=-1)
    return np.maximum(low, 1e-6), high


def first_hit(
    field: ScalarField,
    eye: Float[np.ndarray, "3"],
    rays: Float[np.ndarray, "n 3"],
    start: Float[np.ndarray, " n"],
    stop: Float[np.ndarray, " n"],
    step: float,
) -> Float[np.ndarray, " n"]:
    """Depth of the first point of each ray where the field turns negative; inf where it does not.

    Args:
        field: negative inside the body.
        eye: origin of the rays, m.
        rays: eye + t ray is the point at depth t.
        start: first depth tried.
        stop: last depth.
        step: of the search, in depth (m); the crossing is then found by six bisections.
    """
    hit = np.full(len(rays), np.inf)
    low = np.array(start, float)
    active = np.flatnonzero(start < stop)
    while len(active):
        high = np.minimum(low[active] + step, stop[active])
        inside = field(eye + high[:, None] * rays[active]) < 0
        hit[active[inside]] = high[inside]
        low[active[~inside]] = high[~inside]
        active = active[~inside & (high < stop[active])]
    found = np.flatnonzero(np.isfinite(hit))
    near, far, rays = low[found], hit[found], rays[found]
    for _ in range(6):
        middle = 0.5 * (near + far)
        inside = field(eye + middle[:, None] * rays) < 0
        far, near = np.where(inside, middle, far), np.where(inside, near, middle)
    hit[found] = 0.5 * (near + far)
    return hit


def sphere_trace(
    distance: ScalarField,
    eye: Float[np.ndarray, "3"],
    rays: Float[np.ndarray, "n 3"],
    start: Float[np.ndarray, " n"],
    stop: Float[np.ndarray, " n"],
    *,
    tolerance: float,
    safety: float = 0.6,
) -> Float[np.ndarray, " n"]:
    """Depth where each ray meets a body; inf where it does not (Hart 1996).

    Args:
        distance: m, positive outside; may overrate the true distance by up to 1 / `safety`.
        eye: origin of the rays, m.
        rays: eye + t ray is the point at depth t.
        start: first depth.
        stop: last depth.
        tolerance: m, from the surface, at which a ray has arrived.
        safety: share of the distance that is stepped.
    """
    depth = np.array(start, float)
    hit = np.full(len(rays), np.inf)
    length = np.linalg.norm(rays, axis=-1)
    active = np.flatnonzero(start < stop)
    while len(active):
        left = distance(eye + depth[active, None] * rays[active])
        arrived = left < tolerance
        hit[active[arrived]] = depth[active[arrived]]
        active, left = active[~arrived], left[~arrived]
        depth[active] += np.maximum(safety * left, tolerance) / length[active]
        active = active[depth[active] < stop[active]]
    return hit


def see(
    body: LiquidDensity,
    camera: PinholeCamera,
    uv: Float[np.ndarray, "n 2"],
    wall: Float[np.ndarray, " n"],
    region: Grid | None = None,
) -> Float[np.ndarray, " n"]:
    """Camera depth of the liquid at picture positions, inf where a solid (at depth `wall`) comes first or none is."""
    eye, rays = camera.position, camera.rays(uv)
    start, stop = box_range(region or body.grid, eye, rays)
    length = float(np.linalg.norm(rays, axis=-1).max())
    return first_hit(body.values, eye, rays, start, np.minimum(stop, wall), 0.9 * body.grid.spacing / length)


@dataclass(frozen=True)
class Neighbours:
    """Weighted nearest particles of some points."""

    index: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(
        cls, points: Float[np.ndarray, "n 3"], particles: Float[np.ndarray, "m 3"], radius: float, count: int = 8
    ) -> Neighbours:
        """Gaussian weights of width `radius` (m) over the `count` nearest particles, which sum to 1."""
        distance, index = nearest(particles, points, min(count, len(particles)))
        distance, index = distance.reshape(len(points), -1), index.reshape(len(points), -1)
        weight = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / radius**2)
        return cls(index, weight / weight.sum(axis=1, keepdims=True))

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Means [n,...] of values [m,...] of the particles."""
        chosen = values[self.index]
        return (chosen * self.weight.reshape(*self.weight.shape, *[1] * (values.ndim - 1))).sum(axis=1)
