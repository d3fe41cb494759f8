"""No liquid inside rigid bodies: particles are moved out along the distance field, and stop being pressed in.

A particle between a body and the terrain (or the box, or another body) is put out of whichever it is deepest in, again
and again. A gap too thin for that is left sideways, away from the body's middle. Where even that finds no place the
particle is marked for removal.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from fluidlift.numerics.sharing import shared
from fluidlift.numerics.signed_distance import distance_and_gradient
from fluidlift.physics.boundaries import CLEARANCE, Walls
from fluidlift.physics.rigid_shapes import Shapes, body_distance, near_body

TRIES = 12
"""moves out of the deepest solid before the way sideways is tried"""
SIDESTEP = 0.25
"""cells"""
TOUCHING = 0.1
"""cells: particles that have been moved touch what is closer than this"""


@njit(cache=True)
def _deepest(shapes, field, low, inverse, x, y, z, margin):
    """Least distance to bodies and terrain, its gradient, and the body (-1: terrain)."""
    best, gx, gy, gz = distance_and_gradient(field, low, inverse, x, y, z)
    owner = -1
    for b in range(len(shapes.start)):
        if near_body(shapes, b, x, y, z, margin):
            value, bx, by, bz = body_distance(shapes, b, x, y, z)
            if value < best:
                best, gx, gy, gz, owner = value, bx, by, bz, b
    return best, gx, gy, gz, owner


@njit(cache=True)
def _clamped(x, low, high, open_low, open_high, margin):
    if not open_low:
        x = max(x, low + margin)
    if not open_high:
        x = min(x, high - margin)
    return x


@njit(cache=True)
def _inside_box(x, y, z, low, high, open_sides):
    for a in range(3):
        c = x if a == 0 else (y if a == 1 else z)
        if (c <= low[a] and not open_sides[a, 0]) or (c >= high[a] and not open_sides[a, 1]):
            return False
    return True


@njit(cache=True)
def _settle(shapes, field, low, high, inverse, open_sides, x, y, z, margin, tries):
    """Moved out of the deepest solid, `tries` times at most; the last value is the least distance (m) there."""
    value = 0.0
    for _ in range(tries):
        value, gx, gy, gz, _ = _deepest(shapes, field, low, inverse, x, y, z, margin)
        length = np.sqrt(gx * gx + gy * gy + gz * gz)
        if value >= margin or length < 1e-3:
            return x, y, z, value
        # the distance, not a Newton step: where the gradient is short (deep inside) that would go too far
        step = 1.01 * (margin - value) / length
        x = _clamped(x + step * gx, low[0], high[0], open_sides[0, 0], open_sides[0, 1], margin)
        y = _clamped(y + step * gy, low[1], high[1], open_sides[1, 0], open_sides[1, 1], margin)
        z = _clamped(z + step * gz, low[2], high[2], open_sides[2, 0], open_sides[2, 1], margin)
    value, _, _, _, _ = _deepest(shapes, field, low, inverse, x, y, z, margin)
    return x, y, z, value


@njit(cache=True)
def _sideways(shapes, field, low, high, inverse, open_sides, x, y, z, margin, body, normal, center):
    """A free place to the side of a body, searched in four directions along its surface; the last value: found."""
    h = 1.0 / inverse
    dx, dy, dz = x - center[0], y - center[1], z - center[2]
    along = dx * normal[0] + dy * normal[1] + dz * normal[2]
    dx, dy, dz = dx - along * normal[0], dy - along * normal[1], dz - along * normal[2]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length < 1e-3 * h:  # below the very middle: any direction along the surface
        e = np.zeros(3)
        e[np.argmin(np.abs(normal))] = 1.0
        dx, dy, dz = (
            normal[1] * e[2] - normal[2] * e[1],
            normal[2] * e[0] - normal[0] * e[2],
            (normal[0] * e[1] - normal[1] * e[0]),
        )
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / length, dy / length, dz / length
    sx, sy, sz = normal[1] * dz - normal[2] * dy, normal[2] * dx - normal[0] * dz, normal[0] * dy - normal[1] * dx
    reach = 0.0
    for a in range(3):
        reach = max(reach, shapes.box_high[body, a] - shapes.box_low[body, a])
    for n in range(1, np.int64(reach / (SIDESTEP * h)) + 4):
        way = n * SIDESTEP * h
        for turn in range(4):
            p = 1.0 if turn == 0 else (-1.0 if turn == 3 else 0.0)
            q = 1.0 if turn == 1 else (-1.0 if turn == 2 else 0.0)
            ax = _clamped(x + way * (p * dx + q * sx), low[0], high[0], open_sides[0, 0], open_sides[0, 1], margin)
            ay = _clamped(y + way * (p * dy + q * sy), low[1], high[1], open_sides[1, 0], open_sides[1, 1], margin)
            az = _clamped(z + way * (p * dz + q * sz), low[2], high[2], open_sides[2, 0], open_sides[2, 1], margin)
            ax, ay, az, value = _settle(shapes, field, low, high, inverse, open_sides, ax, ay, az, margin, 4)
            if value >= 0.5 * margin:
                return ax, ay, az, True
    return x, y, z, False


@njit(cache=True)
def _stop(velocities, p, nx, ny, nz, sx, sy, sz, value, touching, h, keep):
    """The particle's velocity relative to a solid (s): not into it where it touches, and slower along it near it."""
    rx, ry, rz = velocities[p, 0] - sx, velocities[p, 1] - sy, velocities[p, 2] - sz
    normal = rx * nx + ry * ny + rz * nz
    factor = 1.0 - (1.0 - keep) * min(max(1.0 - value / h, 0.0), 1.0)
    back = max(normal, 0.0) if value < touching else normal
    velocities[p, 0] = sx + factor * (rx - normal * nx) + back * nx
    velocities[p, 1] = sy + factor * (ry - normal * ny) + back * ny
    velocities[p, 2] = sz + factor * (rz - normal * nz) + back * nz


@shared(lambda positions, *_: (0, len(positions)))
def _push(begin, end, positions, velocities, shapes, center, speed, spin, field, low, high, h, open_sides, keep, lost):
    inverse = 1.0 / h
    margin = CLEARANCE * h
    for p in range(begin, end):
        lost[p] = False
        x, y, z = np.float64(positions[p, 0]), np.float64(positions[p, 1]), np.float64(positions[p, 2])
        nearest, body = h, -1
        n = np.zeros(3)
        for b in range(len(shapes.start)):
            if near_body(shapes, b, x, y, z, h):
                value, gx, gy, gz = body_distance(shapes, b, x, y, z)
                if value < nearest:
                    nearest, body = value, b
                    n[0], n[1], n[2] = gx, gy, gz
        if body < 0 or (nearest >= margin and keep >= 1.0):
            continue
        touching = TOUCHING * h if nearest < margin else margin
        if nearest < margin:
            x, y, z, value = _settle(shapes, field, low, high, inverse, open_sides, x, y, z, margin, TRIES)
            fx, fy, fz = np.float32(x), np.float32(y), np.float32(z)
            value, _, _, _, _ = _deepest(shapes, field, low, inverse, np.float64(fx), np.float64(fy), np.float64(fz),
                                         margin)  # fmt: skip
            if value <= 0.0 or not _inside_box(fx, fy, fz, low, high, open_sides):
                n /= max(np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), 1e-6)
                x, y, z, found = _sideways(
                    shapes, field, low, high, inverse, open_sides, x, y, z, margin, body, n, center[body]
                )
                if not found:
                    lost[p] = True
                    continue
                fx, fy, fz = np.float32(x), np.float32(y), np.float32(z)
            positions[p, 0], positions[p, 1], positions[p, 2] = fx, fy, fz
            x, y, z = np.float64(fx), np.float64(fy), np.float64(fz)
        for b in range(len(shapes.start)):
            if not near_body(shapes, b, x, y, z, h):
                continue
            value, gx, gy, gz = body_distance(shapes, b, x, y, z)
            length = np.sqrt(gx * gx + gy * gy + gz * gz)
            if value >= h or length < 1e-3:
                continue
            rx, ry, rz = x - center[b, 0], y - center[b, 1], z - center[b, 2]
            _stop(
                velocities, p, gx / length, gy / length, gz / length,
                speed[b, 0] + spin[b, 1] * rz - spin[b, 2] * ry,
                speed[b, 1] + spin[b, 2] * rx - spin[b, 0] * rz,
                speed[b, 2] + spin[b, 0] * ry - spin[b, 1] * rx,
                value, touching, h, keep,
            )  # fmt: skip
        value, gx, gy, gz = distance_and_gradient(field, low, inverse, x, y, z)
        length = np.sqrt(gx * gx + gy * gy + gz * gz)
        if value < touching and length > 1e-3:
            _stop(velocities, p, gx / length, gy / length, gz / length, 0.0, 0.0, 0.0, value, touching, h, 1.0)


def push_out(
    positions: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    shapes: Shapes,
    motion: tuple[np.ndarray, np.ndarray, np.ndarray],
    walls: Walls,
    *,
    tangential_share: float = 1.0,
) -> Bool[np.ndarray, " n"]:
    """Move particles out of bodies, in place; those for which there is no place left are marked.

    Args:
        positions: float32 m, outside the terrain.
        velocities: float32 m/s. Near a body none points into it, relative to its motion (restitution 0).
        shapes: bodies in their poses.
        motion: centres of mass (m), velocities (m/s) and angular velocities (rad/s) of the bodies, [b,3] each.
        walls: terrain and box, without the bodies.
        tangential_share: share of the tangential velocity relative to a body that survives this step beside it.
    """
    lost = np.zeros(len(positions), bool)
    grid = walls.grid
    _push(
        positions, velocities, shapes, *motion, walls.signed_distance, grid.low, grid.high, grid.spacing,
        walls.open_sides, float(tangential_share), lost,
    )  # fmt: skip
    return lost
