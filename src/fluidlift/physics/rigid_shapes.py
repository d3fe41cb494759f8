"""Signed distance fields of several bodies in their poses, packed for kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from fluidlift.numerics.mesh_distance import MeshDistance
from fluidlift.numerics.sharing import shared


class Shapes(NamedTuple):
    """n bodies. A point of the body frame lies at rotation x + translation in the world."""

    fields: np.ndarray
    """float32, the node values of all bodies, one after the other"""
    start: np.ndarray
    """int64 [n]: where each begins"""
    counts: np.ndarray
    """int64 [n,3]: nodes"""
    low: np.ndarray
    """[n,3] m, first node in the body frame"""
    spacing: np.ndarray
    """[n] m"""
    rotation: np.ndarray
    """[n,3,3] world from body"""
    translation: np.ndarray
    """[n,3] m"""
    box_low: np.ndarray
    """[n,3] m, box around the body in the world"""
    box_high: np.ndarray


def pack(distances: Sequence[MeshDistance]) -> Shapes:
    """Shapes at the origin; the boxes are empty until the bodies are `posed`."""
    n = len(distances)
    sizes = [d.distance.size for d in distances]
    fields = np.concatenate([np.zeros(0, np.float32), *(d.distance.astype(np.float32).ravel() for d in distances)])
    return Shapes(
        fields,
        (np.cumsum([0, *sizes])[:-1]).astype(np.int64),
        np.array([d.distance.shape for d in distances], np.int64).reshape(n, 3),
        np.array([d.grid.origin for d in distances], np.float64).reshape(n, 3),
        np.array([d.grid.spacing for d in distances], np.float64),
        np.tile(np.eye(3), (n, 1, 1)),
        np.zeros((n, 3)),
        np.full((n, 3), np.inf),
        np.full((n, 3), -np.inf),
    )


def posed(
    shapes: Shapes,
    rotation: Float[np.ndarray, "n 3 3"],
    translation: Float[np.ndarray, "n 3"],
    corners: Sequence[np.ndarray],
) -> Shapes:
    """The shapes in new poses; `corners` [k,3] are points of each body whose hull holds it, body frame."""
    n = len(translation)
    box_low, box_high = np.empty((n, 3)), np.empty((n, 3))
    for b in range(n):
        # sums of products, not matrix products of many points (threaded BLAS)
        world = np.einsum("ij,kj->ki", rotation[b], corners[b]) + translation[b]
        box_low[b], box_high[b] = world.min(axis=0), world.max(axis=0)
    return shapes._replace(
        rotation=np.ascontiguousarray(rotation, np.float64), translation=np.array(translation, np.float64),
        box_low=box_low, box_high=box_high,
    )  # fmt: skip


@njit(cache=True)
def body_distance(shapes, b, x, y, z):
    """Signed distance (m) of body b and its gradient at a point of the world.

    Inside the body's grid the trilinear interpolant; outside it the value at the nearest place of the grid plus the way
    there.
    """
    r = shapes.rotation
    dx, dy, dz = x - shapes.translation[b, 0], y - shapes.translation[b, 1], z - shapes.translation[b, 2]
    inverse = 1.0 / shapes.spacing[b]
    lx = (r[b, 0, 0] * dx + r[b, 1, 0] * dy + r[b, 2, 0] * dz - shapes.low[b, 0]) * inverse
    ly = (r[b, 0, 1] * dx + r[b, 1, 1] * dy + r[b, 2, 1] * dz - shapes.low[b, 1]) * inverse
    lz = (r[b, 0, 2] * dx + r[b, 1, 2] * dy + r[b, 2, 2] * dz - shapes.low[b, 2]) * inverse
    nx, ny, nz = shapes.counts[b, 0], shapes.counts[b, 1], shapes.counts[b, 2]
    px, py, pz = min(max(lx, 0.0), nx - 1.0), min(max(ly, 0.0), ny - 1.0), min(max(lz, 0.0), nz - 1.0)
    i, j, k = min(np.int64(px), nx - 2), min(np.int64(py), ny - 2), min(np.int64(pz), nz - 2)
    fx, fy, fz = px - i, py - j, pz - k
    f = shapes.fields
    o = shapes.start[b] + (i * ny + j) * nz + k
    step = ny * nz
    a00 = f[o] * (1 - fx) + f[o + step] * fx
    a10 = f[o + nz] * (1 - fx) + f[o + step + nz] * fx
    a01 = f[o + 1] * (1 - fx) + f[o + step + 1] * fx
    a11 = f[o + nz + 1] * (1 - fx) + f[o + step + nz + 1] * fx
    low, high = a00 * (1 - fy) + a10 * fy, a01 * (1 - fy) + a11 * fy
    value = low * (1 - fz) + high * fz
    ox, oy, oz = lx - px, ly - py, lz - pz
    away = np.sqrt(ox * ox + oy * oy + oz * oz)
    if away > 0.0:
        value += away * shapes.spacing[b]
        gx, gy, gz = ox / away, oy / away, oz / away
    else:
        gz = (high - low) * inverse
        gy = ((a10 - a00) * (1 - fz) + (a11 - a01) * fz) * inverse
        d0 = (f[o + step] - f[o]) * (1 - fy) + (f[o + step + nz] - f[o + nz]) * fy
        d1 = (f[o + step + 1] - f[o + 1]) * (1 - fy) + (f[o + step + nz + 1] - f[o + nz + 1]) * fy
        gx = (d0 * (1 - fz) + d1 * fz) * inverse
    return (
        value,
        r[b, 0, 0] * gx + r[b, 0, 1] * gy + r[b, 0, 2] * gz,
        r[b, 1, 0] * gx + r[b, 1, 1] * gy + r[b, 1, 2] * gz,
        r[b, 2, 0] * gx + r[b, 2, 1] * gy + r[b, 2, 2] * gz,
    )


@njit(cache=True)
def near_body(shapes, b, x, y, z, reach):
    """Whether a point is within `reach` (m) of the box around body b."""
    return (
        shapes.box_low[b, 0] - reach <= x <= shapes.box_high[b, 0] + reach
        and shapes.box_low[b, 1] - reach <= y <= shapes.box_high[b, 1] + reach
        and shapes.box_low[b, 2] - reach <= z <= shapes.box_high[b, 2] + reach
    )


@shared(lambda shapes, points, *_: (0, len(points)))
def _distances(begin, end, shapes, points, reach, out, owner):
    for p in range(begin, end):
        out[p] = reach
        owner[p] = -1
        x, y, z = np.float64(points[p, 0]), np.float64(points[p, 1]), np.float64(points[p, 2])
        for b in range(len(shapes.start)):
            if near_body(shapes, b, x, y, z, reach):
                value, _, _, _ = body_distance(shapes, b, x, y, z)
                if value < out[p]:
                    out[p] = value
                    owner[p] = b


def distances(
    shapes: Shapes, points: Float[np.ndarray, "n 3"], reach: float
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Distance (m) of points to the nearest body, at most `reach`, and its number (-1: none within reach)."""
    out, owner = np.empty(len(points)), np.empty(len(points), np.int64)
    _distances(shapes, np.ascontiguousarray(points), float(reach), out, owner)
    return out, owner
