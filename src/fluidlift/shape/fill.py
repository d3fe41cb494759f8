"""Fills a hollow body with Gaussians by the parity of random rays (paper: filling before the simulation).

Generated Gaussians lie on surfaces. A point is inside if most rays from it cross the hull an odd number of times. The
hull is found on a grid: voxels where the field of opacities (PhysGaussian, 3.7) exceeds a threshold. A crossing is one
run of hull voxels along the ray, so that thick and thin walls count once. Holes cost single rays, the majority holds.

Bounded on any input: radii are clamped to a few voxels, outliers do not widen the grid, and the voxels grow until the
grid fits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require, required
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.numerics.sharing import shared
from fluidlift.shape.prune import body_size
from fluidlift.types import triple
from fluidlift.types.gaussians import Gaussians
from fluidlift.types.grid import Grid
from fluidlift.types.terrain import Terrain
from fluidlift.types.transforms import matrix_from_quat

CELLS_MAX = 4_000_000
"""voxels of the hull at most (256 x 125 x 125); a ray then crosses a few hundred"""

THRESHOLD = 0.25
"""opacity field above which a voxel belongs to the hull"""

RADIUS_MAX = 12
"""voxels that a Gaussian reaches at most in the field"""

WIDE = 0.1
"""share of the size of the body above which a Gaussian is no piece of its surface: only its centre counts then. A few
huge ones would swell the hull by `RADIUS_MAX`"""

WORK_MAX = 200_000_000
"""visits of voxels by Gaussians at most; radii shrink until they fit"""

EVENED = 2.0
"""voxels, standard deviation over which colours of what is filled are averaged: a cell of the simulation"""

CHUNK = 500_000
"""Gaussians whose matrices are made at a time"""

_EMPTY, _HULL, _SOLID = np.uint8(0), np.uint8(1), np.uint8(2)


@dataclass(frozen=True)
class Hull:
    """Which voxels the Gaussians (1) and the terrain (2) occupy."""

    grid: Grid
    voxels: UInt8[np.ndarray, "nx ny nz"]


@nb.njit(cache=True)
def _splat_field(low, spacing, means, precisions, opacities, reach, field):
    """Sum of opacity x exp(-d^T P d / 2) at the voxel centres near every Gaussian."""
    nx, ny, nz = field.shape
    for n in range(means.shape[0]):
        x, y, z = means[n, 0] - low[0], means[n, 1] - low[1], means[n, 2] - low[2]
        i, j, k = int(math.floor(x / spacing)), int(math.floor(y / spacing)), int(math.floor(z / spacing))
        r = reach[n]
        for a in range(max(0, i - r), min(nx, i + r + 1)):
            dx = (a + 0.5) * spacing - x
            for b in range(max(0, j - r), min(ny, j + r + 1)):
                dy = (b + 0.5) * spacing - y
                for c in range(max(0, k - r), min(nz, k + r + 1)):
                    dz = (c + 0.5) * spacing - z
                    q = dx * (precisions[n, 0] * dx + 2 * (precisions[n, 1] * dy + precisions[n, 2] * dz))
                    q += dy * (precisions[n, 3] * dy + 2 * precisions[n, 4] * dz) + precisions[n, 5] * dz * dz
                    if q < 12.0:
                        field[a, b, c] += opacities[n] * math.exp(-0.5 * q)


@shared(lambda voxels, starts, *_: (0, starts.shape[0]))
def _odd_rays(begin, end, voxels, starts, directions, rays, odd):
    """How many of the rays from each start (voxel units) cross the hull an odd number of times, until that is decided.

    A ray is mirrored where it meets the face of a terrain voxel: a surface over a bed is closed by its mirror image.
    """
    shape = voxels.shape
    limit = 2 * (shape[0] + shape[1] + shape[2])
    for n in range(begin, end):
        count = 0
        for r in range(rays):
            m = (n * rays + r) % directions.shape[0]
            d0, d1, d2 = directions[m, 0], directions[m, 1], directions[m, 2]
            x, y, z = starts[n, 0], starts[n, 1], starts[n, 2]
            i, j, k = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
            # lengths along the ray to the next face across each axis, and between faces (Amanatides and Woo 1987)
            e0, e1, e2 = abs(1.0 / d0), abs(1.0 / d1), abs(1.0 / d2)
            s0, s1, s2 = (1 if d0 > 0 else -1), (1 if d1 > 0 else -1), (1 if d2 > 0 else -1)
            t0 = e0 * ((i + 1 - x) if d0 > 0 else (x - i))
            t1 = e1 * ((j + 1 - y) if d1 > 0 else (y - j))
            t2 = e2 * ((k + 1 - z) if d2 > 0 else (z - k))
            runs, before = 0, False
            for _ in range(limit):
                a, b, c = i, j, k
                if t0 <= t1 and t0 <= t2:
                    a += s0
                    t0 += e0
                elif t1 <= t2:
                    b += s1
                    t1 += e1
                else:
                    c += s2
                    t2 += e2
                if a < 0 or a >= shape[0] or b < 0 or b >= shape[1] or c < 0 or c >= shape[2]:
                    break
                if voxels[a, b, c] == _SOLID:  # mirrored: the way to the next face stays as long
                    s0, s1, s2 = (-s0 if a != i else s0), (-s1 if b != j else s1), (-s2 if c != k else s2)
                    continue
                i, j, k = a, b, c
                hull = voxels[i, j, k] == _HULL
                runs += 1 if hull and not before else 0
                before = hull
            count += runs % 2
            if 2 * count > rays or 2 * (count + rays - 1 - r) <= rays:
                break  # the others cannot turn the vote
        odd[n] = count


def hull(gaussians: Gaussians, *, spacing: float, closed_below: Terrain | None = None) -> Hull:
    """Voxelise a body.

    A Gaussian counts as at least half a voxel wide, and fainter in return, so that the hull of a surface does not swell
    with the number of its Gaussians; its own voxel is hull in any case. Gaps of one voxel are closed.

    Args:
        gaussians: any Gaussians; those with non-finite numbers or hardly any opacity are left out.
        spacing: m; larger voxels are used where the grid would exceed `CELLS_MAX`.
        closed_below: terrain under the body.
    """
    require(math.isfinite(spacing) and spacing > 0, f"spacing {spacing}", "positive metres")
    g = gaussians
    sound = np.isfinite(g.means).all(1) & np.isfinite(g.scales).all(1) & np.isfinite(g.quats).all(1)
    g = g.select(sound & (g.opacities > 0.02) & (np.abs(g.means) < 1e6).all(1))
    if len(g) == 0:
        return Hull(Grid((1, 1, 1), spacing), np.zeros((1, 1, 1), np.uint8))
    grid = _hull_grid(g.means, spacing, closed_below)
    scales = np.clip(g.scales, 0.5 * grid.spacing, RADIUS_MAX / 3.46 * grid.spacing)
    scales[g.scales.max(1) > max(WIDE * body_size(g.means), grid.spacing)] = 0.5 * grid.spacing
    reach = np.ceil(3.46 * scales.max(1) / grid.spacing).astype(np.int64)
    while ((2 * reach + 1.0) ** 3).sum() > WORK_MAX and reach.max() > 2:
        reach = np.minimum(reach, reach.max() - 1)
    scales = np.minimum(scales, np.maximum(reach / 3.46, 0.5)[:, None] * grid.spacing)
    ordered = np.sort(g.scales, axis=1)
    spread = np.minimum(ordered[:, 1] * ordered[:, 2] / (0.5 * grid.spacing) ** 2, 1.0)
    field = np.zeros(grid.shape, np.float32)
    for first in range(0, len(g), CHUNK):  # matrices in double precision of ten million would take gigabytes
        part = slice(first, first + CHUNK)
        axes = matrix_from_quat(g.quats[part]) / scales[part, None, :]
        p = axes @ np.swapaxes(axes, 1, 2)
        precisions = np.ascontiguousarray(p[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], dtype=np.float32)
        opacities = np.clip(g.opacities[part], 0, 1) * spread[part]
        _splat_field(grid.low, grid.spacing, g.means[part], precisions, opacities, reach[part], field)
    cells = grid.cell_of(g.means)
    within = ((cells >= 0) & (cells < grid.shape)).all(1)
    np.maximum.at(field, tuple(cells[within].T), g.opacities[within])
    solid = np.pad(field > THRESHOLD, 2)
    solid = ndimage.binary_closing(solid, ndimage.generate_binary_structure(3, 2))[2:-2, 2:-2, 2:-2]
    voxels = solid.astype(np.uint8) * _HULL
    if closed_below is not None:
        centers = grid.centers().reshape(-1, 3)
        distance = sample_nodes(closed_below.signed_distance, closed_below.grid, centers)
        voxels[(distance < 0).reshape(grid.shape)] = _SOLID
    return Hull(grid, voxels)


def _hull_grid(means: np.ndarray, spacing: float, terrain: Terrain | None) -> Grid:
    """A box around all but stray Gaussians, and down into the terrain, with at most `CELLS_MAX` voxels."""
    inner_low, inner_high = np.quantile(means, [0.002, 0.998], axis=0).astype(float)
    slack = 0.25 * (inner_high - inner_low) + spacing
    low = np.maximum(means.min(0), inner_low - slack) - 2 * spacing
    high = np.minimum(means.max(0), inner_high + slack) + 2 * spacing
    if terrain is not None:
        low[2] = min(low[2], terrain.grid.low[2])
    shape = np.maximum(np.ceil((high - low) / spacing), 1)
    while shape.prod() > CELLS_MAX:
        spacing *= max(1.02, (shape.prod() / CELLS_MAX) ** (1 / 3))
        shape = np.maximum(np.ceil((high - low) / spacing), 1)
    return Grid(triple(int(n) for n in shape), spacing, triple(low))


def inside(
    points: Float[np.ndarray, "n 3"],
    gaussians: Gaussians | Hull,
    *,
    spacing: float | None = None,
    rays: int = 12,
    rng: np.random.Generator,
    closed_below: Terrain | None = None,
) -> Bool[np.ndarray, " n"]:
    """Whether points lie inside: in the hull, or most of the rays from them cross the hull an odd number of times.

    Args:
        points: m.
        gaussians: the body, or its hull where it is at hand.
        spacing: voxel of the hull, m; needed with Gaussians.
        rays: random rays per point.
        rng: of their directions.
        closed_below: terrain that closes the body from below.
    """
    require(rays >= 1, f"{rays} rays", "1 or more")
    if isinstance(gaussians, Gaussians):
        voxel = required(spacing, "no spacing", "the voxel of the hull in m")
        gaussians = hull(gaussians, spacing=voxel, closed_below=closed_below)
    grid, voxels = gaussians.grid, gaussians.voxels
    points = np.asarray(points, np.float64)
    out = np.zeros(len(points), bool)
    known = np.flatnonzero(np.isfinite(points).all(1) & grid.contains(points))
    local = (points[known] - grid.low) / grid.spacing
    cell = np.minimum(local.astype(np.int64), np.asarray(grid.shape) - 1)
    here = voxels[tuple(cell.T)]
    out[known] = here == _HULL
    free = here == _EMPTY
    directions = rng.normal(size=(8191, 3))  # a prime number, so that neighbours do not share their rays
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.where(np.abs(directions) < 1e-6, 1e-6, directions)
    odd = np.zeros(int(free.sum()), np.int64)
    _odd_rays(voxels, np.ascontiguousarray(local[free]), directions, rays, odd)
    out[known[free]] = 2 * odd > rays
    return out


def fill(
    gaussians: Gaussians,
    *,
    spacing: float,
    rays: int = 12,
    rng: np.random.Generator,
    max_added: int = 500_000,
    closed_below: Terrain | None = None,
) -> Gaussians:
    """The Gaussians that are missing inside a hollow body: one at the centre of every empty voxel inside.

    Args:
        gaussians: the body, m.
        spacing: of the voxels, m (larger where the grid would exceed `CELLS_MAX`).
        rays: per voxel.
        rng: of the rays.
        max_added: a random choice of this many is made if there are more, wider in return.
        closed_below: terrain that closes the body from below.

    Returns:
        Only those added: round, half a voxel wide, with the opacity of the nearest Gaussian of the body and the colour
        of those around it.
    """
    shell = hull(gaussians, spacing=spacing, closed_below=closed_below)
    grid, voxels = shell.grid, shell.voxels
    sound = np.isfinite(gaussians.means).all(1) & (np.abs(gaussians.means) < 1e6).all(1)
    usable = np.flatnonzero(sound & np.isfinite(gaussians.sh).all((1, 2)))
    cells = grid.cell_of(gaussians.means[usable])
    within = ((cells >= 0) & (cells < grid.shape)).all(1)
    cells, usable = cells[within], usable[within]
    if len(usable) == 0:
        return Gaussians.empty(gaussians.sh.shape[1])
    holder = np.full(grid.shape, -1, np.int64)
    holder[tuple(cells[::-1].T)] = usable[::-1]  # the first of those that share a voxel
    held = holder >= 0

    wanted = np.zeros(grid.shape, bool)
    free = np.argwhere(voxels == _EMPTY)
    free = free[_boxed(voxels == _HULL, free, closed_below is not None)]
    centers = grid.low + (free + 0.5) * grid.spacing
    found = inside(centers, shell, rays=rays, rng=rng)
    wanted[tuple(free[found].T)] = True
    body = wanted | (voxels == _HULL)
    # a voxel found inside by chance stands alone; a hull voxel without a centre is inner if it is surrounded
    wanted &= ndimage.uniform_filter(body.astype(np.float32), 3, mode="constant") > 0.4
    closed = body | (voxels == _SOLID)
    wanted |= (voxels == _HULL) & ndimage.binary_erosion(closed, ndimage.generate_binary_structure(3, 1))
    chosen = np.argwhere(wanted & ~held)
    width = 0.5 * grid.spacing
    if len(chosen) > max_added:
        width *= (len(chosen) / max(max_added, 1)) ** (1 / 3)
        chosen = chosen[np.sort(rng.choice(len(chosen), max_added, replace=False))]
    if len(chosen) == 0:
        return Gaussians.empty(gaussians.sh.shape[1])
    means = (grid.low + (chosen + 0.5) * grid.spacing).astype(np.float32)
    # by the distances of voxels: a search tree visits all of a shell for each point near its centre
    index = ndimage.distance_transform_edt(~held, return_distances=False, return_indices=True)
    nearest = holder[tuple(index[(slice(None), *chosen.T)])]
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1))
    opacities = np.nan_to_num(gaussians.opacities[nearest])
    sh = np.zeros((len(means), *gaussians.sh.shape[1:]), gaussians.sh.dtype)
    sh[:, 0] = _evened(gaussians.select(usable), cells, grid)[tuple(index[(slice(None), *chosen.T)])]
    return Gaussians(means, quats, np.full((len(means), 3), width), opacities, sh)


def _evened(gaussians: Gaussians, cells: np.ndarray, grid: Grid) -> Float[np.ndarray, "nx ny nz 3"]:
    """Mean colour (coefficients of degree 0) around each voxel that holds a Gaussian, by what each of them covers.

    Where splats are optimised together, one may have any colour that its neighbours make up for: alone it says nothing.
    """
    wide = np.clip(np.nan_to_num(gaussians.scales / grid.spacing), 0.0, 1.0)  # a voxel at most: more is not here
    covers = np.nan_to_num(gaussians.opacities) * np.sort(wide, axis=1)[:, 1:].prod(axis=1) + 1e-6
    flat = np.ravel_multi_index(tuple(cells.T), grid.shape)
    values = np.column_stack([covers[:, None] * gaussians.sh[:, 0], covers])
    sums = (np.bincount(flat, v, grid.cells).reshape(grid.shape).astype(np.float32) for v in values.T)
    *colour, total = (ndimage.gaussian_filter(v, EVENED, mode="constant") for v in sums)
    return np.stack(colour, axis=-1) / np.maximum(total, 1e-30)[..., None]


def _boxed(shell: np.ndarray, cells: np.ndarray, open_below: bool) -> Bool[np.ndarray, " n"]:
    """Cells with hull on both sides along some axis, or above them over a bed: the only ones worth any rays."""
    sides = np.zeros(len(cells), np.int64)
    above = np.zeros(len(cells), bool)
    for axis in range(3):
        forth = np.maximum.accumulate(shell, axis=axis)
        back = np.flip(np.maximum.accumulate(np.flip(shell, axis), axis=axis), axis)
        sides += (forth & back)[tuple(cells.T)]
        if axis == 2:
            above = back[tuple(cells.T)]
    return (sides >= 1) | (above & open_below)
