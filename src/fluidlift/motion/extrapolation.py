"""Extrapolation (harmonic or layered) from samples of the surface to every cell of the fluid."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from fluidlift.motion.volume_projection import cells_of_faces, sides_of_faces
from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.types import CellType, Grid, SurfaceMotion, Terrain, triple

FILLED_WEIGHT = 0.25
"""weight of a surface sample that the mainstream filled in, beside 1 for an observed one"""
SNAP_CELLS = 3.0
"""samples further than so many cells from any fluid are left out"""

NearestCells = tuple[Float[np.ndarray, "nx ny nz"], Int[np.ndarray, "3 nx ny nz"]]


def nearest_cells(carrying: Bool[np.ndarray, "nx ny nz"]) -> NearestCells:
    """Distance (cells) from each cell to the nearest that carries fluid, and which that is."""
    distance, index = ndimage.distance_transform_edt(~carrying, return_indices=True)
    return distance, index


def splat_samples(
    points: Float[np.ndarray, "n 3"],
    fields: Float[np.ndarray, "n c"],
    weight: Float[np.ndarray, " n"],
    carrying: Bool[np.ndarray, "nx ny nz"],
    grid: Grid,
    *,
    nearest: NearestCells | None = None,
) -> tuple[Float[np.ndarray, "nx ny nz c"], Bool[np.ndarray, "nx ny nz"]]:
    """Weighted mean of the samples on the fluid cells nearest to them, and which cells got one.

    Each sample goes to its own cell, or the nearest that carries fluid. Then a Gaussian of 0.7 cells evens out the
    cells that were hit (it adds no others: the surface is one cell thick).

    Args:
        points: places of the samples, m.
        fields: what they carry.
        weight: of each sample, positive.
        carrying: cells that hold fluid.
        grid: of the cells.
        nearest: `nearest_cells(carrying)`, where it is known already.
    """
    cells = np.clip(grid.cell_of(points), 0, np.asarray(grid.shape) - 1)
    distance, index = nearest_cells(carrying) if nearest is None else nearest
    at = tuple(cells.T)
    outside = np.abs(points - np.clip(points, grid.low, grid.high)).max(axis=-1) / grid.spacing
    near = (distance[at] <= SNAP_CELLS) & (outside <= SNAP_CELLS)
    target = np.ravel_multi_index(tuple(n[at][near] for n in index), grid.shape)
    weight = weight[near]
    sums = [np.bincount(target, weight, grid.cells).reshape(grid.shape)]
    sums += [np.bincount(target, weight * f, grid.cells).reshape(grid.shape) for f in fields[near].T]
    seen = sums[0] > 0
    # each hit cell counts by how well it was hit, but a near, finely sampled bank must not outvote the rest
    share = np.where(seen, 1.0 / np.maximum(sums[0], 1e-12), 0.0) * np.minimum(sums[0], 1.0)
    total, *parts = (ndimage.gaussian_filter(s * share, 0.7, mode="constant", truncate=2.0) for s in sums)
    values = np.stack(parts, axis=-1) / np.maximum(total, 1e-12)[..., None]
    return np.where(seen[..., None], values, 0.0).astype(np.float32), seen


def splat_surface(
    surface: SurfaceMotion, carrying: Bool[np.ndarray, "nx ny nz"], grid: Grid
) -> tuple[Float[np.ndarray, "nx ny nz 3"], Bool[np.ndarray, "nx ny nz"]]:
    """Velocity (m/s) of the fluid cells that samples of the surface fall on, and which those are; see `splat_samples`.

    Samples that the mainstream filled in count by `FILLED_WEIGHT`.
    """
    return splat_samples(surface.points, surface.velocities, sample_weight(surface), carrying, grid)


def sample_weight(surface: SurfaceMotion) -> Float[np.ndarray, " n"]:
    """1 for observed samples, `FILLED_WEIGHT` for those that were filled in."""
    return np.where(surface.observed, 1.0, FILLED_WEIGHT)


def harmonic_extension(
    values: Float[np.ndarray, "nx ny nz c"],
    known: Bool[np.ndarray, "nx ny nz"],
    domain: Bool[np.ndarray, "nx ny nz"],
    spacing: float,
    *,
    tolerance: float = 1e-4,
) -> Float[np.ndarray, "nx ny nz c"]:
    """The smoothest continuation: laplace f = 0 in the domain, f = values where known, no flux through its rim.

    Fluctuations of the surface of wavelength L die out over a depth L / 2 pi, as they do below waves; the mean stays.
    Parts of the domain that no known cell touches take the mean of the known values.

    Args:
        values: where known.
        known: see values.
        domain: where to continue to.
        spacing: cell width, m.
        tolerance: relative residual.
    """
    known = known & domain
    label, count = ndimage.label(domain)
    touched = np.zeros(count + 1, bool)
    touched[np.unique(label[known])] = True
    unknown = domain & ~known & touched[label]
    out = np.where(known[..., None], values, 0.0).astype(np.float32)
    weights = []
    for axis in range(3):
        low, high = sides_of_faces(domain, axis)
        weights.append((low & high).astype(np.float32))
    system = PoissonSystem(unknown, *triple(weights), spacing).prepared()  # one hierarchy for all components
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    first_guess = out[tuple(nearest)]
    for c in range(values.shape[-1]):
        rhs = np.zeros(domain.shape, np.float32)
        for axis, w in enumerate(weights):
            low, high = sides_of_faces(out[..., c], axis)
            rhs += cells_of_faces(w * low, axis, low=True) + cells_of_faces(w * high, axis, low=False)
        guess = np.where(unknown, first_guess[..., c], 0.0).astype(np.float32)
        f, _ = solve(system, np.where(unknown, rhs, 0.0) / spacing**2, tolerance=tolerance, initial=guess)
        out[..., c] = np.where(unknown, f, out[..., c])
    adrift = domain & ~touched[label]
    if adrift.any() and known.any():
        out[adrift] = values[known].mean(axis=0)
    return out


def layered_extension(
    free: Float[np.ndarray, "nx ny nz 3"],
    seen: Bool[np.ndarray, "nx ny nz"],
    share: Float[np.ndarray, "nx ny nz"],
    mainstream: Float[np.ndarray, "3"] | None = None,
) -> Float[np.ndarray, "nx ny nz 3"]:
    """The velocity of the free stream under a layer at the walls, as turbulent flow has it.

    Beside a wall the fluid has a share of the speed of the free stream there, and turns from its direction to that of
    the mainstream as the share falls (paper: V_base "takes the direction of the mainstream"). Cells that were seen keep
    what was seen.

    Args:
        free: velocity without walls, m/s, from `harmonic_extension` of the surface.
        seen: cells of the surface.
        share: of the free speed in each cell, 0 to 1, from the wall profile.
        mainstream: unit direction of the bulk flow; None: no turn.
    """
    share = share[..., None]
    turned = free
    if mainstream is not None:
        speed = np.linalg.norm(free, axis=-1, keepdims=True)
        turned = share * free + (1.0 - share) * speed * np.asarray(mainstream)
    return np.where(seen[..., None], free, share * turned).astype(np.float32)


def wall_distance(
    types: UInt8[np.ndarray, "nx ny nz"], terrain: Terrain | None, grid: Grid
) -> Float[np.ndarray, "nx ny nz"]:
    """Distance (m) of the cells' centres to the solid, half a cell at least: nearer cells are cut and hold more fluid
    further out. Without a terrain the solid consists of whole cells."""
    if terrain is None:
        solid = types == CellType.SOLID
        if not solid.any():
            return np.full(grid.shape, np.inf)
        distance = (ndimage.distance_transform_edt(~solid) - 0.5) * grid.spacing
    else:
        at_nodes = terrain.signed_distance
        nx, ny, nz = grid.shape
        corners = [at_nodes[a : a + nx, b : b + ny, c : c + nz] for a in (0, 1) for b in (0, 1) for c in (0, 1)]
        distance = sum(corners[1:], corners[0]) / 8.0
    return np.maximum(distance, 0.5 * grid.spacing)
