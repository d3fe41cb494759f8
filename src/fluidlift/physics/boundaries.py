"""Boundary conditions: walls (cut cells; free slip to no-slip), liquid cells, extrapolation, particle collisions.

Wall model (paper: b, d). The grid lets no fluid through a wall. `wall_damping` takes its share of the tangential
velocity of particles within one cell of the wall once per nominal time step; the share fades linearly with distance.
`restitution` gives back its share of the normal velocity that a particle had before the step if its free flight
would end at the wall within the step (inside a
body of liquid the pressure turns the flow along the wall before it gets there).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numba import njit

from fluidlift.numerics.sampling import gradient_nodes, sample_nodes
from fluidlift.numerics.sharing import shared
from fluidlift.numerics.signed_distance import distance_and_gradient
from fluidlift.seams import CLEARANCE, CONTACT, WallShape
from fluidlift.types import CellType, FaceVelocity, Grid, Terrain

SMALLEST_OPENING = 0.02
"""open fractions below this are closed: slivers of faces carry no flow worth their bad conditioning"""


@dataclass(frozen=True)
class Walls:
    """What is static about the boundaries of a simulation."""

    grid: Grid
    signed_distance: Float[np.ndarray, "nx+1 ny+1 nz+1"]
    """m, positive outside the solid"""
    openings: tuple[np.ndarray, np.ndarray, np.ndarray]
    """open fraction of every face, closed sides of the box included"""
    normals: tuple[np.ndarray, np.ndarray, np.ndarray]
    """float32 [...,3] per face: unit vector out of the solid on closed faces, 0 on open ones"""
    solid: Bool[np.ndarray, "nx ny nz"]
    """cells without any open face"""
    buried: Bool[np.ndarray, "nx ny nz"]
    """other cells whose centre lies in the solid, or closer to it than a quarter of a cell"""
    regions: np.ndarray
    """u8 [nx,ny,nz]: INFLOW, OUTFLOW, SOLID or EMPTY (everywhere else)"""
    open_sides: Bool[np.ndarray, "3 2"]
    """sides of the box (axis, low/high) that let particles and fluid out everywhere"""


def _open_share_of_triangle(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Share of a triangle where the linear function with corner values a, b, c is positive."""
    low, middle, high = np.sort(np.stack([a, b, c]), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        one_below = 1.0 - low * low / ((low - middle) * (low - high))
        two_below = high * high / ((high - low) * (high - middle))
    return np.select([low >= 0, high <= 0, middle >= 0], [1.0, 0.0, one_below], two_below)


def face_fractions(signed_distance: Float[np.ndarray, "nx+1 ny+1 nz+1"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut cells: open share of every face across x, y and z, float32, from the signed distance at the nodes.

    Each square is cut into triangles along both diagonals, and the two results are averaged (no preferred diagonal).
    The surface is raised by a thousandth of the largest step between nodes (one cell's width), so that a face which
    lies in a flat surface is closed and not open by a rounding error.
    """
    distance = np.asarray(signed_distance, np.float64)
    step = max(float(np.abs(np.diff(distance, axis=axis)).max(initial=0.0)) for axis in range(3))
    fractions = []
    for axis in range(3):
        phi = np.moveaxis(distance - 1e-3 * step, axis, 0)
        a, b, c, d = phi[:, :-1, :-1], phi[:, 1:, :-1], phi[:, 1:, 1:], phi[:, :-1, 1:]
        parts = [(a, b, c), (a, c, d), (b, c, d), (a, b, d)]
        share = sum(_open_share_of_triangle(*corners) for corners in parts) / 4.0
        share = np.where(share < SMALLEST_OPENING, 0.0, share)
        fractions.append(np.ascontiguousarray(np.moveaxis(share, 0, axis), np.float32))
    return tuple(fractions)


def build_walls(terrain: Terrain, regions: np.ndarray, open_sides: np.ndarray) -> Walls:
    """Prepare the boundaries.

    Args:
        terrain: its signed distance decides what is solid; SOLID marks in `regions` are not needed.
        regions: u8 [nx,ny,nz]; only INFLOW and OUTFLOW count.
        open_sides: bool [3,2], see `Walls`.
    """
    grid = terrain.grid
    distance = np.ascontiguousarray(terrain.signed_distance, np.float32)
    fractions = face_fractions(distance)
    any_open = np.zeros(grid.shape, bool)
    for axis, f in enumerate(fractions):
        along = np.moveaxis(f, axis, 0)
        any_open |= np.moveaxis((along[1:] > 0) | (along[:-1] > 0), 0, axis)
    through = np.isin(regions, (CellType.INFLOW, CellType.OUTFLOW))
    openings, normals = [], []
    for axis, f in enumerate(fractions):
        opening = f.copy()
        normal = np.zeros((*f.shape, 3), np.float32)
        closed = f == 0
        if closed.any():
            gradient = gradient_nodes(distance, grid, grid.faces(axis)[closed])
            length = np.linalg.norm(gradient, axis=1, keepdims=True)
            normal[closed] = np.where(length > 1e-3, gradient / np.maximum(length, 1e-3), np.eye(3)[axis])
        for side, at in enumerate((0, -1)):
            if not open_sides[axis, side]:
                shut = ~np.moveaxis(through, axis, 0)[at]
                np.moveaxis(opening, axis, 0)[at][shut] = 0.0
                np.moveaxis(normal, axis, 0)[at][shut] = np.eye(3)[axis]
        openings.append(opening)
        normals.append(normal)
    buried = any_open & (mean_of_corners(distance) < 0.25 * grid.spacing)
    clean = np.where(any_open & through, regions, CellType.EMPTY)
    clean = np.where(any_open, clean, CellType.SOLID).astype(np.uint8)
    return Walls(
        grid, distance, tuple(openings), tuple(normals), ~any_open, buried, clean, np.asarray(open_sides, bool)
    )


def beside_closed_faces(walls: Walls) -> Bool[np.ndarray, "nx ny nz"]:
    """Cells with at least one face that is mostly closed."""
    out = np.zeros(walls.grid.shape, bool)
    for axis, opening in enumerate(walls.openings):
        closed = np.moveaxis(opening < 0.5, axis, 0)
        np.moveaxis(out, axis, 0)[...] |= closed[1:] | closed[:-1]
    return out & ~walls.solid


def touching_faces(cells: Bool[np.ndarray, "nx ny nz"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """bool per component: faces of the marked cells."""
    out = []
    for axis in range(3):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        wide = np.moveaxis(np.pad(cells, pad), axis, 0)
        out.append(np.moveaxis(wide[1:] | wide[:-1], 0, axis))
    return tuple(out)


def mean_of_corners(field: Float[np.ndarray, "nx+1 ny+1 nz+1"]) -> Float[np.ndarray, "nx ny nz"]:
    """Mean of the eight corners of each cell."""
    for axis in range(3):
        along = np.moveaxis(field, axis, 0)
        field = np.moveaxis(0.5 * (along[1:] + along[:-1]), 0, axis)
    return field


def cell_capacity(signed_distance: Float[np.ndarray, "nx+1 ny+1 nz+1"], grid: Grid) -> Float[np.ndarray, "nx ny nz"]:
    """Share (0 to 1) of the trilinear kernel around each cell centre that is not solid, from 4^3 samples."""
    capacity = np.ones(grid.shape, np.float32)
    nodes = np.asarray(signed_distance)
    near = np.abs(mean_of_corners(nodes)) < 2.0 * grid.spacing
    centers = grid.centers()[near]
    total = np.zeros(len(centers))
    offsets = np.array([-0.75, -0.25, 0.25, 0.75])
    for step in np.ndindex(4, 4, 4):
        shift = offsets[list(step)]
        weight = 0.125 * np.prod(1.0 - np.abs(shift))
        total += weight * (sample_nodes(nodes, grid, centers + shift * grid.spacing) > 0)
    capacity[near] = total
    return capacity


def liquid_cells(occupied: Bool[np.ndarray, "nx ny nz"], walls: Walls) -> np.ndarray:
    """u8 cell types of this step.

    FLUID where there are particles, and in single empty cells that are enclosed (five of six neighbours hold liquid
    or are solid, at least three liquid): sampling gaps, not bubbles. Also beside liquid in the slivers of open space
    that the bed leaves of its cells: particles hardly get there, and as air they would suck the liquid into the bed.
    INFLOW cells are always INFLOW.
    """
    wet = occupied & ~walls.solid
    blocked = np.pad(wet | walls.solid, 1)
    wide = np.pad(wet, 1)
    inner = slice(1, -1)
    around, liquid = np.zeros(wet.shape, np.int8), np.zeros(wet.shape, np.int8)
    for axis in range(3):
        for shift in (slice(0, -2), slice(2, None)):
            index = [inner, inner, inner]
            index[axis] = shift
            around += blocked[tuple(index)]
            liquid += wide[tuple(index)]
    gap = ~wet & ~walls.solid & (around >= 5) & (liquid >= 3)
    beside = np.zeros(wet.shape, bool)
    for axis, opening in enumerate(walls.openings):
        here, out = np.moveaxis(wet | gap, axis, 0), np.moveaxis(beside, axis, 0)
        passable = np.moveaxis(opening, axis, 0)[1:-1] > 0
        out[1:] |= passable & here[:-1]
        out[:-1] |= passable & here[1:]
    types = walls.regions.copy()
    types[(wet | gap | (beside & walls.buried)) & (walls.regions == CellType.EMPTY)] = CellType.FLUID
    return types


@shared(lambda layer, *_: (0, layer.shape[0]))
def _row_ranges(begin, end, layer, first, last):
    """The marked faces of each row along z lie in first <= k < last; in a row without any, first > last."""
    _, ny, nz = layer.shape
    for i in range(begin, end):
        for j in range(ny):
            low, high = 0, nz
            while low < nz and layer[i, j, low] == 0:
                low += 1
            while high > 0 and layer[i, j, high - 1] == 0:
                high -= 1
            first[i, j], last[i, j] = low, high


@njit(cache=True)
def _older(layer, number):
    return 0 < layer and layer < number


@shared(lambda field, *_: (0, field.shape[0]))
def _grow(begin, end, field, layer, number, first, last, new_first, new_last):
    """One layer, in place: faces without a value take the mean of their neighbours that have an older one.

    `layer` says when a face got its value (1: known, 0: not yet), so it does not matter which face comes first.
    """
    nx, ny, nz = field.shape
    for i in range(begin, end):
        for j in range(ny):
            low, high = first[i, j] - 1, last[i, j] + 1
            for step in range(-1, 2, 2):
                a, b = min(max(i + step, 0), nx - 1), min(max(j + step, 0), ny - 1)
                low = min(low, first[a, j], first[i, b])
                high = max(high, last[a, j], last[i, b])
            low, high = max(low, 0), min(high, nz)
            new_first[i, j], new_last[i, j] = low, high
            for k in range(low, high):
                if layer[i, j, k] != 0:
                    continue
                total = np.float32(0.0)
                count = 0
                if i > 0 and _older(layer[i - 1, j, k], number):
                    total += field[i - 1, j, k]
                    count += 1
                if i < nx - 1 and _older(layer[i + 1, j, k], number):
                    total += field[i + 1, j, k]
                    count += 1
                if j > 0 and _older(layer[i, j - 1, k], number):
                    total += field[i, j - 1, k]
                    count += 1
                if j < ny - 1 and _older(layer[i, j + 1, k], number):
                    total += field[i, j + 1, k]
                    count += 1
                if k > 0 and _older(layer[i, j, k - 1], number):
                    total += field[i, j, k - 1]
                    count += 1
                if k < nz - 1 and _older(layer[i, j, k + 1], number):
                    total += field[i, j, k + 1]
                    count += 1
                if count > 0:
                    field[i, j, k] = total / np.float32(count)
                    layer[i, j, k] = number


def extrapolate(
    velocity: FaceVelocity, valid: tuple[np.ndarray, np.ndarray, np.ndarray], layers: int = 3
) -> FaceVelocity:
    """Extrapolate the velocity beyond the faces where it is known (bool per face), layer by layer; 0 farther away."""
    out = []
    for component, known in zip(velocity.components, valid):
        field = np.where(known, component, np.float32(0)).astype(np.float32, copy=False)
        layer = known.astype(np.uint8)
        first, last = (np.empty(known.shape[:2], np.int64) for _ in range(2))
        _row_ranges(layer, first, last)
        for number in range(2, layers + 2):
            new_first, new_last = np.empty_like(first), np.empty_like(last)
            _grow(field, layer, np.uint8(number), first, last, new_first, new_last)
            first, last = new_first, new_last
        out.append(field)
    return FaceVelocity(*out)


def continued(velocity: FaceVelocity, cell_types: UInt8[np.ndarray, "nx ny nz"]) -> FaceVelocity:
    """The velocity (m/s) of a liquid, continued into air and walls, where it is stored as 0."""
    return extrapolate(
        velocity, touching_faces(np.isin(cell_types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW)))
    )


@shared(lambda u, v, w, opening, normals, axis, out: (0, out.shape[0]))
def _slide(begin, end, u, v, w, opening, normals, axis, out):
    """Closed faces of one component lose the part of the local velocity that is normal to the wall."""
    _, ny, nz = out.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                if opening[i, j, k] > 0:
                    continue
                n0, n1, n2 = normals[i, j, k, 0], normals[i, j, k, 1], normals[i, j, k, 2]
                na = n0 if axis == 0 else (n1 if axis == 1 else n2)
                if na == 0:
                    continue
                speed = na * out[i, j, k]
                for b in range(3):
                    nb = n0 if b == 0 else (n1 if b == 1 else n2)
                    if b == axis or nb == 0:
                        continue
                    # the four faces of component b around this face
                    other = u if b == 0 else (v if b == 1 else w)
                    mx, my, mz = other.shape
                    total = np.float32(0.0)
                    for s in range(2):
                        for t in range(2):
                            ii = i - s if axis == 0 else (i + t if b == 0 else i)
                            jj = j - s if axis == 1 else (j + t if b == 1 else j)
                            kk = k - s if axis == 2 else (k + t if b == 2 else k)
                            ii = min(max(ii, 0), mx - 1)
                            jj = min(max(jj, 0), my - 1)
                            kk = min(max(kk, 0), mz - 1)
                            total += other[ii, jj, kk]
                    speed += nb * total * np.float32(0.25)
                out[i, j, k] -= na * speed


def slide_along_walls(velocity: FaceVelocity, walls: Walls) -> FaceVelocity:
    """Free-slip wall: the velocity extrapolated into the solid, made tangential to its surface."""
    out = []
    for axis, component in enumerate(velocity.components):
        new = component.copy()
        _slide(*velocity.components, walls.openings[axis], walls.normals[axis], axis, new)
        out.append(new)
    return FaceVelocity(*out)


@njit(cache=True)
def _far_from_walls(field, low, inverse, x, y, z, reach):
    """No corner of the point's cell is closer than `reach`: then no point of the cell is, by interpolation."""
    nx, ny, nz = field.shape
    i = min(max(np.int64((x - low[0]) * inverse), 0), nx - 2)
    j = min(max(np.int64((y - low[1]) * inverse), 0), ny - 2)
    k = min(max(np.int64((z - low[2]) * inverse), 0), nz - 2)
    a = min(field[i, j, k], field[i, j, k + 1])
    b = min(field[i, j + 1, k], field[i, j + 1, k + 1])
    c = min(field[i + 1, j, k], field[i + 1, j, k + 1])
    d = min(field[i + 1, j + 1, k], field[i + 1, j + 1, k + 1])
    return min(min(a, b), min(c, d)) >= reach


@shared(lambda new, *_: (0, len(new)))
def _collide(
    begin, end, new, old, velocities, incoming, dt, field, regions, low, high, h, open_sides, restitution, keep
):
    inverse = 1.0 / h
    margin = CLEARANCE * h
    for p in range(begin, end):
        i = min(max(np.int64((old[p, 0] - low[0]) * inverse), 0), regions.shape[0] - 1)
        j = min(max(np.int64((old[p, 1] - low[1]) * inverse), 0), regions.shape[1] - 1)
        k = min(max(np.int64((old[p, 2] - low[2]) * inverse), 0), regions.shape[2] - 1)
        through = regions[i, j, k] >= 3  # INFLOW or OUTFLOW
        for a in range(3):
            lowest, highest = low[a] + margin, high[a] - margin
            if through:
                continue
            flight = old[p, a] + dt * incoming[p, a]
            if not open_sides[a, 0]:
                if flight < lowest and incoming[p, a] < 0.0:
                    velocities[p, a] = max(velocities[p, a], -restitution * incoming[p, a])
                new[p, a] = max(new[p, a], lowest)
            if not open_sides[a, 1]:
                if flight > highest and incoming[p, a] > 0.0:
                    velocities[p, a] = min(velocities[p, a], -restitution * incoming[p, a])
                new[p, a] = min(new[p, a], highest)
        gone = False
        for a in range(3):
            gone |= new[p, a] < low[a] or new[p, a] >= high[a]
        if gone:  # out of the box, where no terrain is known: pushed back it would pile up at the outlet
            continue
        x, y, z = np.float64(new[p, 0]), np.float64(new[p, 1]), np.float64(new[p, 2])
        if _far_from_walls(field, low, inverse, x, y, z, h):
            continue
        value, gx, gy, gz = distance_and_gradient(field, low, inverse, x, y, z)
        if value >= h:
            continue
        length = np.sqrt(gx * gx + gy * gy + gz * gz)
        if length > 1e-3:
            nx, ny, nz = gx / length, gy / length, gz / length
            normal = velocities[p, 0] * nx + velocities[p, 1] * ny + velocities[p, 2] * nz
            # share of the damping at this distance
            factor = 1.0 - (1.0 - keep) * min(max(1.0 - value / h, 0.0), 1.0)
            # pressed into the wall without a flight into it: stopped
            back = max(normal, 0.0) if value < margin else normal
            before = incoming[p, 0] * nx + incoming[p, 1] * ny + incoming[p, 2] * nz
            if before < 0.0 and restitution > 0.0:
                flight, _, _, _ = distance_and_gradient(
                    field,
                    low,
                    inverse,
                    old[p, 0] + dt * incoming[p, 0],
                    old[p, 1] + dt * incoming[p, 1],
                    old[p, 2] + dt * incoming[p, 2],
                )
                if flight < CONTACT * h:
                    back = max(back, -restitution * before)
            velocities[p, 0] = factor * (velocities[p, 0] - normal * nx) + back * nx
            velocities[p, 1] = factor * (velocities[p, 1] - normal * ny) + back * ny
            velocities[p, 2] = factor * (velocities[p, 2] - normal * nz) + back * nz
        if value >= margin:
            continue
        for _ in range(6):
            squared = gx * gx + gy * gy + gz * gz
            if value >= margin or squared < 1e-6:
                break
            step = 1.01 * (margin - value) / squared
            x = min(max(x + step * gx, low[0] + margin), high[0] - margin)
            y = min(max(y + step * gy, low[1] + margin), high[1] - margin)
            z = min(max(z + step * gz, low[2] + margin), high[2] - margin)
            value, gx, gy, gz = distance_and_gradient(field, low, inverse, x, y, z)
        # judged as stored, in single precision; the old place was outside
        fx, fy, fz = np.float32(x), np.float32(y), np.float32(z)
        value, gx, gy, gz = distance_and_gradient(field, low, inverse, np.float64(fx), np.float64(fy), np.float64(fz))
        if value > 0.0:
            new[p, 0], new[p, 1], new[p, 2] = fx, fy, fz
        else:
            for a in range(3):
                new[p, a] = old[p, a]


def collide(
    positions: Float[np.ndarray, "n 3"],
    previous: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    incoming: Float[np.ndarray, "n 3"],
    walls: WallShape,
    *,
    dt: float,
    restitution: float,
    tangential_share: float,
) -> None:
    """Keep particles out of the solid and within the closed sides of the box, in place.

    Args:
        positions: float32, moved.
        previous: where the particles were, outside the solid.
        velocities: after the step; changed at walls.
        incoming: velocities before the step.
        walls: the boundaries.
        dt: s.
        restitution: share of the normal velocity given back on impact.
        tangential_share: share of the tangential velocity that survives this step at the wall.
    """
    _collide(
        positions, previous, velocities, incoming, float(dt), walls.signed_distance, walls.regions, walls.grid.low,
        walls.grid.high, walls.grid.spacing, walls.open_sides, float(restitution), float(tangential_share),
    )  # fmt: skip
