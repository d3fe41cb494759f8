"""Affine particle-in-cell transfers on the staggered grid (paper: `particle_map`; Jiang et al. 2015).

Each velocity component lives on its own faces, so row a of a particle's affine matrix belongs to component a:

    m_i v_i = sum_p w_ip m_p (v_pa + C_pa . (x_i - x_p)),      m_i = sum_p w_ip m_p,
    v_pa = sum_i w_ip v_i,      C_pa = 4 / h^2 sum_i w_ip v_i (x_i - x_p).

The kernels scatter slabs of four cells along x, first the even ones and then the odd ones: the footprints of two
slabs of one colour never meet, so no atomics are needed and the sums do not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit, prange

from fluidlift.numerics.bspline import quadratic, quadratic_weights
from fluidlift.types import FaceVelocity, Grid, Particles

SLAB = 4


@dataclass(frozen=True)
class CellOrder:
    """Particles grouped by cell."""

    order: Int[np.ndarray, "n"]
    """particle indices, cell by cell (x slowest), stable"""
    start: Int[np.ndarray, "cells+1"]
    """where each cell begins in `order`"""


@njit(cache=True)
def _count_sort(positions, low, inverse_spacing, nx, ny, nz):
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


def sort_by_cell(positions: Float[np.ndarray, "n 3"], grid: Grid) -> CellOrder:
    """Group particles by cell; those outside the box count for the nearest cell."""
    return CellOrder(*_count_sort(positions, grid.low, 1.0 / grid.spacing, *grid.shape))


@njit(cache=True)
def _scatter_component(p, axis, x, y, z, positions_h, velocities, affine, masses, momentum, mass):
    """Add particle p to the faces across `axis`; (x, y, z) in cells such that face i lies at coordinate i."""
    bi, wx0, wx1, wx2 = quadratic_weights(x)
    bj, wy0, wy1, wy2 = quadratic_weights(y)
    bk, wz0, wz1, wz2 = quadratic_weights(z)
    ni, nj, nk = mass.shape
    m = masses[p]
    v = velocities[p, axis]
    cx = affine[p, axis, 0] * positions_h
    cy = affine[p, axis, 1] * positions_h
    cz = affine[p, axis, 2] * positions_h
    for a in range(3):
        i = bi + a
        if i < 0 or i >= ni:
            continue
        wi = wx0 if a == 0 else (wx1 if a == 1 else wx2)
        vi = v + cx * (np.float32(i) - x)
        for b in range(3):
            j = bj + b
            if j < 0 or j >= nj:
                continue
            wij = wi * (wy0 if b == 0 else (wy1 if b == 1 else wy2)) * m
            vij = vi + cy * (np.float32(j) - y)
            for c in range(3):
                k = bk + c
                if k < 0 or k >= nk:
                    continue
                w = wij * (wz0 if c == 0 else (wz1 if c == 1 else wz2))
                mass[i, j, k] += w
                momentum[i, j, k] += w * (vij + cz * (np.float32(k) - z))


@njit(parallel=True, cache=True)
def _scatter(positions, velocities, affine, masses, order, slab_start, low, h, mu, mv, mw, wu, wv, ww):
    slabs = len(slab_start) - 1
    inverse = np.float32(1.0 / h)
    spacing = np.float32(h)
    half = np.float32(0.5)
    x0, y0, z0 = np.float32(low[0]), np.float32(low[1]), np.float32(low[2])
    for color in range(2):
        for s_ in prange((slabs + 1 - color) // 2):
            s = 2 * np.int64(s_) + color
            for n in range(slab_start[s], slab_start[s + 1]):
                p = order[n]
                x = (positions[p, 0] - x0) * inverse
                y = (positions[p, 1] - y0) * inverse
                z = (positions[p, 2] - z0) * inverse
                _scatter_component(p, 0, x, y - half, z - half, spacing, velocities, affine, masses, mu, wu)
                _scatter_component(p, 1, x - half, y, z - half, spacing, velocities, affine, masses, mv, wv)
                _scatter_component(p, 2, x - half, y - half, z, spacing, velocities, affine, masses, mw, ww)


def _velocity_from_momentum(momentum: np.ndarray, mass: np.ndarray) -> np.ndarray:
    return np.divide(momentum, mass, out=np.zeros_like(momentum), where=mass > 1e-30)


def particles_to_grid(
    particles: Particles, grid: Grid, order: CellOrder | None = None
) -> tuple[FaceVelocity, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Face velocity (m/s, 0 where no particle reaches) and face masses (kg).

    Args:
        particles: inside the box of the grid.
        grid: the staggered grid.
        order: from `sort_by_cell` (made here when missing).
    """
    order = order or sort_by_cell(particles.positions, grid)
    nx, ny, nz = grid.shape
    slab_start = order.start[np.minimum(np.arange(0, nx + SLAB, SLAB), nx) * ny * nz]
    momenta, masses = ([np.zeros(grid.face_shape(a), np.float32) for a in range(3)] for _ in range(2))
    _scatter(
        particles.positions, particles.velocities, particles.affine, particles.masses, order.order, slab_start,
        grid.low, grid.spacing, *momenta, *masses,
    )  # fmt: skip
    return FaceVelocity(*(_velocity_from_momentum(p, m) for p, m in zip(momenta, masses))), tuple(masses)


def particles_to_grid_plain(
    particles: Particles, grid: Grid
) -> tuple[FaceVelocity, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """`particles_to_grid` in double precision, as the formula reads."""
    velocities, masses = [], []
    for axis in range(3):
        shape = grid.face_shape(axis)
        momentum, mass = np.zeros(shape), np.zeros(shape)
        for index, weight, offset in _footprints(particles.positions, grid, axis):
            inside = ((index >= 0) & (index < shape)).all(axis=1)
            at = tuple(index[inside].T)
            value = particles.velocities[:, axis] + np.einsum("nk,nk->n", particles.affine[:, axis], offset)
            np.add.at(mass, at, (weight * particles.masses)[inside])
            np.add.at(momentum, at, (weight * particles.masses * value)[inside])
        velocities.append(_velocity_from_momentum(momentum, mass))
        masses.append(mass)
    return FaceVelocity(*velocities), tuple(masses)


def _footprints(positions: np.ndarray, grid: Grid, axis: int):
    """For each of the 27 faces around each particle: index [n,3], weight [n], x_i - x_p [n,3] in m."""
    shift = np.full(3, 0.5)
    shift[axis] = 0.0
    coordinates = (np.asarray(positions, np.float64) - grid.low) / grid.spacing - shift
    base, weights = quadratic(coordinates)
    for step in np.ndindex(3, 3, 3):
        index = base + np.asarray(step)
        weight = weights[:, 0, step[0]] * weights[:, 1, step[1]] * weights[:, 2, step[2]]
        yield index, weight, (index - coordinates) * grid.spacing


@njit(cache=True)
def _gather_component(p, axis, x, y, z, four_over_h, field, velocities, affine):
    bi, wx0, wx1, wx2 = quadratic_weights(x)
    bj, wy0, wy1, wy2 = quadratic_weights(y)
    bk, wz0, wz1, wz2 = quadratic_weights(z)
    ni, nj, nk = field.shape
    v = np.float32(0.0)
    cx = np.float32(0.0)
    cy = np.float32(0.0)
    cz = np.float32(0.0)
    for a in range(3):
        i = min(max(bi + a, 0), ni - 1)
        wi = wx0 if a == 0 else (wx1 if a == 1 else wx2)
        for b in range(3):
            j = min(max(bj + b, 0), nj - 1)
            wij = wi * (wy0 if b == 0 else (wy1 if b == 1 else wy2))
            for c in range(3):
                k = min(max(bk + c, 0), nk - 1)
                value = wij * (wz0 if c == 0 else (wz1 if c == 1 else wz2)) * field[i, j, k]
                v += value
                cx += value * (np.float32(bi + a) - x)
                cy += value * (np.float32(bj + b) - y)
                cz += value * (np.float32(bk + c) - z)
    velocities[p, axis] = v
    affine[p, axis, 0] = four_over_h * cx
    affine[p, axis, 1] = four_over_h * cy
    affine[p, axis, 2] = four_over_h * cz


@njit(parallel=True, cache=True)
def _gather(positions, order, low, h, u, v, w, velocities, affine):
    n = len(positions)
    inverse = np.float32(1.0 / h)
    four = np.float32(4.0 / h)
    half = np.float32(0.5)
    x0, y0, z0 = np.float32(low[0]), np.float32(low[1]), np.float32(low[2])
    for chunk in prange((n + 2047) // 2048):
        first = np.int64(chunk) * 2048
        for m in range(first, min(first + 2048, n)):
            p = order[m]
            x = (positions[p, 0] - x0) * inverse
            y = (positions[p, 1] - y0) * inverse
            z = (positions[p, 2] - z0) * inverse
            _gather_component(p, 0, x, y - half, z - half, four, u, velocities, affine)
            _gather_component(p, 1, x - half, y, z - half, four, v, velocities, affine)
            _gather_component(p, 2, x - half, y - half, z, four, w, velocities, affine)


def grid_to_particles(
    velocity: FaceVelocity, grid: Grid, positions: Float[np.ndarray, "n 3"], order: CellOrder | None = None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Velocities (m/s) and affine matrices (1/s) at positions. Beyond the outer faces the outer value continues."""
    velocities = np.empty((len(positions), 3), np.float32)
    affine = np.empty((len(positions), 3, 3), np.float32)
    index = order.order if order is not None else np.arange(len(positions))
    components = [np.ascontiguousarray(c, np.float32) for c in velocity.components]
    positions = np.ascontiguousarray(positions, np.float32)
    _gather(positions, index, grid.low, grid.spacing, *components, velocities, affine)
    return velocities, affine


def grid_to_particles_plain(
    velocity: FaceVelocity, grid: Grid, positions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """`grid_to_particles` in double precision, as the formula reads."""
    velocities = np.zeros((len(positions), 3))
    affine = np.zeros((len(positions), 3, 3))
    for axis, component in enumerate(velocity.components):
        last = np.asarray(component.shape) - 1
        for index, weight, offset in _footprints(positions, grid, axis):
            value = weight * component[tuple(np.clip(index, 0, last).T)]
            velocities[:, axis] += value
            affine[:, axis] += 4.0 / grid.spacing**2 * value[:, None] * offset
    return velocities, affine


@njit(parallel=True, cache=True)
def _deposit(positions, amounts, order, slab_start, low, h, out):
    slabs = len(slab_start) - 1
    nx, ny, nz = out.shape
    inverse = 1.0 / h
    for color in range(2):
        for s_ in prange((slabs + 1 - color) // 2):
            s = 2 * np.int64(s_) + color
            for n in range(slab_start[s], slab_start[s + 1]):
                p = order[n]
                x = (positions[p, 0] - low[0]) * inverse - 0.5
                y = (positions[p, 1] - low[1]) * inverse - 0.5
                z = (positions[p, 2] - low[2]) * inverse - 0.5
                i = np.int64(np.floor(x))
                j = np.int64(np.floor(y))
                k = np.int64(np.floor(z))
                for a in range(2):
                    wx = x - i if a == 1 else 1.0 - (x - i)
                    for b in range(2):
                        wxy = wx * (y - j if b == 1 else 1.0 - (y - j))
                        for c in range(2):
                            w = wxy * (z - k if c == 1 else 1.0 - (z - k))
                            ii = min(max(i + a, 0), nx - 1)
                            jj = min(max(j + b, 0), ny - 1)
                            kk = min(max(k + c, 0), nz - 1)
                            out[ii, jj, kk] += np.float32(w * amounts[p])


def deposit_to_cells(
    positions: Float[np.ndarray, "n 3"], amounts: Float[np.ndarray, "n"], grid: Grid, order: CellOrder
) -> Float[np.ndarray, "nx ny nz"]:
    """Amounts shared among the eight nearest cell centres by trilinear weights; the total is kept."""
    nx, ny, nz = grid.shape
    slab_start = order.start[np.minimum(np.arange(0, nx + SLAB, SLAB), nx) * ny * nz]
    out = np.zeros(grid.shape, np.float32)
    _deposit(positions, amounts, order.order, slab_start, grid.low, grid.spacing, out)
    return out
