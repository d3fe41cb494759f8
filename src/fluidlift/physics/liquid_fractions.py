"""Volume fractions of liquid in the control volumes of the MAC grid, from its signed distance at cell centres.

Every cell is cut into eight octants. The share of liquid in an octant follows from the trilinear distance, taken as
linear inside the octant (the exact cut of a cube by a plane, Scardovelli and Zaleski 2000). The volumes around cell
centres, faces and edges are each made of eight octants, so they tile the same liquid. Octants half a cell wide also see
sheets and threads thinner than a cell.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fluidlift.numerics.sharing import shared

LEAST_SLOPE = 1e-3
"""of the sum of the slopes: a plane that is flatter along an axis counts as this flat (the formula divides by it)"""


@njit(cache=True)
def cut_share(value, a, b, c):
    """Share of a unit cube in which value + (a, b, c) . x < 0, with x from its centre."""
    a, b, c = abs(a), abs(b), abs(c)
    total = a + b + c
    if 2.0 * abs(value) >= total:
        return 1.0 if value < 0.0 else 0.0
    least = LEAST_SLOPE * total
    a, b, c = max(a, least), max(b, least), max(c, least)
    # the smaller part, cut off a corner: {a x + b y + c z < reach}
    reach = 0.5 * (a + b + c) - abs(value)
    part = reach**3
    for m in (a, b, c):
        part -= max(reach - m, 0.0) ** 3
    for m in (a + b, b + c, c + a):
        part += max(reach - m, 0.0) ** 3
    part /= 6.0 * a * b * c
    return 1.0 - part if value < 0.0 else part


@njit(cache=True)
def _same_sign(distance, i, j, k):
    negative = distance[i, j, k] < 0.0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            for dk in range(-1, 2):
                if (distance[i + di, j + dj, k + dk] < 0.0) != negative:
                    return False
    return True


@njit(cache=True)
def _octant_share(d, i, j, k, si, sj, sk):
    """Share of liquid in the octant of cell (i, j, k) towards (si, sj, sk) = +-1: trilinear at its centre."""
    value = 0.0
    gx = 0.0
    gy = 0.0
    gz = 0.0
    for a in range(2):
        wx = 0.25 if a == 1 else 0.75
        for b in range(2):
            wy = 0.25 if b == 1 else 0.75
            for c in range(2):
                wz = 0.25 if c == 1 else 0.75
                q = d[i + a * si, j + b * sj, k + c * sk]
                value += wx * wy * wz * q
                gx += wy * wz * (q if a == 1 else -q)
                gy += wx * wz * (q if b == 1 else -q)
                gz += wx * wy * (q if c == 1 else -q)
    return cut_share(value, 0.5 * gx, 0.5 * gy, 0.5 * gz)


@shared(lambda distance, *_: (1, distance.shape[0] - 1))
def _octants(begin, end, distance, excluded, out):
    _, ny, nz = distance.shape
    for i in range(begin, end):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                if excluded[i, j, k]:
                    continue
                if _same_sign(distance, i, j, k):
                    full = np.float32(1.0) if distance[i, j, k] < 0.0 else np.float32(0.0)
                    for o in range(8):
                        out[i, j, k, o] = full
                    continue
                for o in range(8):
                    si = 1 if o & 4 else -1
                    sj = 1 if o & 2 else -1
                    sk = 1 if o & 1 else -1
                    out[i, j, k, o] = _octant_share(distance, i, j, k, si, sj, sk)


def octant_shares(distance: np.ndarray, excluded: np.ndarray) -> np.ndarray:
    """float32 [nx,ny,nz,8]: liquid in the octants, 4 [x high] + 2 [y high] + [z high].

    Args:
        distance: [nx,ny,nz], negative inside the liquid, any unit. The outermost layer of cells is not cut (0).
        excluded: bool [nx,ny,nz], cells in which nothing can flow: 0.
    """
    out = np.zeros((*distance.shape, 8), np.float32)
    _octants(distance, excluded, out)
    return out


@shared(lambda octants, excluded, *_: (0, excluded.shape[0]))
def _cell_shares(begin, end, octants, excluded, out):
    _, ny, nz = excluded.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                total = np.float32(0.0)
                for o in range(8):
                    total += octants[i, j, k, o]
                out[i, j, k] = np.float32(-1.0) if excluded[i, j, k] else np.float32(0.125) * total


def cell_shares(octants: np.ndarray, excluded: np.ndarray) -> np.ndarray:
    """float32 [nx,ny,nz]: liquid in the cells; -1 in those that are excluded."""
    out = np.empty(excluded.shape, np.float32)
    _cell_shares(octants, excluded, out)
    return out


@njit(cache=True)
def control_share(octants, cells, resistance, i, j, k, across_x, across_y, across_z):
    """Liquid share of a control volume, and its viscosity.

    The volume of cell (i, j, k), moved down by half a cell along the axes `across` (1 or 0): face (1, 0, 0) and so on,
    edge along z (1, 1, 0). Excluded cells do not count. The viscosity is the harmonic mean over the liquid, because
    the shear stress is what is continuous between two liquids; `resistance` is 1 / viscosity per cell.
    """
    least, most, slack, count = np.float32(2.0), np.float32(-1.0), 0.0, 0
    for ci in range(i - across_x, i + 1):
        for cj in range(j - across_y, j + 1):
            for ck in range(k - across_z, k + 1):
                least, most = min(least, cells[ci, cj, ck]), max(most, cells[ci, cj, ck])
                slack += resistance[ci, cj, ck]
                count += 1
    if most <= 0.0:
        return 0.0, 0.0
    if least == 1.0:
        return 1.0, count / slack
    return _mixed_share(octants, cells, resistance, i, j, k, across_x, across_y, across_z)


@njit(cache=True)
def _mixed_share(octants, cells, resistance, i, j, k, across_x, across_y, across_z):
    total, slack, count = 0.0, 0.0, 0
    for ox in range(2):
        ci = i - across_x * (1 - ox)
        for oy in range(2):
            cj = j - across_y * (1 - oy)
            for oz in range(2):
                ck = k - across_z * (1 - oz)
                if cells[ci, cj, ck] < 0.0:
                    continue
                count += 1
                share = octants[ci, cj, ck, 4 * (ox ^ across_x) + 2 * (oy ^ across_y) + (oz ^ across_z)]
                total += share
                slack += share * resistance[ci, cj, ck]
    return (total / count, total / slack) if total > 0.0 else (0.0, 0.0)
