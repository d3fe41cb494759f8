"""Kernels of the coupled viscosity: weights of the stresses, the operator, and the vector work of its solver.

All arrays share one layout: a box of nodes with a ring of ghosts. u[i,j,k] lies between the cells i-1 and i, likewise v
and w, and the edge along z number (i, j) between u[i,j-1] and u[i,j] and between v[i-1,j] and v[i,j]. Components are
stacked: [3, nx, ny, nz]. Only `first <= k < last` of each vertical column is visited.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from fluidlift.physics.liquid_fractions import control_share

AIR, SOLVED, FIXED, WALL = 0, 1, 2, 3
"""roles of a face"""


@njit(cache=True)
def _pair(a, b, wall_share):
    """Share of a normal stress between two faces; 0 unless it acts on a solved one."""
    if a == AIR or b == AIR or (a != SOLVED and b != SOLVED):
        return 0.0
    return wall_share if a == WALL or b == WALL else 1.0


@njit(cache=True)
def _four(a, b, c, d, wall_share):
    """Share of a shear stress between four faces. A wall lies at half a cell's distance: twice the stiffness."""
    if a == AIR or b == AIR or c == AIR or d == AIR:
        return 0.0
    if a != SOLVED and b != SOLVED and c != SOLVED and d != SOLVED:
        return 0.0
    return 2.0 * wall_share if a == WALL or b == WALL or c == WALL or d == WALL else 1.0


@njit(parallel=True, cache=True)
def weigh_stresses(roles, octants, excluded, resistance, number, wall_share, normal, shear):
    """Weights of the normal stresses xx, yy, zz at cells and of the shear stresses yz, xz, xy at edges.

    normal[a] = 2 V nu dt / h^2 and shear[a] = V nu dt / h^2, where `number` is dt / h^2. A stress that would need the
    velocity of air is left out: the surface is free of it.
    """
    _, nx, ny, nz = roles.shape
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                xx = _pair(roles[0, i, j, k], roles[0, i + 1, j, k], wall_share)
                yy = _pair(roles[1, i, j, k], roles[1, i, j + 1, k], wall_share)
                zz = _pair(roles[2, i, j, k], roles[2, i, j, k + 1], wall_share)
                if xx + yy + zz > 0.0:
                    share, viscosity = control_share(octants, excluded, resistance, i, j, k, 0, 0, 0)
                    weight = 2.0 * number * share * viscosity
                    normal[0, i, j, k] = weight * xx
                    normal[1, i, j, k] = weight * yy
                    normal[2, i, j, k] = weight * zz
                u, v, w = roles[0, i, j, k], roles[1, i, j, k], roles[2, i, j, k]
                yz = _four(v, roles[1, i, j, k - 1], w, roles[2, i, j - 1, k], wall_share)
                if yz > 0.0:
                    share, viscosity = control_share(octants, excluded, resistance, i, j, k, 0, 1, 1)
                    shear[0, i, j, k] = yz * number * share * viscosity
                xz = _four(u, roles[0, i, j, k - 1], w, roles[2, i - 1, j, k], wall_share)
                if xz > 0.0:
                    share, viscosity = control_share(octants, excluded, resistance, i, j, k, 1, 0, 1)
                    shear[1, i, j, k] = xz * number * share * viscosity
                xy = _four(u, roles[0, i, j - 1, k], v, roles[1, i - 1, j, k], wall_share)
                if xy > 0.0:
                    share, viscosity = control_share(octants, excluded, resistance, i, j, k, 1, 1, 0)
                    shear[2, i, j, k] = xy * number * share * viscosity


@njit(parallel=True, cache=True)
def weigh_faces(roles, octants, excluded, resistance, normal, shear, least, mass, inverse):
    """Liquid share of the solved faces, at least `least`, and 1 / diagonal; 0 where there is no liquid."""
    _, nx, ny, nz = roles.shape
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                for a in range(3):
                    if roles[a, i, j, k] != SOLVED:
                        continue
                    x, y, z = (1 if a == 0 else 0), (1 if a == 1 else 0), (1 if a == 2 else 0)
                    share, _ = control_share(octants, excluded, resistance, i, j, k, x, y, z)
                    stiffness = normal[a, i, j, k] + normal[a, i - x, j - y, k - z]
                    for b in range(3):
                        if b == a:
                            continue
                        # the edges along b lie towards the third axis
                        c = 3 - a - b
                        stiffness += shear[b, i, j, k]
                        stiffness += shear[b, i + (c == 0), j + (c == 1), k + (c == 2)]
                    if share > 0.0 or stiffness > 0.0:
                        mass[a, i, j, k] = max(share, least)
                        inverse[a, i, j, k] = 1.0 / (max(share, least) + stiffness)


@njit(parallel=True, cache=True)
def apply(x, out, mass, normal, shear, first, last):
    """out = A x on the solved faces (0 elsewhere), for x that holds the fixed velocities too; returns x . out."""
    u, v, w = x[0], x[1], x[2]
    xx, yy, zz = normal[0], normal[1], normal[2]
    yz, xz, xy = shear[0], shear[1], shear[2]
    nx, ny, _ = u.shape
    rows = np.zeros(nx)
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        dot = 0.0
        for j in range(1, ny - 1):
            low, high = np.int64(first[i, j]), np.int64(last[i, j])
            for k in range(low, high):
                m = mass[0, i, j, k]
                here = u[i, j, k]
                total = (
                    m * here
                    + xx[i - 1, j, k] * (here - u[i - 1, j, k])
                    - xx[i, j, k] * (u[i + 1, j, k] - here)
                    + xy[i, j, k] * (here - u[i, j - 1, k] + v[i, j, k] - v[i - 1, j, k])
                    - xy[i, j + 1, k] * (u[i, j + 1, k] - here + v[i, j + 1, k] - v[i - 1, j + 1, k])
                    + xz[i, j, k] * (here - u[i, j, k - 1] + w[i, j, k] - w[i - 1, j, k])
                    - xz[i, j, k + 1] * (u[i, j, k + 1] - here + w[i, j, k + 1] - w[i - 1, j, k + 1])
                )
                total = total if m > 0.0 else 0.0
                out[0, i, j, k] = total
                dot += here * total
            for k in range(low, high):
                m = mass[1, i, j, k]
                here = v[i, j, k]
                total = (
                    m * here
                    + yy[i, j - 1, k] * (here - v[i, j - 1, k])
                    - yy[i, j, k] * (v[i, j + 1, k] - here)
                    + xy[i, j, k] * (here - v[i - 1, j, k] + u[i, j, k] - u[i, j - 1, k])
                    - xy[i + 1, j, k] * (v[i + 1, j, k] - here + u[i + 1, j, k] - u[i + 1, j - 1, k])
                    + yz[i, j, k] * (here - v[i, j, k - 1] + w[i, j, k] - w[i, j - 1, k])
                    - yz[i, j, k + 1] * (v[i, j, k + 1] - here + w[i, j, k + 1] - w[i, j - 1, k + 1])
                )
                total = total if m > 0.0 else 0.0
                out[1, i, j, k] = total
                dot += here * total
            for k in range(low, high):
                m = mass[2, i, j, k]
                here = w[i, j, k]
                total = (
                    m * here
                    + zz[i, j, k - 1] * (here - w[i, j, k - 1])
                    - zz[i, j, k] * (w[i, j, k + 1] - here)
                    + xz[i, j, k] * (here - w[i - 1, j, k] + u[i, j, k] - u[i, j, k - 1])
                    - xz[i + 1, j, k] * (w[i + 1, j, k] - here + u[i + 1, j, k] - u[i + 1, j, k - 1])
                    + yz[i, j, k] * (here - w[i, j - 1, k] + v[i, j, k] - v[i, j, k - 1])
                    - yz[i, j + 1, k] * (w[i, j + 1, k] - here + v[i, j + 1, k] - v[i, j + 1, k - 1])
                )
                total = total if m > 0.0 else 0.0
                out[2, i, j, k] = total
                dot += here * total
        rows[i] = dot
    return rows.sum()


@njit(parallel=True, cache=True)
def descend(x, r, direction, q, step, mass, first, last):
    """x += step direction, r -= step q; returns r . r and |mass x|^2 of the solved faces."""
    _, nx, ny, _ = x.shape
    residuals, momenta = np.zeros(nx), np.zeros(nx)
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        squared, momentum = 0.0, 0.0
        for a in range(3):
            for j in range(1, ny - 1):
                for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                    x[a, i, j, k] += step * direction[a, i, j, k]
                    r[a, i, j, k] -= step * q[a, i, j, k]
                    squared += r[a, i, j, k] * r[a, i, j, k]
                    moved = mass[a, i, j, k] * x[a, i, j, k]
                    momentum += moved * moved
        residuals[i], momenta[i] = squared, momentum
    return residuals.sum(), momenta.sum()


@njit(parallel=True, cache=True)
def scale_into(r, a, scale, rhs, x, first, last):
    """rhs = scale r[a] for a V-cycle that starts from x = 0."""
    _, nx, ny, _ = r.shape
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        for j in range(1, ny - 1):
            for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                rhs[i, j, k] = scale * r[a, i, j, k]
                x[i, j, k] = 0.0


@njit(parallel=True, cache=True)
def scale_by(r, inverse, z, first, last):
    """z = r / diagonal."""
    _, nx, ny, _ = r.shape
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        for a in range(3):
            for j in range(1, ny - 1):
                for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                    z[a, i, j, k] = r[a, i, j, k] * inverse[a, i, j, k]


@njit(parallel=True, cache=True)
def dot(r, x, y, z, first, last):
    """r . (x, y, z)."""
    _, nx, ny, _ = r.shape
    rows = np.zeros(nx)
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        total = 0.0
        for j in range(1, ny - 1):
            for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                total += r[0, i, j, k] * x[i, j, k] + r[1, i, j, k] * y[i, j, k] + r[2, i, j, k] * z[i, j, k]
        rows[i] = total
    return rows.sum()


@njit(parallel=True, cache=True)
def turn(direction, x, y, z, factor, first, last):
    """direction = (x, y, z) + factor direction."""
    _, nx, ny, _ = direction.shape
    for i_ in prange(1, nx - 1):
        i = np.int64(i_)
        for j in range(1, ny - 1):
            for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                direction[0, i, j, k] = x[i, j, k] + factor * direction[0, i, j, k]
                direction[1, i, j, k] = y[i, j, k] + factor * direction[1, i, j, k]
                direction[2, i, j, k] = z[i, j, k] + factor * direction[2, i, j, k]
