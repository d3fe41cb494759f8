"""The surface of a liquid in a picture: of particles, drawn as spheres and smoothed in the picture, or of a mesh.

Particles: van der Laan, Green and Sainz 2009 (screen-space fluids), smoothed after Truong and Yuksel 2018. A mesh: the
rasteriser of `numerics.triangles`. Both give a `LiquidSurface`, which `liquid.shaded` lights.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.look.liquid import LiquidSurface
from fluidlift.look.screen_space_kernels import (
    narrow_range,
    place_spheres,
    plane_normals,
    smooth_normals,
    sphere_chords,
    sphere_depths,
    spread_edges,
    unit_rows,
)
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.numerics.triangles import NEAR, banded, interpolated, rasterize_closed
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.terrain import TriangleMesh

SPACING = 1.25
"""radii between neighbours: the radius of surfaces is 0.4 cells, and particles lie half a cell apart"""
SMOOTHING = (1.6, 1.0)
"""radii: standard deviations of the passes over the depth; the second takes out the first one's rows and columns"""
LIMIT = 3.0
"""radii: depths farther apart belong to different surfaces"""
FALL = 1.0
"""radii by which a surface falls off beyond its outline, for the smoothing"""
EVEN = 0.8
"""radii: standard deviation of the smoothing of thickness and colour"""
THIN = 0.35
"""radii of thickness from which a pixel counts as covered"""
COARSE = 5.0
"""px: from this median radius on, thickness and colour are summed at half the resolution"""
GRAY = 0.5
"""linear, the carried colour where no colours are given"""


def particle_surface(
    positions: Float[np.ndarray, "n 3"],
    radius: float,
    camera: PinholeCamera,
    colors_linear: Float[np.ndarray, "n 3"] | None = None,
    *,
    spacing: float | None = None,
) -> LiquidSurface:
    """The surface of particles.

    Args:
        positions: m, world. Particles with a number that is not finite are left out, and spheres that reach behind the
            camera.
        radius: m, of the spheres.
        camera: who looks.
        colors_linear: of each particle; None: gray.
        spacing: m between neighbours, which sets what a sphere counts for in the thickness (spheres overlap); None:
            `SPACING` radii.

    Raises:
        ValueError: arrays of the wrong shape or a radius that is not positive.
    """
    points = np.ascontiguousarray(positions, np.float32)
    require(points.ndim == 2 and points.shape[1] == 3, f"positions of shape {points.shape}", "[n, 3]")
    require(np.isfinite(radius) and radius > 0, f"a radius of {radius}", "positive metres")
    colors = np.full(points.shape, GRAY, np.float32) if colors_linear is None else np.asarray(colors_linear, np.float32)
    require(colors.shape == points.shape, f"colours of shape {colors.shape}", str(points.shape))
    spacing = SPACING * radius if spacing is None else spacing
    require(spacing > 0, f"a spacing of {spacing}", "positive metres")
    depth, scale = _sphere_depth(points, radius, camera)
    thickness, albedo = _through_spheres(points, radius, camera, depth, np.ascontiguousarray(colors), scale)
    # spheres overlap: each stands for the volume of a cube of the spacing
    thickness *= np.float32(spacing**3 / (4.0 / 3.0 * math.pi * radius**3))
    inverse = np.where(np.isfinite(depth), 1.0 / np.maximum(depth, NEAR), 0.0).astype(np.float32)
    inverse = _smoothed(inverse, radius, camera)
    covered = np.where(inverse > 0, np.clip(thickness / (THIN * radius), 0.0, 1.0), 0.0)
    normal = np.zeros((*depth.shape, 3), np.float32)
    rotation = np.asarray(camera.camera_from_world.rotation, np.float64)
    plane_normals(inverse, _lens(camera), rotation, np.float32(LIMIT * radius), normal)
    front = np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    return LiquidSurface(front, normal, thickness, albedo, covered)


def _lens(camera: PinholeCamera) -> np.ndarray:
    return np.array([*camera.focal, *camera.center], np.float64)


def _placed(points: np.ndarray, radius: float, camera: PinholeCamera) -> tuple[np.ndarray, ...]:
    """Centres, lists of the bands, and x/z and y/z of the pixels: what the loops over spheres take."""
    centres, box = np.empty((len(points), 3), np.float32), np.empty((len(points), 5), np.int32)
    pose, lens = camera.camera_from_world, _lens(camera)
    rotation, translation = np.asarray(pose.rotation, np.float64), np.asarray(pose.translation, np.float64)
    place_spheres(points, rotation, translation, radius, lens, np.array(camera.size, np.int64), NEAR, centres, box)
    starts, listed = banded(box, camera.size[1])
    across = ((np.arange(camera.size[0]) + 0.5 - lens[2]) / lens[0]).astype(np.float32)
    down = ((np.arange(camera.size[1]) + 0.5 - lens[3]) / lens[1]).astype(np.float32)
    return centres, box, starts, listed, across, down


def _sphere_depth(points: np.ndarray, radius: float, camera: PinholeCamera) -> tuple[np.ndarray, int]:
    """Depth of the nearest sphere (m; infinite: none), and by how much coarser thickness may be summed."""
    centres, box, starts, listed, across, down = _placed(points, radius, camera)
    depth = np.full((camera.size[1], camera.size[0]), np.inf, np.float32)
    sphere_depths(centres, box, starts, listed, radius, across, down, depth)
    drawn = centres[box[:, 4] > 0, 2]
    wide = len(drawn) > 0 and camera.focal[0] * radius / float(np.median(drawn)) >= COARSE
    return depth, 2 if wide and min(camera.size) >= 16 else 1


def _through_spheres(
    points: np.ndarray, radius: float, camera: PinholeCamera, depth: np.ndarray, colors: np.ndarray, scale: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sum of all lengths in spheres (m), and the mean colour near the surface, both evened out."""
    width, height = camera.size
    small = camera if scale == 1 else camera.resized((width // scale, height // scale))
    centres, box, starts, listed, across, down = _placed(points, radius, small)
    sums = np.zeros((5, small.size[1], small.size[0]), np.float32)
    sphere_chords(centres, box, starts, listed, radius, across, down, depth, colors, sums)
    near = depth[np.isfinite(depth)]
    if len(near) == 0:
        return np.zeros(depth.shape, np.float32), np.zeros((*depth.shape, 3), np.float32)
    sigma = min(EVEN * radius * small.focal[0] / float(np.median(near)), 20.0)
    for picture in sums:
        ndimage.gaussian_filter(picture, sigma, output=picture, mode="constant", truncate=2.5)
    sums[1:4] /= np.maximum(sums[4], 1e-12)
    if scale > 1:
        import cv2

        whole = [cv2.resize(picture, (width, height), interpolation=cv2.INTER_LINEAR) for picture in sums[:4]]
        return whole[0], np.stack(whole[1:], axis=-1)
    return sums[0], np.ascontiguousarray(np.moveaxis(sums[1:4], 0, -1))


def _smoothed(inverse: np.ndarray, radius: float, camera: PinholeCamera) -> np.ndarray:
    """Inverse depth (1/m; 0: none) without the bumps of the spheres."""
    limit, fall, other = np.float32(LIMIT * radius), np.float32(FALL * radius), np.empty_like(inverse)
    for share in SMOOTHING:
        narrow_range(inverse, other, 0, 1, camera.focal[0], share * radius, limit, fall)
        narrow_range(other, inverse, 1, 0, camera.focal[1], share * radius, limit, fall)
    return inverse


def mesh_surface(mesh: TriangleMesh, camera: PinholeCamera) -> LiquidSurface:
    """The surface of a closed mesh, with its smooth normals; the colours of its vertices are what it carries.

    Thickness is all of the liquid along the ray, in however many parts. A mesh with holes gives wrong ones there.
    """
    found = rasterize_closed(mesh.vertices, mesh.faces, camera)
    vertices = np.ascontiguousarray(mesh.vertices, np.float32)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    values = np.zeros((len(vertices), 6), np.float32)
    smooth_normals(vertices, faces, values)
    unit_rows(values)
    values[:, 3:] = GRAY if mesh.colors is None else linear_from_srgb(mesh.colors)
    front = interpolated(found.front, values, faces)
    normal, albedo = np.ascontiguousarray(front[..., :3]), np.ascontiguousarray(front[..., 3:])
    back = interpolated(found.back, values[:, :3], faces)
    unit_rows(normal.reshape(-1, 3))
    unit_rows(back.reshape(-1, 3))
    across = (np.arange(camera.size[0]) + 0.5 - camera.center[0]) / camera.focal[0]
    down = (np.arange(camera.size[1]) + 0.5 - camera.center[1]) / camera.focal[1]
    along = np.sqrt(1.0 + across[None, :] ** 2 + down[:, None] ** 2).astype(np.float32)
    thickness = np.maximum(found.inside, 0.0) * along
    covered, depth = np.zeros_like(thickness), found.front.depth
    spread_edges(found.front.hit, depth, normal, thickness, albedo, back, covered)
    return LiquidSurface(depth, normal, thickness, albedo, covered, back)
