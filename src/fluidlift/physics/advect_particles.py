"""Particle advection in a substep: second-order Runge-Kutta (RK2, midpoint), and which particles leave the box."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.numerics.sharing import shared
from fluidlift.physics.boundaries import Walls
from fluidlift.types import CellType

BLOCK = 4096


@shared(lambda velocities, affine, dt, moves, farthest: (0, len(farthest)))
def _displace(begin, end, velocities, affine, dt, moves, farthest):
    n = len(velocities)
    step = np.float32(dt)
    half = np.float32(0.5 * dt)
    for block in range(begin, end):
        largest = np.float32(0.0)
        first = block * BLOCK
        for p in range(first, min(first + BLOCK, n)):
            x, y, z = velocities[p, 0], velocities[p, 1], velocities[p, 2]
            for a in range(3):
                gained = affine[p, a, 0] * x + affine[p, a, 1] * y + affine[p, a, 2] * z
                move = step * (velocities[p, a] + half * gained)
                moves[p, a] = move
                # not a number stays not a number: a comparison would hide it
                largest = max(largest, abs(move)) if move == move and largest == largest else np.float32(np.nan)
        farthest[block] = largest


def displacements(
    velocities: Float[np.ndarray, "n 3"], affine: Float[np.ndarray, "n 3 3"], dt: float
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """RK2 displacement dt (v + dt/2 C v) in m: the velocity half way, by the affine matrix; and its largest component.

    The largest component is not a number where any displacement is not one.
    """
    moves = np.empty((len(velocities), 3), np.float32)
    farthest = np.zeros((len(velocities) + BLOCK - 1) // BLOCK, np.float32)
    _displace(velocities, affine, dt, moves, farthest)
    return moves, float(farthest.max(initial=0.0))


def displacements_plain(
    velocities: Float[np.ndarray, "n 3"], affine: Float[np.ndarray, "n 3 3"], dt: float
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """`displacements` as the formula reads."""
    v, c = velocities.astype(np.float64), affine.astype(np.float64)
    moves = dt * (v + 0.5 * dt * np.einsum("nij,nj->ni", c, v))
    return moves, float(np.abs(moves).max(initial=0.0))


@shared(lambda before, after, *_: (0, len(after)))
def _mark_leaving(begin, end, before, after, regions, low, high, h, mainstream, out):
    inverse = 1.0 / h
    outflow = np.uint8(CellType.OUTFLOW)
    nx, ny, nz = regions.shape
    for p in range(begin, end):
        gone = False
        for a in range(3):
            gone |= not (after[p, a] >= low[a] and after[p, a] < high[a])
        out[p] = gone
        if gone:
            continue
        i = min(max(np.int64(np.floor((before[p, 0] - low[0]) * inverse)), 0), nx - 1)
        j = min(max(np.int64(np.floor((before[p, 1] - low[1]) * inverse)), 0), ny - 1)
        k = min(max(np.int64(np.floor((before[p, 2] - low[2]) * inverse)), 0), nz - 1)
        if regions[i, j, k] != outflow:
            continue
        i = min(max(np.int64(np.floor((after[p, 0] - low[0]) * inverse)), 0), nx - 1)
        j = min(max(np.int64(np.floor((after[p, 1] - low[1]) * inverse)), 0), ny - 1)
        k = min(max(np.int64(np.floor((after[p, 2] - low[2]) * inverse)), 0), nz - 1)
        if regions[i, j, k] == outflow:
            continue
        along = 0.0
        for a in range(3):
            along += (after[p, a] - before[p, a]) * mainstream[a]
        out[p] = along > 0.0


def leaving(
    before: Float[np.ndarray, "n 3"],
    after: Float[np.ndarray, "n 3"],
    walls: Walls,
    mainstream: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, " n"]:
    """Particles that are now out of the box, or have left the OUTFLOW cells along the mainstream."""
    grid = walls.grid
    out = np.empty(len(after), bool)
    _mark_leaving(before, after, walls.regions, grid.low, grid.high, grid.spacing, np.asarray(mainstream, float), out)
    return out


def leaving_plain(
    before: Float[np.ndarray, "n 3"],
    after: Float[np.ndarray, "n 3"],
    walls: Walls,
    mainstream: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, " n"]:
    """`leaving` as it reads."""
    out = ~walls.grid.contains(after)
    last = np.asarray(walls.grid.shape) - 1
    outflow = walls.regions == CellType.OUTFLOW
    was, now = (outflow[tuple(np.clip(walls.grid.cell_of(x), 0, last).T)] for x in (before, after))
    crossed = was & ~now
    out[crossed] |= (after - before)[crossed] @ np.asarray(mainstream) > 0
    return out
