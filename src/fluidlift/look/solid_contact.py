"""A liquid's surface carried on to the solid that it meets.

Particles keep off solids by up to a cell, since a solid takes whole cells of a grid, and what is made of them ends
there: around a rock in a pond stands a dry ring. Liquid that lies on a bed has no such gap: the plane of its surface
goes on to where the ground comes out of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import cKDTree

from fluidlift.look.liquid import SurfaceBuffer
from fluidlift.look.outlet_section import OpenEnd
from fluidlift.look.smoothstep import smoothstep
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.terrain import Terrain

BELL = 0.5
"""of the reach: standard deviation of the weights of what is around, whose plane goes on"""
FEW = (0.02, 0.1)
"""share of what is around, by these weights, that must be liquid, and ground that stands out of its plane, for that to
begin to be, and to be, seen: beside a straight edge the reach and 0.64 of it"""
BETWEEN = (0.3, 0.7)
"""cosine between the ways towards that liquid and away from the ground that stands out of the plane, from which a pixel
begins to be, and is, between both. Where none does, as along a stream's open end, liquid ends as it is"""
LEVEL = (0.6, 0.9)
"""upward part of normals from which on liquid goes on, in part and whole: no fall does, nor the face of an open end"""
SAMPLES = 3.0
"""px in a standard deviation at which the means are taken: they change slowly"""
RIM = (0.8, 2.2)
"""cells from the ground up to which, and from which on, the surface is a rim, and is not: there it is rounded by the
particles that it is made of, and mirrors the sun all along a shore"""
FAR = (3.0, 6.0)
"""cells to the liquid beside it from which on a rim keeps its own normals, in part and whole: a film is all rim"""
BESIDE = 48
"""vertices of it whose mean normal that is: single ones glitter"""
CUT = 0.6
"""cells before a section up to which its edge rounds the normals"""
DEEPER = 1.5
"""of the thickness around, up to which (and the reach) it may be thicker here: over an edge, where the ground falls
off, liquid does not go on level"""


def carried_on(
    surface: SurfaceBuffer, ground: Float[np.ndarray, "h w"], camera: PinholeCamera, reach: float
) -> SurfaceBuffer:
    """The surface with its plane as far as ground that stands out of it within `reach`.

    In a plane n . p = 1 inverse depth is n . (x/z, y/z, 1), so that the mean of planes is one of their n. New liquid
    is as thick as the ground leaves room.

    Args:
        surface: of liquid that lies on the ground.
        ground: camera z, m; 0: none, where nothing is added.
        camera: who looks.
        reach: m.
    """
    import cv2

    there = (surface.depth > 0) & (surface.covered > 0)
    open_ = (surface.covered < 1) & (ground > 0)
    if not there.any() or not open_.any():
        return surface
    sigma = BELL * reach * max(camera.focal) / float(np.median(surface.depth[there]))
    sigma = min(sigma, 0.05 * max(camera.size))
    step = max(1, round(sigma / SAMPLES))
    each = slice(step // 2, None, step)
    some = (each, each)
    grid = camera.pixel_grid()
    rays = camera.rays(grid[some])
    planes, weight = _planes(surface, there, rays, some)
    known = [surface.normal[some], surface.albedo[some], surface.thickness[some][..., None]]
    layers = np.concatenate([weight[..., None], planes, *(weight[..., None] * k for k in known)], axis=-1)
    layers = [cv2.GaussianBlur(k.astype(np.float32), (0, 0), sigma / step) for k in np.moveaxis(layers, -1, 0)]
    wet = layers[0]
    inverse = np.einsum("khw,hwk->hw", np.stack(layers[1:4]), rays) / np.maximum(wet, 1e-6)
    out = (ground[some] > 0) & (inverse * ground[some] <= 1.0) & (inverse > 0) & (wet > 0.1 * FEW[0])
    shore = cv2.GaussianBlur(out.astype(np.float32), (0, 0), sigma / step)
    ways = np.array([np.gradient(wet), np.gradient(shore)])
    length = np.maximum(np.linalg.norm(ways, axis=1), 1e-9)
    between = smoothstep(-(ways[0] * ways[1]).sum(axis=0) / (length[0] * length[1]), *BETWEEN)
    share = smoothstep(wet, *FEW) * smoothstep(shore, *FEW) * between
    around = (ndimage.maximum_filter(share, 3) > 0).astype(np.float32)
    near = cv2.resize(around, camera.size, interpolation=cv2.INTER_NEAREST)
    pixels = np.argwhere(open_ & (near > 0))
    if not len(pixels):
        return surface
    at = (pixels.T - step // 2) / step
    found = np.stack([ndimage.map_coordinates(k, at, order=1, mode="nearest") for k in (*layers, share)], axis=-1)
    return _filled(surface, ground, pixels, found, camera.rays(grid[tuple(pixels.T)]), reach)


def settled(
    points: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    terrain: Terrain,
    ends: Sequence[OpenEnd] = (),
) -> Float[np.ndarray, "v 3"]:
    """Normals of a surface with those of the liquid beside it along its rim on the ground: water wets its shore, and
    does not lie on it like a drop. At the sections of open ends it keeps its own.

    Args:
        points: of the surface, m.
        normals: unit, outward.
        terrain: that it lies on.
        ends: where it is cut.
    """
    points = np.asarray(points)
    distance = sample_nodes(terrain.signed_distance, terrain.grid, points) / terrain.grid.spacing
    level = normals[:, 2] > LEVEL[0]
    inner = np.flatnonzero(level & (distance > RIM[1]))
    rim = (normals[:, 2] > 0.0) & (distance < RIM[1])
    for end in ends:
        rim &= points @ end.along - end.at < -CUT * end.spacing
    rim = np.flatnonzero(rim)
    if not len(inner) or not len(rim):
        return normals
    found = cKDTree(points[inner]).query(points[rim], k=min(BESIDE, len(inner)))
    away, nearest = (np.asarray(part).reshape(len(rim), -1) for part in found)
    beside = normals[inner[nearest]].mean(axis=1)
    share = 1.0 - smoothstep(distance[rim].astype(np.float32), *RIM)
    share = share * (1.0 - smoothstep((away[:, 0] / terrain.grid.spacing).astype(np.float32), *FAR))
    out = np.array(normals, np.float32)
    out[rim] += share[:, None] * (beside - out[rim])
    out[rim] /= np.maximum(np.linalg.norm(out[rim], axis=1, keepdims=True), 1e-9)
    return out


def _planes(
    surface: SurfaceBuffer, there: np.ndarray, rays: np.ndarray, some: tuple[slice, slice]
) -> tuple[np.ndarray, np.ndarray]:
    """Planes n [h,w,3] about the eye, n . p = 1, of the surface in some pixels, times their weights; the weights."""
    normal = surface.normal[some]
    weight = np.where(there[some], surface.covered[some] * smoothstep(normal[..., 2], *LEVEL), 0.0)
    facing = np.minimum(np.einsum("hwk,hwk->hw", normal, rays), -1e-3)
    return normal * (weight / np.where(there[some], facing * surface.depth[some], -1.0))[..., None], weight


def _filled(
    surface: SurfaceBuffer, ground: np.ndarray, pixels: np.ndarray, found: np.ndarray, rays: np.ndarray, reach: float
) -> SurfaceBuffer:
    """The surface with new liquid in some pixels (row, column); found: what lies around them."""
    at = tuple(pixels.T)
    around = found[:, 1:11] / np.maximum(found[:, :1], 1e-6)
    inverse = np.maximum(np.einsum("nk,nk->n", around[:, :3], rays), 1e-6)
    thick = (ground[at] - 1.0 / inverse) * np.linalg.norm(rays, axis=1)
    deep = DEEPER * around[:, 9] + reach
    share = found[:, 11] * (1.0 - smoothstep(thick, deep, 2.0 * deep))
    new = (thick > 0) & (share > surface.covered[at])
    at, around = tuple(pixels[new].T), around[new]
    depth, normal, thickness = surface.depth.copy(), surface.normal.copy(), surface.thickness.copy()
    albedo, covered = surface.albedo.copy(), surface.covered.copy()
    depth[at], thickness[at], covered[at] = 1.0 / inverse[new], thick[new], share[new]
    normal[at] = around[:, 3:6] / np.maximum(np.linalg.norm(around[:, 3:6], axis=1, keepdims=True), 1e-9)
    albedo[at] = around[:, 6:9]
    return replace(surface, depth=depth, normal=normal, thickness=thickness, albedo=albedo, covered=covered)
