"""Kernels of the coupled viscosity: weights of the stresses, the operator, its smoother, and vector work.

All arrays share one layout: a box of nodes with a ring of ghosts. u[i,j,k] lies between the cells i-1 and i, likewise v
and w, and the edge along z number (i, j) between u[i,j-1] and u[i,j] and between v[i-1,j] and v[i,j]. Components are
stacked: [3, nx, ny, nz]. Only `first <= k < last` of each vertical column is visited.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fluidlift.numerics.sharing import X, Y, Z, in_order, shared
from fluidlift.physics.liquid_fractions import control_share

AIR, SOLVED, FIXED, WALL = 0, 1, 2, 3
"""roles of a face"""

LEAST_GAP = 0.05
"""cells: faces nearer to a wall count as this far from it (conditioning)"""

ONE, TWO, EIGHT = np.uint64(1), np.uint64(2), np.uint64(8)
STAYS, MOVES = X, Y
"""what half a cell does to a control volume along an axis, see `control_share`"""
ZERO, FULL = np.float32(0.0), np.float32(1.0)
"""Unsigned indices need no check for negative ones, and numbers of single precision do not widen what they meet: with
both, the inner loops become vector instructions, five times as fast."""


@njit(cache=True)
def _gap(role_a, role_b, a, b):
    """Cells from a face to the wall that its neighbour lies in, by their clearances; 1 with no wall between them."""
    if (role_a == WALL) == (role_b == WALL):
        return 1.0
    outside, behind = (b, a) if role_a == WALL else (a, b)
    if outside <= behind:
        return 0.5
    return min(max(outside / (outside - behind), LEAST_GAP), 1.0)


@njit(cache=True)
def _normal_factor(roles, clearance, wall_share, a, i, j, k, i1, j1, k1):
    """Of the normal stress between two faces of component a; 0 unless it acts on a solved one."""
    r, s = roles[a, i, j, k], roles[a, i1, j1, k1]
    if r == AIR or s == AIR or (r != SOLVED and s != SOLVED):
        return 0.0
    if r != WALL and s != WALL:
        return 1.0
    return wall_share / _gap(r, s, clearance[a, i, j, k], clearance[a, i1, j1, k1])


@njit(cache=True)
def _shear_factor(roles, clearance, wall_share, a, b, i, j, k, ia, ja, ka, ib, jb, kb):
    """Of the shear stress between the faces (i, j, k) and (ia, ja, ka) of component a, and those of b likewise.

    Beside a wall the velocity drops to the wall's within the gap, and only the liquid in the gap is strained:
    1 / gap in all.
    """
    p, q, r, s = roles[a, i, j, k], roles[a, ia, ja, ka], roles[b, i, j, k], roles[b, ib, jb, kb]
    if p == AIR or q == AIR or r == AIR or s == AIR:
        return 0.0
    if p != SOLVED and q != SOLVED and r != SOLVED and s != SOLVED:
        return 0.0
    if p != WALL and q != WALL and r != WALL and s != WALL:
        return 1.0
    gap = min(
        _gap(p, q, clearance[a, i, j, k], clearance[a, ia, ja, ka]),
        _gap(r, s, clearance[b, i, j, k], clearance[b, ib, jb, kb]),
    )
    return wall_share / gap


@njit(cache=True)
def _acts(roles, i, j, k):
    """Whether a solved face is among those that the stresses of node (i, j, k) join."""
    for a in range(3):
        if roles[a, i, j, k] == SOLVED:
            return True
    if roles[0, i + ONE, j, k] == SOLVED or roles[1, i, j + ONE, k] == SOLVED or roles[2, i, j, k + ONE] == SOLVED:
        return True
    if roles[0, i, j - ONE, k] == SOLVED or roles[0, i, j, k - ONE] == SOLVED or roles[1, i - ONE, j, k] == SOLVED:
        return True
    return roles[1, i, j, k - ONE] == SOLVED or roles[2, i - ONE, j, k] == SOLVED or roles[2, i, j - ONE, k] == SOLVED


@njit(cache=True)
def _uniform_viscosity(cells, resistance, i, j, k):
    """Viscosity of the eight cells around a node if they are full of one liquid, else -1."""
    here = resistance[i, j, k]
    for o in range(EIGHT):
        ci, cj, ck = i - (o >> TWO), j - ((o >> ONE) & ONE), k - (o & ONE)
        if cells[ci, cj, ck] != FULL or resistance[ci, cj, ck] != here:
            return -1.0
    return 1.0 / here


@njit(cache=True)
def _stiffness(octants, cells, resistance, i, j, k, across_x, across_y, across_z):
    """Liquid share times viscosity of a control volume, see `control_share`."""
    share, viscosity = control_share(octants, cells, resistance, i, j, k, across_x, across_y, across_z)
    return share * viscosity


@shared(lambda roles, *_: (1, roles.shape[1] - 1))
def weigh_stresses(begin, end, roles, clearance, octants, cells, resistance, number, wall_share, normal, shear):
    """Weights of the normal stresses xx, yy, zz at cells and of the shear stresses yz, xz, xy at edges.

    normal[a] = 2 V nu dt / h^2 and shear[a] = V nu dt / h^2, where `number` is dt / h^2. A stress that would need the
    velocity of air is left out: the surface is free of it. `clearance` is the distance of the faces from walls, in
    cells, negative inside.
    """
    _, _, ny, nz = roles.shape
    for i_ in range(begin, end):
        i, si = np.uint64(i_), i_
        for j in range(ONE, np.uint64(ny - 1)):
            sj = np.int64(j)
            for k in range(ONE, np.uint64(nz - 1)):
                sk = np.int64(k)
                if not _acts(roles, i, j, k):
                    continue
                u, d, l = i - ONE, j - ONE, k - ONE
                xx = _normal_factor(roles, clearance, wall_share, X, i, j, k, i + ONE, j, k)
                yy = _normal_factor(roles, clearance, wall_share, Y, i, j, k, i, j + ONE, k)
                zz = _normal_factor(roles, clearance, wall_share, Z, i, j, k, i, j, k + ONE)
                yz = number * _shear_factor(roles, clearance, wall_share, Y, Z, i, j, k, i, j, l, i, d, k)
                xz = number * _shear_factor(roles, clearance, wall_share, X, Z, i, j, k, i, j, l, u, j, k)
                xy = number * _shear_factor(roles, clearance, wall_share, X, Y, i, j, k, i, d, k, u, j, k)
                centre = xx + yy + zz
                if centre + yz + xz + xy == 0.0:
                    continue
                viscosity = _uniform_viscosity(cells, resistance, i, j, k)
                if viscosity > 0.0:
                    c = yz_here = xz_here = xy_here = viscosity
                else:
                    c = _stiffness(octants, cells, resistance, si, sj, sk, STAYS, STAYS, STAYS) if centre > 0.0 else 0.0
                    yz_here = (
                        _stiffness(octants, cells, resistance, si, sj, sk, STAYS, MOVES, MOVES) if yz > 0.0 else 0.0
                    )
                    xz_here = (
                        _stiffness(octants, cells, resistance, si, sj, sk, MOVES, STAYS, MOVES) if xz > 0.0 else 0.0
                    )
                    xy_here = (
                        _stiffness(octants, cells, resistance, si, sj, sk, MOVES, MOVES, STAYS) if xy > 0.0 else 0.0
                    )
                c *= 2.0 * number
                normal[0, i, j, k], normal[1, i, j, k], normal[2, i, j, k] = c * xx, c * yy, c * zz
                shear[0, i, j, k], shear[1, i, j, k], shear[2, i, j, k] = yz * yz_here, xz * xz_here, xy * xy_here


@shared(lambda roles, *_: (1, roles.shape[1] - 1))
def weigh_faces(begin, end, roles, octants, cells, resistance, normal, shear, least, mass, inverse):
    """Liquid share of the solved faces, at least `least`, and 1 / diagonal; 0 where there is no liquid."""
    _, _, ny, nz = roles.shape
    for i_ in range(begin, end):
        i = np.uint64(i_)
        for a in range(3):
            x, y, z = np.uint64(a == 0), np.uint64(a == 1), np.uint64(a == 2)
            # the two kinds of edges around the face, and the axis towards which they are neighbours
            b, c = (a + 1) % 3, (a + 2) % 3
            bx, by, bz = np.uint64(b == 0), np.uint64(b == 1), np.uint64(b == 2)
            cx, cy, cz = np.uint64(c == 0), np.uint64(c == 1), np.uint64(c == 2)
            for j in range(ONE, np.uint64(ny - 1)):
                for k in range(ONE, np.uint64(nz - 1)):
                    if roles[a, i, j, k] != SOLVED:
                        continue
                    stiffness = normal[a, i, j, k] + normal[a, i - x, j - y, k - z]
                    stiffness += shear[b, i, j, k] + shear[b, i + cx, j + cy, k + cz]
                    stiffness += shear[c, i, j, k] + shear[c, i + bx, j + by, k + bz]
                    if cells[i, j, k] == FULL and cells[i - x, j - y, k - z] == FULL:
                        share = 1.0
                    else:
                        share, _ = control_share(
                            octants, cells, resistance, np.int64(i), np.int64(j), np.int64(k), np.int64(x), np.int64(y),
                            np.int64(z),
                        )  # fmt: skip
                    if share > 0.0 or stiffness > ZERO:
                        mass[a, i, j, k] = max(share, least)
                        inverse[a, i, j, k] = 1.0 / (max(share, least) + stiffness)


@njit(cache=True)
def _pull_u(x, normal, shear, i, j, k):
    """What the stresses take from the momentum of u[i,j,k]."""
    u, v, w = x[0], x[1], x[2]
    xx, xz, xy = normal[0], shear[1], shear[2]
    here = u[i, j, k]
    return (
        xx[i - ONE, j, k] * (here - u[i - ONE, j, k])
        - xx[i, j, k] * (u[i + ONE, j, k] - here)
        + xy[i, j, k] * (here - u[i, j - ONE, k] + (v[i, j, k] - v[i - ONE, j, k]))
        - xy[i, j + ONE, k] * (u[i, j + ONE, k] - here + (v[i, j + ONE, k] - v[i - ONE, j + ONE, k]))
        + xz[i, j, k] * (here - u[i, j, k - ONE] + (w[i, j, k] - w[i - ONE, j, k]))
        - xz[i, j, k + ONE] * (u[i, j, k + ONE] - here + (w[i, j, k + ONE] - w[i - ONE, j, k + ONE]))
    )


@njit(cache=True)
def _pull_v(x, normal, shear, i, j, k):
    u, v, w = x[0], x[1], x[2]
    yy, yz, xy = normal[1], shear[0], shear[2]
    here = v[i, j, k]
    return (
        yy[i, j - ONE, k] * (here - v[i, j - ONE, k])
        - yy[i, j, k] * (v[i, j + ONE, k] - here)
        + xy[i, j, k] * (here - v[i - ONE, j, k] + (u[i, j, k] - u[i, j - ONE, k]))
        - xy[i + ONE, j, k] * (v[i + ONE, j, k] - here + (u[i + ONE, j, k] - u[i + ONE, j - ONE, k]))
        + yz[i, j, k] * (here - v[i, j, k - ONE] + (w[i, j, k] - w[i, j - ONE, k]))
        - yz[i, j, k + ONE] * (v[i, j, k + ONE] - here + (w[i, j, k + ONE] - w[i, j - ONE, k + ONE]))
    )


@njit(cache=True)
def _pull_w(x, normal, shear, i, j, k):
    u, v, w = x[0], x[1], x[2]
    zz, yz, xz = normal[2], shear[0], shear[1]
    here = w[i, j, k]
    return (
        zz[i, j, k - ONE] * (here - w[i, j, k - ONE])
        - zz[i, j, k] * (w[i, j, k + ONE] - here)
        + xz[i, j, k] * (here - w[i - ONE, j, k] + (u[i, j, k] - u[i, j, k - ONE]))
        - xz[i + ONE, j, k] * (w[i + ONE, j, k] - here + (u[i + ONE, j, k] - u[i + ONE, j, k - ONE]))
        + yz[i, j, k] * (here - w[i, j - ONE, k] + (v[i, j, k] - v[i, j, k - ONE]))
        - yz[i, j + ONE, k] * (w[i, j + ONE, k] - here + (v[i, j + ONE, k] - v[i, j + ONE, k - ONE]))
    )


@njit(cache=True)
def pull_faces(x, normal, shear, axes, i, j, k, out):
    """What the stresses take from the momentum of single faces, given by component and index."""
    for n in range(len(axes)):
        p, q, r = np.uint64(i[n]), np.uint64(j[n]), np.uint64(k[n])
        if axes[n] == 0:
            out[n] = _pull_u(x, normal, shear, p, q, r)
        elif axes[n] == 1:
            out[n] = _pull_v(x, normal, shear, p, q, r)
        else:
            out[n] = _pull_w(x, normal, shear, p, q, r)


@njit(cache=True, fastmath={"reassoc", "contract"})
def _dot_column(x, y, i, j, low, high):
    total = 0.0
    for a in range(3):
        for k in range(low, high):
            total += x[a, i, j, k] * y[a, i, j, k]
    return total


def apply(x, out, mass, normal, shear, first, last):
    """out = A x on the solved faces (0 elsewhere), for x that holds the fixed velocities too; returns x . out."""
    sums = np.zeros(x.shape[1])
    _apply(x, out, mass, normal, shear, first, last, sums)
    return in_order(sums)


@shared(lambda x, *_: (1, x.shape[1] - 1))
def _apply(begin, end, x, out, mass, normal, shear, first, last, sums):
    ny = x.shape[2]
    for i_ in range(begin, end):
        i = np.uint64(i_)
        total = 0.0
        for j in range(ONE, np.uint64(ny - 1)):
            low, high = np.uint64(first[i, j]), np.uint64(last[i, j])
            for k in range(low, high):
                m = mass[0, i, j, k]
                value = m * x[0, i, j, k] + _pull_u(x, normal, shear, i, j, k)
                out[0, i, j, k] = value if m > ZERO else ZERO
            for k in range(low, high):
                m = mass[1, i, j, k]
                value = m * x[1, i, j, k] + _pull_v(x, normal, shear, i, j, k)
                out[1, i, j, k] = value if m > ZERO else ZERO
            for k in range(low, high):
                m = mass[2, i, j, k]
                value = m * x[2, i, j, k] + _pull_w(x, normal, shear, i, j, k)
                out[2, i, j, k] = value if m > ZERO else ZERO
            total += _dot_column(x, out, i, j, low, high)
        sums[i] = total


@shared(lambda x, *_: (1, x.shape[1] - 1))
def residual(begin, end, x, rhs, out, mass, normal, shear, first, last):
    """out = rhs - A x on the solved faces, 0 elsewhere."""
    ny = x.shape[2]
    for i_ in range(begin, end):
        i = np.uint64(i_)
        for j in range(ONE, np.uint64(ny - 1)):
            low, high = np.uint64(first[i, j]), np.uint64(last[i, j])
            for k in range(low, high):
                m = mass[0, i, j, k]
                value = rhs[0, i, j, k] - m * x[0, i, j, k] - _pull_u(x, normal, shear, i, j, k)
                out[0, i, j, k] = value if m > ZERO else ZERO
            for k in range(low, high):
                m = mass[1, i, j, k]
                value = rhs[1, i, j, k] - m * x[1, i, j, k] - _pull_v(x, normal, shear, i, j, k)
                out[1, i, j, k] = value if m > ZERO else ZERO
            for k in range(low, high):
                m = mass[2, i, j, k]
                value = rhs[2, i, j, k] - m * x[2, i, j, k] - _pull_w(x, normal, shear, i, j, k)
                out[2, i, j, k] = value if m > ZERO else ZERO


@shared(lambda x, *_: (1, x.shape[1] - 1))
def half_sweep(begin, end, x, rhs, mass, inverse, normal, shear, axis, color, first, last):
    """Gauss-Seidel on the faces of one component and colour; none of them is a neighbour of another."""
    ny = x.shape[2]
    for i_ in range(begin, end):
        i = np.uint64(i_)
        for j in range(ONE, np.uint64(ny - 1)):
            start, high = np.uint64(first[i, j]), np.uint64(last[i, j])
            start += (i + j + start + np.uint64(color)) & ONE
            if axis == 0:
                for k in range(start, high, TWO):
                    rest = rhs[0, i, j, k] - mass[0, i, j, k] * x[0, i, j, k] - _pull_u(x, normal, shear, i, j, k)
                    x[0, i, j, k] += inverse[0, i, j, k] * rest
            elif axis == 1:
                for k in range(start, high, TWO):
                    rest = rhs[1, i, j, k] - mass[1, i, j, k] * x[1, i, j, k] - _pull_v(x, normal, shear, i, j, k)
                    x[1, i, j, k] += inverse[1, i, j, k] * rest
            else:
                for k in range(start, high, TWO):
                    rest = rhs[2, i, j, k] - mass[2, i, j, k] * x[2, i, j, k] - _pull_w(x, normal, shear, i, j, k)
                    x[2, i, j, k] += inverse[2, i, j, k] * rest


_half_sweep = half_sweep.kernel


@njit(cache=True)
def sweeps_alone(x, rhs, mass, inverse, normal, shear, count, forward, first, last):
    """Whole sweeps without threads, for small grids; backward ones are the adjoint of forward ones."""
    for _ in range(count):
        for s in range(6):
            t = s if forward else 5 - s
            _half_sweep(1, x.shape[1] - 1, x, rhs, mass, inverse, normal, shear, t // 2, t % 2, first, last)


def descend(x, r, direction, q, step, mass, first, last):
    """x += step direction, r -= step q; returns r . r and |mass x|^2 of the solved faces."""
    residuals, momenta = np.zeros((2, x.shape[1]))
    _descend(x, r, direction, q, step, mass, first, last, residuals, momenta)
    return in_order(residuals), in_order(momenta)


@shared(lambda x, *_: (1, x.shape[1] - 1))
def _descend(begin, end, x, r, direction, q, step, mass, first, last, residuals, momenta):
    ny = x.shape[2]
    for i_ in range(begin, end):
        i = np.uint64(i_)
        squared, momentum = 0.0, 0.0
        for a in range(3):
            for j in range(ONE, np.uint64(ny - 1)):
                for k in range(np.uint64(first[i, j]), np.uint64(last[i, j])):
                    x[a, i, j, k] += step * direction[a, i, j, k]
                    r[a, i, j, k] -= step * q[a, i, j, k]
                    squared += r[a, i, j, k] * r[a, i, j, k]
                    moved = mass[a, i, j, k] * x[a, i, j, k]
                    momentum += moved * moved
        residuals[i], momenta[i] = squared, momentum


@shared(lambda r, *_: (1, r.shape[1] - 1))
def scale_into(begin, end, r, scale, inverse, cycles, rhs, z, first, last):
    """Prepare the preconditioner: rhs = scale r and z = 0; or z = scale r / diagonal where there are no cycles."""
    ny = r.shape[2]
    for i_ in range(begin, end):
        i = np.uint64(i_)
        for a in range(3):
            for j in range(ONE, np.uint64(ny - 1)):
                for k in range(np.uint64(first[i, j]), np.uint64(last[i, j])):
                    rhs[a, i, j, k] = scale * r[a, i, j, k]
                    z[a, i, j, k] = 0.0 if cycles else scale * r[a, i, j, k] * inverse[a, i, j, k]


def dot(r, z, first, last):
    """r . z."""
    sums = np.zeros(r.shape[1])
    _dot(r, z, first, last, sums)
    return in_order(sums)


@shared(lambda r, *_: (1, r.shape[1] - 1))
def _dot(begin, end, r, z, first, last, sums):
    ny = r.shape[2]
    for i_ in range(begin, end):
        i = np.uint64(i_)
        total = 0.0
        for j in range(ONE, np.uint64(ny - 1)):
            total += _dot_column(r, z, i, j, np.uint64(first[i, j]), np.uint64(last[i, j]))
        sums[i] = total


@shared(lambda direction, *_: (1, direction.shape[1] - 1))
def turn(begin, end, direction, z, factor, first, last):
    """direction = z + factor direction."""
    ny = direction.shape[2]
    for i_ in range(begin, end):
        i = np.uint64(i_)
        for a in range(3):
            for j in range(ONE, np.uint64(ny - 1)):
                for k in range(np.uint64(first[i, j]), np.uint64(last[i, j])):
                    direction[a, i, j, k] = z[a, i, j, k] + factor * direction[a, i, j, k]
