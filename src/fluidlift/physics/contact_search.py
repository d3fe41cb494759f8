"""Collision detection: where surfaces of rigid bodies are near something they may not enter.

Points on the surface of a body meet the signed distance of terrain, box sides and other bodies. Where the surface is
smooth the point moves along the largest ball that touches it from inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from fluidlift.numerics.signed_distance import distance_and_gradient
from fluidlift.physics.boundaries import Walls
from fluidlift.physics.rigid_shapes import Shapes, body_distance, near_body

FIXED = 7
"""partners below this are not bodies: 0 terrain, 1 to 6 the sides of the box (axis, low before high)"""


@dataclass(frozen=True)
class Contacts:
    """n places where the surface point of a body is near something else."""

    keys: Int[np.ndarray, " n"]
    """which surface point meets which partner, the same from step to step; ascending"""
    first: Int[np.ndarray, " n"]
    """the body of the surface point"""
    second: Int[np.ndarray, " n"]
    """the other body, or -1"""
    points: Float[np.ndarray, "n 3"]
    """m"""
    normals: Float[np.ndarray, "n 3"]
    """unit vectors towards the first body"""
    gaps: Float[np.ndarray, " n"]
    """m"""

    def __len__(self) -> int:
        return len(self.keys)


@dataclass(frozen=True)
class SurfacePoints:
    """Points of all bodies, one body after the other, in the bodies' frames.

    Where the surface is smooth a point stands for the largest ball inside the body that touches the surface there:
    within `turn` of its normal the contact lies on that ball. So balls and cylinders roll without bumps.
    """

    points: Float[np.ndarray, "m 3"]
    """m"""
    start: Int[np.ndarray, " b+1"]
    normals: Float[np.ndarray, "m 3"]
    """unit vectors out of the body"""
    radii: Float[np.ndarray, " m"]
    """m, 0 at edges and corners"""
    cosines: Float[np.ndarray, " m"]
    """of `turn`, the angle to the next points"""


@njit(cache=True)
def _touching_balls(shapes, points, start, spacing, normals, radii, cosines):
    for b in range(len(start) - 1):
        step = 0.5 * shapes.spacing[b]
        for p in range(start[b], start[b + 1]):
            x, y, z = points[p]
            _, gx, gy, gz = body_distance(shapes, b, x, y, z)
            length = np.sqrt(gx * gx + gy * gy + gz * gz)
            radii[p], cosines[p] = 0.0, 1.0
            if length < 0.5:
                continue
            gx, gy, gz = gx / length, gy / length, gz / length
            normals[p, 0], normals[p, 1], normals[p, 2] = gx, gy, gz
            radius = 0.0
            while True:
                r = radius + step
                value, _, _, _ = body_distance(shapes, b, x - r * gx, y - r * gy, z - r * gz)
                # the field's own error at the middle of a ball is about half of its spacing
                if abs(value + r) > step:
                    break
                radius = r
            # a sharp edge passes this test for a ball of about the field's spacing
            if radius > 1.5 * spacing[b]:
                radii[p], cosines[p] = radius, np.cos(min(1.2 * spacing[b] / radius, 1.0))


def spread_points(shapes: Shapes, points: list[np.ndarray], spacing: Float[np.ndarray, " b"]) -> SurfacePoints:
    """Surface points of all bodies with the balls that touch there.

    Args:
        shapes: of the bodies, not yet posed (world and body frames agree).
        points: [k,3] m per body, from `solid_mesh.surface_points`.
        spacing: m per body, between its points.
    """
    start = np.cumsum([0, *(len(p) for p in points)]).astype(np.int64)
    joined = np.concatenate([np.zeros((0, 3)), *points])
    normals, radii, cosines = np.zeros_like(joined), np.empty(len(joined)), np.empty(len(joined))
    _touching_balls(shapes, joined, start, np.asarray(spacing, np.float64), normals, radii, cosines)
    return SurfacePoints(joined, start, normals, radii, cosines)


@njit(cache=True)
def _beyond(x, y, z, low, high, open_sides):
    """How far (m) a point is outside of the box's open sides; 0 inside."""
    out = 0.0
    for axis in range(3):
        along = x if axis == 0 else (y if axis == 1 else z)
        if open_sides[axis, 0]:
            out += max(low[axis] - along, 0.0)
        if open_sides[axis, 1]:
            out += max(along - high[axis], 0.0)
    return out


@njit(cache=True)
def _meet(shapes, partner, x, y, z, field, low, high, inverse, open_sides, out):
    """Gap (m) between a point and a partner; its gradient goes to `out`."""
    if partner >= FIXED:
        gap, out[0], out[1], out[2] = body_distance(shapes, partner - FIXED, x, y, z)
    elif partner == 0:
        gap, out[0], out[1], out[2] = distance_and_gradient(field, low, inverse, x, y, z)
        gap += _beyond(x, y, z, low, high, open_sides)  # the field ends at the box, with the value of its last node
    else:
        axis, side = (partner - 1) // 2, (partner - 1) % 2
        along = x if axis == 0 else (y if axis == 1 else z)
        gap = along - low[axis] if side == 0 else high[axis] - along
        out[:] = 0.0
        out[axis] = 1.0 if side == 0 else -1.0
    return gap


@njit(cache=True)
def _partners(shapes, a, free, reach, slack, low, high, open_sides, out):
    """Partners that the box around body a comes near to; returns their number."""
    count = 0
    for partner in range(FIXED + len(free)):
        other = partner - FIXED
        near = partner == 0 and free[a]
        if 0 < partner < FIXED:
            axis, side = (partner - 1) // 2, (partner - 1) % 2
            if side == 0:
                near = shapes.box_low[a, axis] - low[axis] < reach[a] + slack
            else:
                near = high[axis] - shapes.box_high[a, axis] < reach[a] + slack
            near = near and free[a] and not open_sides[axis, side]
        elif partner >= FIXED and other != a and (free[a] or free[other]):
            near = True
            limit = reach[a] + reach[other] + slack
            for axis in range(3):
                near = near and shapes.box_low[a, axis] - shapes.box_high[other, axis] < limit
                near = near and shapes.box_low[other, axis] - shapes.box_high[a, axis] < limit
        if near:
            out[count] = partner
            count += 1
    return count


@njit(cache=True)
def _find(shapes, points, start, normals, radii, cosines, free, reach, field, regions, low, high, h, open_sides,
          out_key, out_int, out):  # fmt: skip
    """Contacts in the order of points and partners; returns their number, which may exceed the room."""
    count, bodies = 0, len(start) - 1
    inverse = 1.0 / h
    n = np.empty(3)
    partners = np.empty(FIXED + bodies, np.int64)
    for a in range(bodies):
        r = shapes.rotation[a]
        slack = 0.0
        for p in range(start[a], start[a + 1]):
            slack = max(slack, radii[p] * (1.0 - cosines[p]))
        near = _partners(shapes, a, free, reach, slack, low, high, open_sides, partners)
        if near == 0:
            continue
        for p in range(start[a], start[a + 1]):
            x, y, z = _turned_by(r, points[p])
            x, y, z = x + shapes.translation[a, 0], y + shapes.translation[a, 1], z + shapes.translation[a, 2]
            ball = radii[p]
            lower = ball * (1.0 - cosines[p])  # how much lower than the point its ball may reach
            for m in range(near):
                partner = partners[m]
                limit = reach[a] + (reach[partner - FIXED] if partner >= FIXED else 0.0)
                if partner >= FIXED and not near_body(shapes, partner - FIXED, x, y, z, limit + lower):
                    continue
                gap = _meet(shapes, partner, x, y, z, field, low, high, inverse, open_sides, n)
                length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
                # in the middle of a solid no way out is to be seen
                if gap >= limit + lower or length < 0.3:
                    continue
                n /= length
                px, py, pz = x, y, z
                if ball > 0.0:
                    mx, my, mz = _turned_by(r, normals[p])
                    if -(mx * n[0] + my * n[1] + mz * n[2]) > cosines[p]:
                        px, py, pz = x - ball * (mx + n[0]), y - ball * (my + n[1]), z - ball * (mz + n[2])
                        gap = _meet(shapes, partner, px, py, pz, field, low, high, inverse, open_sides, n)
                        n /= max(np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), 0.1)
                if gap >= limit or (0 < partner < FIXED and _region(regions, low, inverse, px, py, pz) >= 3):
                    continue  # bodies leave through inlet and outlet
                if count < len(out_key):
                    out_key[count] = np.int64(p) * (FIXED + bodies) + partner
                    out_int[count, 0] = a
                    out_int[count, 1] = max(partner - FIXED, -1)
                    out[count, 0], out[count, 1], out[count, 2] = px, py, pz
                    out[count, 3], out[count, 4], out[count, 5] = n[0], n[1], n[2]
                    out[count, 6] = gap
                count += 1
    return count


@njit(cache=True)
def _turned_by(r, q):
    return (
        r[0, 0] * q[0] + r[0, 1] * q[1] + r[0, 2] * q[2],
        r[1, 0] * q[0] + r[1, 1] * q[1] + r[1, 2] * q[2],
        r[2, 0] * q[0] + r[2, 1] * q[1] + r[2, 2] * q[2],
    )


@njit(cache=True)
def _region(regions, low, inverse, x, y, z):
    i = min(max(np.int64(np.floor((x - low[0]) * inverse)), 0), regions.shape[0] - 1)
    j = min(max(np.int64(np.floor((y - low[1]) * inverse)), 0), regions.shape[1] - 1)
    k = min(max(np.int64(np.floor((z - low[2]) * inverse)), 0), regions.shape[2] - 1)
    return regions[i, j, k]


def find_contacts(
    shapes: Shapes, surface: SurfacePoints, free: np.ndarray, walls: Walls, reach: Float[np.ndarray, " b"]
) -> Contacts:
    """Surface points closer than `reach` (m, per body; two bodies: the sum) to anything they may not enter.

    Args:
        shapes: in their poses.
        surface: points of all bodies.
        free: bool [b]: bodies that can be pushed; pairs without one do not count.
        walls: terrain and box, without bodies.
        reach: about the way of a body within a step.
    """
    grid, room = walls.grid, 1024
    while True:
        keys, ints, numbers = np.empty(room, np.int64), np.empty((room, 2), np.int64), np.empty((room, 7))
        n = _find(
            shapes, surface.points, surface.start, surface.normals, surface.radii, surface.cosines, free, reach,
            walls.signed_distance, walls.regions, grid.low, grid.high, grid.spacing, walls.open_sides, keys, ints,
            numbers,
        )  # fmt: skip
        if n <= room:
            break
        room = n
    return Contacts(keys[:n], ints[:n, 0], ints[:n, 1], numbers[:n, :3], numbers[:n, 3:6], numbers[:n, 6])
