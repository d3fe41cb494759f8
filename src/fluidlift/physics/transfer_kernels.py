"""Numba kernels of P2G and G2P (see `physics.transfer`, whose plain twins say what they compute).

The grid arrays here have GHOST more faces on every side, and one more in z: the footprint of a particle never leaves
them, and a row of three samples along z may be read and written as four, the last with weight 0. The sums of a
scatter keep mass and momentum of a face side by side.

A scatter takes blocks of BLOCK x BLOCK columns of cells, in four colours one after the other: the footprints of two
blocks of one colour never meet, so no atomics are needed and the sums do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fluidlift.numerics.bspline import quadratic_weights
from fluidlift.numerics.lanes import first_half, lane, load4, load8, store, twice, vector4, vector8
from fluidlift.numerics.sharing import shared

BLOCK = 4
"""columns; the footprint of a block is 3 wider and must not pass the next block"""
GHOST = 2
CHUNK = 2048
"""particles that a thread takes at a time"""


@njit(cache=True)
def count_sort(positions, low, inverse_spacing, nx, ny, nz):
    """Particle indices cell by cell, and where each cell begins."""
    n = len(positions)
    cells = np.empty(n, np.int64)
    start = np.zeros(nx * ny * nz + 1, np.int64)
    for p in range(n):
        i = min(max(np.int64(np.floor((positions[p, 0] - low[0]) * inverse_spacing)), 0), nx - 1)
        j = min(max(np.int64(np.floor((positions[p, 1] - low[1]) * inverse_spacing)), 0), ny - 1)
        k = min(max(np.int64(np.floor((positions[p, 2] - low[2]) * inverse_spacing)), 0), nz - 1)
        cells[p] = (i * ny + j) * nz + k
        start[cells[p] + 1] += 1
    for c in range(nx * ny * nz):
        start[c + 1] += start[c]
    fill = start[:-1].copy()
    order = np.empty(n, np.int64)
    for p in range(n):
        order[fill[cells[p]]] = p
        fill[cells[p]] += 1
    return order, start


@njit(cache=True)
def _samples(coordinate):
    """The three samples around a coordinate in cells: first index, its offset from there, and the weights."""
    base, a, b, c = quadratic_weights(coordinate)
    return base, np.float32(base) - coordinate, a, b, c


@njit(cache=True)
def _add_row(sums, start, weights, weight, values):
    store(sums, start, load8(sums, start) + weights * weight * values)


@njit(cache=True)
def _scatter_component(sums, shape, along_x, along_y, along_z, m, v, cx, cy, cz):
    """Add one particle to the faces of one component; c per cell (affine row times spacing)."""
    bi, dx, x0, x1, x2 = along_x
    bj, dy, y0, y1, y2 = along_y
    bk, dz, z0, z1, z2 = along_z
    row, plane = 2 * shape[2], 2 * shape[1] * shape[2]
    start = (bi + GHOST) * plane + (bj + GHOST) * row + 2 * (bk + GHOST)
    weights = vector8(z0, z0, z1, z1, z2, z2, 0.0, 0.0)
    # mass, momentum, mass, momentum...: 1 and the velocity at each face of the row
    momentum = vector8(0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0)
    farther = vector8(0.0, 0.0, 0.0, 1.0, 0.0, 2.0, 0.0, 0.0)
    first = vector8(1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0) + momentum * (v + cx * dx + cy * dy + cz * dz)
    first = first + farther * cz
    step_x, step_y = momentum * cx, momentum * cy
    second = first + step_y
    third = second + step_y
    y0, y1, y2 = m * y0, m * y1, m * y2
    _add_row(sums, start, weights, x0 * y0, first)
    _add_row(sums, start + row, weights, x0 * y1, second)
    _add_row(sums, start + 2 * row, weights, x0 * y2, third)
    first, second, third = first + step_x, second + step_x, third + step_x
    start += plane
    _add_row(sums, start, weights, x1 * y0, first)
    _add_row(sums, start + row, weights, x1 * y1, second)
    _add_row(sums, start + 2 * row, weights, x1 * y2, third)
    first, second, third = first + step_x, second + step_x, third + step_x
    start += plane
    _add_row(sums, start, weights, x2 * y0, first)
    _add_row(sums, start + row, weights, x2 * y1, second)
    _add_row(sums, start + 2 * row, weights, x2 * y2, third)


@shared(lambda positions, velocities, affine, masses, order, start, blocks, *_: (0, len(blocks)))
def scatter(
    begin, end, positions, velocities, affine, masses, order, start, blocks, low, h, cells, sums_u, sums_v, sums_w
):
    """Add the particles of some blocks (int64 [b,2], all of one colour) to the sums of mass and momentum per face.

    The sums are [fx+4, fy+4, fz+5, 2]. Particles more than a cell outside the box reach no face and are left out.
    """
    inverse, spacing, half, one = np.float32(1.0 / h), np.float32(h), np.float32(0.5), np.float32(1.0)
    x0, y0, z0 = np.float32(low[0]), np.float32(low[1]), np.float32(low[2])
    nx, ny, nz = np.float32(cells[0] + 1), np.float32(cells[1] + 1), np.float32(cells[2] + 1)
    flat_u, flat_v, flat_w = sums_u.reshape(-1), sums_v.reshape(-1), sums_w.reshape(-1)
    for b in range(begin, end):
        for i in range(BLOCK * blocks[b, 0], min(BLOCK * (blocks[b, 0] + 1), cells[0])):
            # the columns of a block that follow each other in y follow each other in the order, too
            first = start[(i * cells[1] + BLOCK * blocks[b, 1]) * cells[2]]
            last = start[(i * cells[1] + min(BLOCK * (blocks[b, 1] + 1), cells[1])) * cells[2]]
            for n in range(first, last):
                p = order[n]
                x = (positions[p, 0] - x0) * inverse
                y = (positions[p, 1] - y0) * inverse
                z = (positions[p, 2] - z0) * inverse
                if not (-one < x and x < nx and -one < y and y < ny and -one < z and z < nz):
                    continue
                face_x, face_y, face_z = _samples(x), _samples(y), _samples(z)
                center_x, center_y, center_z = _samples(x - half), _samples(y - half), _samples(z - half)
                m = masses[p]
                cx, cy, cz = spacing * affine[p, 0, 0], spacing * affine[p, 0, 1], spacing * affine[p, 0, 2]
                v = velocities[p, 0]
                _scatter_component(flat_u, sums_u.shape, face_x, center_y, center_z, m, v, cx, cy, cz)
                cx, cy, cz = spacing * affine[p, 1, 0], spacing * affine[p, 1, 1], spacing * affine[p, 1, 2]
                v = velocities[p, 1]
                _scatter_component(flat_v, sums_v.shape, center_x, face_y, center_z, m, v, cx, cy, cz)
                cx, cy, cz = spacing * affine[p, 2, 0], spacing * affine[p, 2, 1], spacing * affine[p, 2, 2]
                v = velocities[p, 2]
                _scatter_component(flat_w, sums_w.shape, center_x, center_y, face_z, m, v, cx, cy, cz)


@shared(lambda sums, velocity, mass: (0, mass.shape[0]))
def divide(begin, end, sums, velocity, mass):
    """Velocity = momentum / mass (0 where there is none) without the ghost faces."""
    _, nj, nk = mass.shape
    for i in range(begin, end):
        for j in range(nj):
            for k in range(nk):
                m = sums[i + GHOST, j + GHOST, k + GHOST, 0]
                mass[i, j, k] = m
                velocity[i, j, k] = (
                    sums[i + GHOST, j + GHOST, k + GHOST, 1] / m if m > np.float32(1e-30) else np.float32(0.0)
                )


@shared(lambda field, out: (0, out.shape[0]))
def pad(begin, end, field, out):
    """Copy with ghost faces that repeat the outer ones."""
    ni, nj, nk = field.shape
    for i_ in range(begin, end):
        i = min(max(i_ - GHOST, 0), ni - 1)
        for j_ in range(out.shape[1]):
            j = min(max(j_ - GHOST, 0), nj - 1)
            for k in range(GHOST):
                out[i_, j_, k] = field[i, j, 0]
            for k in range(nk):
                out[i_, j_, k + GHOST] = field[i, j, k]
            for k in range(nk + GHOST, out.shape[2]):
                out[i_, j_, k] = field[i, j, nk - 1]


@njit(cache=True)
def _gather_component(field, shape, along_x, along_y, along_z):
    """Velocity and the moments of one component around one particle."""
    bi, dx, x0, x1, x2 = along_x
    bj, dy, y0, y1, y2 = along_y
    bk, dz, z0, z1, z2 = along_z
    row, plane = shape[2], shape[1] * shape[2]
    start = (bi + GHOST) * plane + (bj + GHOST) * row + bk + GHOST
    one, two = np.float32(1.0), np.float32(2.0)
    # lanes 0 to 2: sums over y of the rows along z; lanes 4 to 6: the same times the offset in y
    m0, m1, m2 = y0 * dy, y1 * (dy + one), y2 * (dy + two)
    w0 = vector8(y0, y0, y0, y0, m0, m0, m0, m0)
    w1 = vector8(y1, y1, y1, y1, m1, m1, m1, m1)
    w2 = vector8(y2, y2, y2, y2, m2, m2, m2, m2)
    t = twice(load4(field, start)) * w0
    t = t + twice(load4(field, start + row)) * w1
    t = t + twice(load4(field, start + 2 * row)) * w2
    total, moment_x = t * x0, first_half(t) * (x0 * dx)
    start += plane
    t = twice(load4(field, start)) * w0
    t = t + twice(load4(field, start + row)) * w1
    t = t + twice(load4(field, start + 2 * row)) * w2
    total, moment_x = total + t * x1, moment_x + first_half(t) * (x1 * (dx + one))
    start += plane
    t = twice(load4(field, start)) * w0
    t = t + twice(load4(field, start + row)) * w1
    t = t + twice(load4(field, start + 2 * row)) * w2
    total, moment_x = total + t * x2, moment_x + first_half(t) * (x2 * (dx + two))
    total = total * vector8(z0, z1, z2, 0.0, z0, z1, z2, 0.0)
    moment_x = moment_x * vector4(z0, z1, z2, 0.0)
    a, b, c = lane(total, 0), lane(total, 1), lane(total, 2)
    return (
        a + b + c,
        lane(moment_x, 0) + lane(moment_x, 1) + lane(moment_x, 2),
        lane(total, 4) + lane(total, 5) + lane(total, 6),
        a * dz + b * (dz + one) + c * (dz + two),
    )


@njit(cache=True)
def _clamp(x, low, high):
    # not-a-number becomes low: the kernels never leave their arrays
    return high if x > high else (x if x > low else low)


@shared(lambda positions, *_: (0, ((len(positions)) + CHUNK - 1) // CHUNK))
def gather(begin, end, positions, order, low, h, u, v, w, velocities, affine):
    """Velocities and affine matrices from padded components.

    More than half a cell outside the box the velocity no longer changes, so positions are taken from there.
    """
    n = len(positions)
    inverse, four, half = np.float32(1.0 / h), np.float32(4.0 / h), np.float32(0.5)
    x0, y0, z0 = np.float32(low[0]), np.float32(low[1]), np.float32(low[2])
    nx, ny, nz = v.shape[0] - 2 * GHOST, u.shape[1] - 2 * GHOST, u.shape[2] - 2 * GHOST - 1
    hx, hy, hz = np.float32(nx) + half, np.float32(ny) + half, np.float32(nz) + half
    flat_u, flat_v, flat_w = u.reshape(-1), v.reshape(-1), w.reshape(-1)
    for chunk in range(begin, end):
        first = chunk * CHUNK
        for m in range(first, min(first + CHUNK, n)):
            p = order[m]
            x = _clamp((positions[p, 0] - x0) * inverse, -half, hx)
            y = _clamp((positions[p, 1] - y0) * inverse, -half, hy)
            z = _clamp((positions[p, 2] - z0) * inverse, -half, hz)
            face_x, face_y, face_z = _samples(x), _samples(y), _samples(z)
            center_x, center_y, center_z = _samples(x - half), _samples(y - half), _samples(z - half)
            a, ax, ay, az = _gather_component(flat_u, u.shape, face_x, center_y, center_z)
            b, bx, by, bz = _gather_component(flat_v, v.shape, center_x, face_y, center_z)
            c, cx, cy, cz = _gather_component(flat_w, w.shape, center_x, center_y, face_z)
            velocities[p, 0], velocities[p, 1], velocities[p, 2] = a, b, c
            affine[p, 0, 0], affine[p, 0, 1], affine[p, 0, 2] = four * ax, four * ay, four * az
            affine[p, 1, 0], affine[p, 1, 1], affine[p, 1, 2] = four * bx, four * by, four * bz
            affine[p, 2, 0], affine[p, 2, 1], affine[p, 2, 2] = four * cx, four * cy, four * cz


@shared(lambda positions, amounts, order, start, blocks, *_: (0, len(blocks)))
def deposit(begin, end, positions, amounts, order, start, blocks, low, h, out):
    """Amounts of the particles of some blocks, shared among the eight nearest cell centres."""
    nx, ny, nz = out.shape
    inverse, half = np.float32(1.0 / h), np.float32(0.5)
    x0, y0, z0 = np.float32(low[0]), np.float32(low[1]), np.float32(low[2])
    for block in range(begin, end):
        for column in range(BLOCK * blocks[block, 0], min(BLOCK * (blocks[block, 0] + 1), nx)):
            first = start[(column * ny + BLOCK * blocks[block, 1]) * nz]
            last = start[(column * ny + min(BLOCK * (blocks[block, 1] + 1), ny)) * nz]
            for n in range(first, last):
                p = order[n]
                x = (positions[p, 0] - x0) * inverse - half
                y = (positions[p, 1] - y0) * inverse - half
                z = (positions[p, 2] - z0) * inverse - half
                i, j, k = np.int64(np.floor(x)), np.int64(np.floor(y)), np.int64(np.floor(z))
                fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
                k0, k1 = min(max(k, 0), nz - 1), min(max(k + 1, 0), nz - 1)
                for a in range(2):
                    wx = amounts[p] * (fx if a == 1 else np.float32(1.0) - fx)
                    ii = min(max(i + a, 0), nx - 1)
                    for b in range(2):
                        w = wx * (fy if b == 1 else np.float32(1.0) - fy)
                        jj = min(max(j + b, 0), ny - 1)
                        upper = w * fz
                        out[ii, jj, k0] += w - upper
                        out[ii, jj, k1] += upper


@shared(lambda index, *_: (0, len(index)))
def select(
    begin, end, index, positions, velocities, affine, deformation, masses, source, ids,
    new_positions, new_velocities, new_affine, new_deformation, new_masses, new_source, new_ids,
):  # fmt: skip
    """Copy the rows of an index."""
    for m in range(begin, end):
        p = index[m]
        new_masses[m], new_source[m], new_ids[m] = masses[p], source[p], ids[p]
        for a in range(3):
            new_positions[m, a] = positions[p, a]
            new_velocities[m, a] = velocities[p, a]
            for b in range(3):
                new_affine[m, a, b] = affine[p, a, b]
                new_deformation[m, a, b] = deformation[p, a, b]
