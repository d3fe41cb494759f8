"""Where the surface of a liquid lies, from its particles, to a few hundredths of a cell.

The volume of the particles, shared among cells by trilinear weights and smoothed by one binomial filter, is the share
F of liquid around each cell centre: a blur of the liquid's shape with variance s^2 = 2/3 h^2. Near a flat surface
F = (1 + erf(-d / (sqrt(2) s))) / 2, which gives the distance d; where the surface is curved the blur has moved it by
s^2 / 2 times the sum of its principal curvatures, which is taken back. Volumes count, so particles may be of any mass.

Inside solids there are no particles. There the liquid is continued by its distance, linear along the wall, so that a
level surface stays level up to a sloping bed, and this virtual liquid counts in F (a kind of the extension of the
liquid into the solid of Batty, Bertails and Bridson 2007). The sides of the box mirror the liquid.

Chosen by measurement over averaged spheres (Zhu and Bridson 2005), whose surface is three times as noisy and lies up to
0.1 cells too low; see `docs/simulator.md`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from numba import njit, prange

from fluidlift.errors import require
from fluidlift.numerics.signed_distance import distance_and_gradient
from fluidlift.physics.boundaries import Walls
from fluidlift.physics.transfer import CellOrder, deposit_to_cells
from fluidlift.types import CellType, Grid

VARIANCE = 2.0 / 3.0
"""cells^2: 1/6 of the trilinear kernel and 1/2 of the binomial filter"""
BAND = 1.5
"""cells: farther from the surface the distance is not known, and has this size"""
LARGEST_CURVATURE = 1.0
"""1 / cells: a drop of two cells across"""
ROUNDS = 2
"""how often the virtual liquid in the solid is improved; the rest of its error is some hundredths of a cell"""
RELAXATION = 1.5
"""of the virtual liquid: its fixed-point iteration converges from one side"""
LEAST_DEPTH = 0.1
"""cells: liquid cells have their centre at least this deep inside the liquid"""
SKIN = 0.75
"""cells: how far above the surface the centre of a partly filled cell at the surface can lie (its corner is wet)"""
SMALLEST_GAP = 0.05
"""cells: nearer surfaces are put there (conditioning)"""


@dataclass(frozen=True)
class SolidShares:
    """How much of the smoothing kernel of each cell is solid, and where liquid behind the wall is looked for."""

    open_share: Float[np.ndarray, "nx ny nz"]
    """share (0 to 1) of the trilinear kernel around each cell centre that is not solid"""
    layer: UInt8[np.ndarray, "nx ny nz"]
    """0: open; 1: mostly open; 2: more solid, beside one of 0 or 1; 3: beside one of 2; 4: deep in the solid"""


@dataclass(frozen=True)
class LiquidSurface:
    """The surface of the liquid at cell centres."""

    distance: Float[np.ndarray, "nx ny nz"]
    """m, negative inside the liquid, within `BAND` cells of the surface; continued into solids"""
    curvature: Float[np.ndarray, "nx ny nz"]
    """1/m, sum of the principal curvatures (2 / R for a drop), 0 away from the surface"""


@njit(parallel=True, cache=True)
def _open_shares(nodes, low, h, out):
    """Each sample stands for a box half a cell wide; it is cut by the plane nearest to it."""
    nx, ny, nz = out.shape
    inverse = 1.0 / h
    for i_ in prange(nx):
        i = np.int64(i_)
        for j in range(ny):
            for k in range(nz):
                x, y, z = low[0] + (i + 0.5) * h, low[1] + (j + 0.5) * h, low[2] + (k + 0.5) * h
                value, gx, gy, gz = distance_and_gradient(nodes, low, inverse, x, y, z)
                if value > 2.0 * h:
                    out[i, j, k] = 1.0
                    continue
                if value < -2.0 * h:
                    out[i, j, k] = 0.0
                    continue
                total = 0.0
                for a in range(4):
                    fx = 0.5 * a - 0.75
                    # beyond the sides of the box its mirror image
                    px = nx - abs(nx - abs(i + 0.5 + fx))
                    for b in range(4):
                        fy = 0.5 * b - 0.75
                        py = ny - abs(ny - abs(j + 0.5 + fy))
                        for c in range(4):
                            fz = 0.5 * c - 0.75
                            pz = nz - abs(nz - abs(k + 0.5 + fz))
                            weight = 0.125 * (1.0 - abs(fx)) * (1.0 - abs(fy)) * (1.0 - abs(fz))
                            value, gx, gy, gz = distance_and_gradient(
                                nodes, low, inverse, low[0] + px * h, low[1] + py * h, low[2] + pz * h
                            )
                            total += weight * min(max(0.5 + value / (0.6 * h), 0.0), 1.0)
                out[i, j, k] = total


def solid_shares(signed_distance: Float[np.ndarray, "nx+1 ny+1 nz+1"], grid: Grid) -> SolidShares:
    """Prepare the search for the surface; once for static solids, again whenever they have moved.

    Args:
        signed_distance: m, at the nodes, positive outside the solid.
        grid: of the simulation.

    Raises:
        ValueError: a distance of the wrong shape.
    """
    nodes = np.ascontiguousarray(signed_distance, np.float32)
    require(nodes.shape == tuple(n + 1 for n in grid.shape), f"distance {nodes.shape}", "one value per node")
    share = np.empty(grid.shape, np.float32)
    _open_shares(nodes, grid.low, grid.spacing, share)
    layer = np.full(grid.shape, 4, np.uint8)
    layer[_touches(_touches(share > 0.5))] = 3
    layer[_touches(share > 0.5)] = 2
    layer[share > 0.5] = 1
    layer[share > 0.999] = 0
    return SolidShares(share, layer)


def _touches(mask: np.ndarray) -> np.ndarray:
    """Cells in the mask or beside it, corners included."""
    for axis in range(3):
        wide = np.moveaxis(np.pad(mask, 1), axis, 0)
        mask = np.moveaxis(wide[:-2] | wide[1:-1] | wide[2:], 0, axis)
        inner = [slice(1, -1)] * 3
        inner[axis] = slice(None)
        mask = mask[tuple(inner)]
    return mask


@njit(parallel=True, cache=True)
def _binomial(field, out):
    """Weights 1, 2, 1 over 4 along each axis; the outermost cells are repeated (mirrored)."""
    nx, ny, nz = field.shape
    for i_ in prange(nx):
        i = np.int64(i_)
        a, b = max(i - 1, 0), min(i + 1, nx - 1)
        plane = np.empty((ny, nz), np.float32)
        for j in range(ny):
            for k in range(nz):
                plane[j, k] = field[a, j, k] + 2.0 * field[i, j, k] + field[b, j, k]
        for j in range(ny):
            c, d = max(j - 1, 0), min(j + 1, ny - 1)
            before = plane[c, 0] + 2.0 * plane[j, 0] + plane[d, 0]
            here = before
            for k in range(nz):
                e = min(k + 1, nz - 1)
                after = plane[c, e] + 2.0 * plane[j, e] + plane[d, e]
                out[i, j, k] = (before + 2.0 * here + after) / 64.0
                before, here = here, after


@njit(cache=True)
def _inverse_error_function(x):
    """Giles 2012, "Approximating the erfinv function", single precision."""
    w = -np.log((1.0 - x) * (1.0 + x))
    if w < 5.0:
        w -= 2.5
        p = 2.81022636e-08
        p = 3.43273939e-07 + p * w
        p = -3.5233877e-06 + p * w
        p = -4.39150654e-06 + p * w
        p = 0.00021858087 + p * w
        p = -0.00125372503 + p * w
        p = -0.00417768164 + p * w
        p = 0.246640727 + p * w
        p = 1.50140941 + p * w
    else:
        w = np.sqrt(w) - 3.0
        p = -0.000200214257
        p = 0.000100950558 + p * w
        p = 0.00134934322 + p * w
        p = -0.00367342844 + p * w
        p = 0.00573950773 + p * w
        p = -0.0076224613 + p * w
        p = 0.00943887047 + p * w
        p = 1.00167406 + p * w
        p = 2.83297682 + p * w
    return p * x


@njit(cache=True)
def _flat_distance(fill):
    """Cells from the surface, were it flat; within 2 cells."""
    if fill < 0.0072:  # the share at 2 cells
        return 2.0
    if fill > 0.9928:
        return -2.0
    return -np.sqrt(2.0 * VARIANCE) * _inverse_error_function(2.0 * fill - 1.0)


@njit(cache=True)
def _slopes(field, i, j, k):
    """Central differences per cell, mirrored at the border."""
    nx, ny, nz = field.shape
    x = 0.5 * (field[min(i + 1, nx - 1), j, k] - field[max(i - 1, 0), j, k])
    y = 0.5 * (field[i, min(j + 1, ny - 1), k] - field[i, max(j - 1, 0), k])
    z = 0.5 * (field[i, j, min(k + 1, nz - 1)] - field[i, j, max(k - 1, 0)])
    return x, y, z


@njit(cache=True)
def _outward(fill, i, j, k):
    """Unit normal of the surface, out of the liquid; shorter where the fill hardly changes."""
    x, y, z = _slopes(fill, i, j, k)
    scale = -1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-3)
    return scale * x, scale * y, scale * z


@njit(parallel=True, cache=True)
def _continue_into_solid(layer, want, open_share, fill, distance, normal):
    """Distance and normal in the cells of one layer, by linear extrapolation from the layers before it."""
    nx, ny, nz = fill.shape
    for i_ in prange(nx):
        i = np.int64(i_)
        for j in range(ny):
            for k in range(nz):
                if layer[i, j, k] != want:
                    continue
                if want == 1:
                    distance[i, j, k] = _flat_distance(fill[i, j, k])
                    x, y, z = _outward(fill, i, j, k)
                    normal[i, j, k, 0], normal[i, j, k, 1], normal[i, j, k, 2] = x, y, z
                    continue
                total, weights, sx, sy, sz = 0.0, 0.0, 0.0, 0.0, 0.0
                for a in range(max(i - 1, 0), min(i + 2, nx)):
                    for b in range(max(j - 1, 0), min(j + 2, ny)):
                        for c in range(max(k - 1, 0), min(k + 2, nz)):
                            if layer[a, b, c] >= want:
                                continue
                            if layer[a, b, c] == 0:
                                d = _flat_distance(fill[a, b, c])
                                x, y, z = _outward(fill, a, b, c)
                            else:
                                d = np.float64(distance[a, b, c])
                                x, y, z = normal[a, b, c, 0], normal[a, b, c, 1], normal[a, b, c, 2]
                            weight = open_share[a, b, c] ** 2 if want == 2 else 1.0
                            weight /= 1.0 + (a - i) ** 2 + (b - j) ** 2 + (c - k) ** 2
                            total += weight * (d + x * (i - a) + y * (j - b) + z * (k - c))
                            sx += weight * x
                            sy += weight * y
                            sz += weight * z
                            weights += weight
                if weights > 0.0:
                    distance[i, j, k] = total / weights
                    normal[i, j, k, 0] = sx / weights
                    normal[i, j, k, 1] = sy / weights
                    normal[i, j, k, 2] = sz / weights


@njit(parallel=True, cache=True)
def _fill_solid(layer, open_share, distance, normal, virtual):
    """Virtual liquid: the share of each cell's solid part that lies below the surface."""
    nx, ny, nz = virtual.shape
    for i_ in prange(nx):
        i = np.int64(i_)
        for j in range(ny):
            for k in range(nz):
                if layer[i, j, k] == 0 or layer[i, j, k] == 4:
                    continue
                # the middle of the solid part: the more of the cell is open, the farther
                x, y, z = _slopes(open_share, i, j, k)
                reach = -0.7 * open_share[i, j, k] / max(np.sqrt(x * x + y * y + z * z), 1e-3)
                d = distance[i, j, k] + reach * (
                    normal[i, j, k, 0] * x + normal[i, j, k, 1] * y + normal[i, j, k, 2] * z
                )
                d = min(max(d, -1.0), 1.0)
                share = 0.5 * (1.0 - d) ** 2 if d > 0.0 else 1.0 - 0.5 * (1.0 + d) ** 2
                old = virtual[i, j, k]
                virtual[i, j, k] = min(max(old + RELAXATION * (share - old), 0.0), 1.0)


@njit(cache=True)
def _curvature_at(f, i, j, k):
    """div(n) per cell with n = -grad f / |grad f| (Goldman 2005, "Curvature formulas for implicit curves and surfaces")."""
    nx, ny, nz = f.shape
    a, b, c, d, e, g = (
        max(i - 1, 0),
        min(i + 1, nx - 1),
        max(j - 1, 0),
        min(j + 1, ny - 1),
        max(k - 1, 0),
        min(k + 1, nz - 1),
    )
    x, y, z = 0.5 * (f[b, j, k] - f[a, j, k]), 0.5 * (f[i, d, k] - f[i, c, k]), 0.5 * (f[i, j, g] - f[i, j, e])
    squared = x * x + y * y + z * z
    if squared < 1e-6:
        return 0.0
    xx = f[b, j, k] - 2.0 * f[i, j, k] + f[a, j, k]
    yy = f[i, d, k] - 2.0 * f[i, j, k] + f[i, c, k]
    zz = f[i, j, g] - 2.0 * f[i, j, k] + f[i, j, e]
    xy = 0.25 * (f[b, d, k] - f[b, c, k] - f[a, d, k] + f[a, c, k])
    xz = 0.25 * (f[b, j, g] - f[b, j, e] - f[a, j, g] + f[a, j, e])
    yz = 0.25 * (f[i, d, g] - f[i, d, e] - f[i, c, g] + f[i, c, e])
    total = (yy + zz) * x * x + (xx + zz) * y * y + (xx + yy) * z * z - 2.0 * (x * y * xy + x * z * xz + y * z * yz)
    return -total / squared**1.5


@njit(parallel=True, cache=True)
def _distance_and_curvature(fill, smooth, distance, curvature):
    """Cells, 1 / cells."""
    nx, ny, nz = fill.shape
    for i_ in prange(nx):
        i = np.int64(i_)
        for j in range(ny):
            for k in range(nz):
                d = _flat_distance(fill[i, j, k])
                bend = 0.0
                if abs(d) < 2.0:
                    bend = _curvature_at(smooth, i, j, k)
                    bend = min(max(bend, -LARGEST_CURVATURE), LARGEST_CURVATURE)
                curvature[i, j, k] = bend
                distance[i, j, k] = min(max(d - 0.5 * VARIANCE * bend, -BAND), BAND)


def liquid_surface(
    positions: Float[np.ndarray, "n 3"],
    volumes: Float[np.ndarray, "n"],
    grid: Grid,
    order: CellOrder,
    solids: SolidShares,
) -> LiquidSurface:
    """The surface around the particles.

    Args:
        positions: m, inside the box.
        volumes: m^3, mass / density of each particle.
        grid: of the simulation.
        order: from `transfer.sort_by_cell`.
        solids: from `solid_shares`.

    Drops and sheets thinner than about a cell do not reach F = 1/2 anywhere and have no surface of their own: their
    distance is positive (see `pressure_cells`).
    """
    require(solids.layer.shape == grid.shape, f"solid shares {solids.layer.shape}", str(grid.shape))
    h = grid.spacing
    distance, curvature = np.full(grid.shape, BAND * h, np.float32), np.zeros(grid.shape, np.float32)
    if not len(positions):
        return LiquidSurface(distance, curvature)
    volume = np.ascontiguousarray(volumes, np.float32)
    box = _box_around(positions, grid)
    share = np.ascontiguousarray(deposit_to_cells(positions, volume, grid, order)[box])
    share /= np.float32(h**3)
    fill = _smooth_fill(share, np.ascontiguousarray(solids.open_share[box]), np.ascontiguousarray(solids.layer[box]))
    once, smooth = np.empty_like(fill), np.empty_like(fill)
    _binomial(fill, once)
    _binomial(once, smooth)
    near, bend = np.empty_like(fill), np.empty_like(fill)
    _distance_and_curvature(fill, smooth, near, bend)
    distance[box], curvature[box] = near * np.float32(h), bend / np.float32(h)
    return LiquidSurface(distance, curvature)


def _box_around(positions: np.ndarray, grid: Grid) -> tuple[slice, ...]:
    """The cells within four cells of the particles."""
    first = np.clip(grid.cell_of(positions.min(axis=0)) - 4, 0, np.asarray(grid.shape) - 1)
    last = np.clip(grid.cell_of(positions.max(axis=0)) + 5, 1, grid.shape)
    return tuple(slice(int(a), int(b)) for a, b in zip(first, last))


def _smooth_fill(share: np.ndarray, open_share: np.ndarray, layer: np.ndarray) -> np.ndarray:
    """Share of liquid around each cell centre, virtual liquid in solids included.

    Args:
        share: volume of liquid deposited in each cell, over the cell's volume.
        open_share: of `SolidShares`.
        layer: of `SolidShares`.
    """
    fill = np.empty_like(share)
    _binomial(share, fill)
    if not layer.any():
        return fill
    around = np.empty_like(share)
    _binomial(open_share, around)
    virtual = np.where((layer > 0) & (around > 0.05), np.minimum(fill / np.maximum(around, 0.05), 1.0), 0.0)
    virtual = virtual.astype(np.float32)
    solid = 1.0 - open_share
    distance, normal = np.zeros_like(share), np.zeros((*share.shape, 3), np.float32)
    for _ in range(ROUNDS):
        _binomial(share + solid * virtual, fill)
        for want in (1, 2, 3):
            _continue_into_solid(layer, want, open_share, fill, distance, normal)
        _fill_solid(layer, open_share, distance, normal, virtual)
    _binomial(share + solid * virtual, fill)
    return fill


def _neighbours(mask: np.ndarray, openings: tuple[np.ndarray, ...]) -> np.ndarray:
    """Cells that are joined with one in the mask through an open face."""
    out = np.zeros(mask.shape, bool)
    for axis, opening in enumerate(openings):
        here, there = np.moveaxis(mask, axis, 0), np.moveaxis(out, axis, 0)
        passable = np.moveaxis(opening, axis, 0)[1:-1] > 0
        there[1:] |= passable & here[:-1]
        there[:-1] |= passable & here[1:]
    return out


def pressure_cells(types, surface, openings, spacing):
    distance = surface.distance
    through = (types == CellType.FLUID) | (types == CellType.INFLOW) | (types == CellType.OUTFLOW)
    inside = through & (distance < 0)
    beside = _neighbours(inside, openings)
    new = types.copy()
    new[(types == CellType.FLUID) & (distance >= 0) & (distance < SKIN * spacing) & beside] = CellType.EMPTY
    new[(types == CellType.EMPTY) & (distance < 0) & beside] = CellType.FLUID
    deepest = np.float32(-LEAST_DEPTH * spacing)
    return new, np.where(new == CellType.FLUID, np.minimum(distance, deepest), distance)


def surface_gaps(distance, types, smallest=None):
    smallest = SMALLEST_GAP if smallest is None else smallest
    liquid, air = types == CellType.FLUID, (types == CellType.EMPTY) & (distance > 0)
    out = []
    for axis in range(3):
        gap = np.ones(tuple(n + (a == axis) for a, n in enumerate(types.shape)), np.float32)
        inner = np.moveaxis(gap, axis, 0)[1:-1]
        d, wet, dry = (np.moveaxis(f, axis, 0) for f in (distance, liquid, air))
        for low, high in ((slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1))):
            surface = wet[low] & dry[high]
            a, b = d[low][surface], d[high][surface]
            inner[surface] = np.clip(a / (a - b), smallest, 1.0)
        out.append(gap)
    return tuple(out)
