"""The camera of the synthetic scenes: pictures of a state, and the exact motion of what they show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.synthetic.paint import SUN, GroundPaint, Noise, lit, to_picture
from fluidlift.synthetic.scenes import SyntheticScene
from fluidlift.synthetic.surface import (
    LiquidDensity,
    Neighbours,
    box_range,
    finer,
    open_share,
    see,
    sphere_trace,
)
from fluidlift.types import Grid, PinholeCamera, triple

SUPERSAMPLING = 2
"""rays per pixel and axis of the pictures (the truth has one ray through each pixel centre)"""

VIEW_MARGIN = 1.0
"""m: how far the ground is painted beyond the grid"""


@dataclass(frozen=True)
class GroundRaster:
    """The ground without the liquid on one raster of rays."""

    camera: PinholeCamera
    depth: Float[np.ndarray, " n"]
    """camera z, m; inf where the ray meets nothing"""
    color: Float[np.ndarray, "n 3"]
    """linear, lit and with the shadows of the ground on itself"""

    @property
    def rays(self) -> Float[np.ndarray, "n 3"]:
        """One per raster point, row by row, unit camera depth."""
        return self.camera.rays(self.camera.pixel_grid().reshape(-1, 2))


def backdrop(
    scene: SyntheticScene, camera: PinholeCamera, rng: np.random.Generator, *, colored: bool = True
) -> GroundRaster:
    """Cast one ray per pixel of the camera at the ground."""
    wide = 2 * VIEW_MARGIN
    low = scene.grid.low - VIEW_MARGIN
    span = scene.grid.high - scene.grid.low + wide
    cell = float(span.max())
    box = Grid(triple(max(1, int(np.ceil(s / cell))) for s in span), cell, tuple(low))
    eye, rays = camera.position, camera.rays(camera.pixel_grid().reshape(-1, 2))
    start, stop = box_range(box, eye, rays)
    depth = sphere_trace(scene.ground, eye, rays, start, stop, tolerance=0.02 * scene.grid.spacing)
    color = np.tile([0.35, 0.40, 0.45], (len(rays), 1))
    seen = np.flatnonzero(np.isfinite(depth))
    if not colored or len(seen) == 0:
        return GroundRaster(camera, depth, color)
    points = eye + depth[seen, None] * rays[seen]
    step = 0.15 * scene.grid.spacing
    slope = np.stack([scene.ground(points + e) - scene.ground(points - e) for e in step * np.eye(3)], -1)
    grain = Noise.make(rng, 0.16), Noise.make(rng, 0.35, blur=1.4)
    slope = slope + 0.35 * step * np.stack([grain[0].at(points + o) - 0.5 for o in (0.0, 0.31, 0.77)], -1)
    normals = slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)
    ground = GroundPaint(
        Noise.make(rng, 2.2, blur=2.0), Noise.make(rng, 0.42, blur=0.9), Noise.make(rng, 0.19, blur=0.7)
    )
    color[seen] = lit(ground.color(points, scene.shares(points)), normals, _shadow(scene, points, normals))
    return GroundRaster(camera, depth, color)


def _shadow(scene: SyntheticScene, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """0 in the shadow of the ground, 1 in the sun, soft between (cone tracing on the distance)."""
    at = points + 0.4 * scene.grid.spacing * normals
    light = np.ones(len(points))
    reach = 0.35 * scene.grid.spacing
    travelled = reach
    while travelled < 0.5:
        light = np.minimum(light, np.clip(0.5 + 6.0 * scene.ground(at + travelled * SUN) / travelled, 0, 1))
        travelled += max(reach, 0.18 * travelled)
    return 0.25 + 0.75 * light


def fine_opening(scene: SyntheticScene) -> np.ndarray:
    """Open share of the cells of the fine grid."""
    fine = finer(scene.grid)
    return open_share(scene.solid(fine.centers().reshape(-1, 3)).reshape(fine.shape), fine.spacing)


def paint_liquid(
    scene: SyntheticScene, body: LiquidDensity, behind: GroundRaster, positions: np.ndarray, tracer: np.ndarray
) -> UInt8[np.ndarray, "h w 3"]:
    """A picture on the raster of the backdrop, shrunk by `SUPERSAMPLING`.

    Args:
        scene: the scene.
        body: the liquid.
        behind: the ground.
        positions: of the particles, m [n,3].
        tracer: of the particles [n,2].
    """
    camera = behind.camera
    depth = see(body, camera, camera.pixel_grid().reshape(-1, 2), behind.depth)
    hit = np.flatnonzero(np.isfinite(depth))
    color = behind.color.copy()
    if len(hit):
        rays = behind.rays[hit]
        points = camera.position + depth[hit, None] * rays
        length = np.linalg.norm(rays, axis=-1)
        near = Neighbours.of(points, positions, 0.45 * scene.grid.spacing)
        bottom = np.where(np.isfinite(behind.depth[hit]), behind.depth[hit], depth[hit] + 1.0)
        thickness = (bottom - depth[hit]) * length
        color[hit] = scene.paint.color(
            body.normals(points), rays / length[:, None], thickness, behind.color[hit], near.mean(tracer)
        )
    w, h = camera.size
    k = SUPERSAMPLING
    blocks = color.reshape(h // k, k, w // k, k, 3)
    return to_picture(blocks.mean(axis=(1, 3)))


def surface_depth(body: LiquidDensity, camera: PinholeCamera, wall: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (m, 0 = none) and mask [H,W] of the liquid at the pixel centres, before solids at depth `wall` [n]."""
    depth = see(body, camera, camera.pixel_grid().reshape(-1, 2), wall)
    w, h = camera.size
    mask = np.isfinite(depth).reshape(h, w)
    return np.where(mask, depth.reshape(h, w), 0.0), mask


def screen_motion(
    camera: PinholeCamera,
    depth: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    before: Float[np.ndarray, "n 3"],
    after: Float[np.ndarray, "n 3"],
    radius: float,
) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
    """Where the visible surface goes: the projected displacement (px) and its change of camera z (m).

    A surface point moves with the particles around it (Gaussian weights of width `radius`, m): `before` and `after`
    are positions of the same particles.
    """
    uv = camera.pixel_grid()[mask]
    points = camera.unproject(uv, depth[mask])
    flow, change = np.zeros((*mask.shape, 2)), np.zeros(mask.shape)
    if len(points) and len(before):
        moved = points + Neighbours.of(points, before, radius).mean(after - before)
        there, z = camera.project(moved)
        flow[mask], change[mask] = there - uv, z - depth[mask]
    return flow, change


def still_seen(
    depth: np.ndarray, mask: np.ndarray, flow: np.ndarray, change: np.ndarray, next_depth: np.ndarray, tolerance: float
) -> Bool[np.ndarray, "h w"]:
    """Points whose place in the next frame is inside the picture and within `tolerance` m of the surface there."""
    h, w = mask.shape
    rows, columns = np.nonzero(mask)
    u = columns + 0.5 + flow[mask][:, 0]
    v = rows + 0.5 + flow[mask][:, 1]
    inside = (u >= 0) & (u < w) & (v >= 0) & (v < h)
    i, j = np.clip(v, 0, h - 1).astype(np.int64), np.clip(u, 0, w - 1).astype(np.int64)
    there = next_depth[i, j]
    out = np.zeros(mask.shape, bool)
    out[mask] = inside & (there > 0) & (np.abs(there - depth[mask] - change[mask]) < tolerance)
    return out
