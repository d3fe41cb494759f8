"""The surface of a liquid in a picture: of particles, drawn as spheres and smoothed in the picture, or of a mesh.

Particles: van der Laan, Green and Sainz 2009 (screen-space fluids), smoothed after Truong and Yuksel 2018. A mesh: the
rasteriser of `numerics.triangles`. Both give a `SurfaceBuffer`, which `liquid.shaded` lights.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.liquid import SurfaceBuffer
from fluidlift.look.screen_space_kernels import (
    depths_and_cover,
    filled_notches,
    inverse_depths,
    narrow_range,
    plane_normals,
    smooth_normals,
    spread_edges,
    unit_rows,
)
from fluidlift.look.screen_space_spheres import SIDE, place_spheres, sphere_chords, sphere_depths
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.numerics.triangles import NEAR, banded, interpolated, rasterize_closed
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.terrain import TriangleMesh

SPACING = 1.25
"""radii between neighbours: the radius of surfaces is 0.4 cells, and particles lie half a cell apart"""
SMOOTHING = (1.6, 1.0, 0.5)
"""radii: standard deviations of the passes over the depth; the second takes out the first one's rows and columns"""
PER_BELL, BUMP = 1.7, 0.6
"""samples per standard deviation of these passes, at least: sums over a bell are exact from there on; and radii between
samples, at most: half the distance of the spheres, whose bumps would else be taken for a slope"""
FINISH = 0.12
"""radii: standard deviation of a last pass over pixels side by side. Those before it leave some out: pixels between
which none of them mixes come apart beside an edge, as a weave"""
LIMIT = 3.0
"""radii: depths farther apart belong to different surfaces"""
FALL = 1.0
"""radii by which a surface falls off beyond its outline, for the smoothing"""
EVEN = 0.8
"""radii: standard deviation of the smoothing of colour and cover"""
EVEN_THICKNESS = 1.5
"""radii: that of thickness, wider than the particles lie apart: a sum over them shows how they crowd"""
FAR_EVEN = 3.0
"""radii: that of the far side, whose slope would else show how they crowd, in sparks"""
THIN = 0.35
"""radii of thickness from which a pixel counts as covered"""
RIM = (0.42, 0.67)
"""share of what is around a pixel that spheres cover, from which on it belongs to the liquid in part and whole: half at
an outline, which is then smoother than that of the spheres; a sphere alone has 0.54"""
GRAIN = 0.5
"""radii: thinner liquid on the ground is no more than the place of its particles can tell, and fades out"""
NOTCH = 1.0
"""radii of the ball"""
MOST = 12
"""px of it"""
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
    ground: Float[np.ndarray, "h w"] | None = None,
    far_side: bool = False,
) -> SurfaceBuffer:
    """The surface of particles.

    Args:
        positions: m, world. Particles with a number that is not finite are left out, and spheres that reach behind the
            camera.
        radius: m, of the spheres.
        camera: who looks.
        colors_linear: of each particle; None: gray.
        ground: camera z (m; 0: none) of what the liquid lies on. It hides particles, and the surface runs out on it;
            None: every outline is rounded, as of a drop in the air.
        far_side: light leaves a far side bent once more, `thickness` behind the near one: a jet is not seen else. Not
            for liquid that lies on a bed.

    Raises:
        ValueError: arrays of the wrong shape or a radius that is not positive.
    """
    points = np.ascontiguousarray(positions, np.float32)
    require(points.ndim == 2 and points.shape[1] == 3, f"positions of shape {points.shape}", "[n, 3]")
    require(np.isfinite(radius) and radius > 0, f"a radius of {radius}", "positive metres")
    colors = np.zeros((0, 3), np.float32) if colors_linear is None else np.asarray(colors_linear, np.float32)
    fits = colors_linear is None or colors.shape == points.shape
    require(fits, f"colours of shape {colors.shape}", str(points.shape))
    height, width = camera.size[1], camera.size[0]
    bed = np.zeros((height, width), np.float32) if ground is None else np.ascontiguousarray(ground, np.float32)
    require(bed.shape == (height, width), f"ground of shape {bed.shape}", f"({height}, {width})")
    depth, typical = _sphere_depth(points, radius, camera)
    thickness, albedo, near = _through_spheres(points, radius, camera, depth, np.ascontiguousarray(colors), typical)
    # spheres overlap: each stands for the volume of a cube of the spacing
    thickness *= np.float32((SPACING * radius) ** 3 / (4.0 / 3.0 * math.pi * radius**3))
    inverse, normal = np.empty_like(depth), np.zeros((height, width, 3), np.float32)
    inverse_depths(depth, bed, np.float32(NEAR), np.float32(LIMIT * radius), inverse)
    _close_notches(inverse, radius, camera, typical)
    inverse = _smoothed(inverse, radius, camera)
    rotation = np.asarray(camera.camera_from_world.rotation, np.float64)
    plane_normals(inverse, _lens(camera), rotation, np.float32(LIMIT * radius), normal)
    covered = np.empty_like(depth)
    depths_and_cover(inverse, bed, thickness, near, np.array([THIN * radius, *RIM], np.float32), depth, covered)
    back = _far_normals(depth, thickness, covered, camera, radius) if far_side else None
    return SurfaceBuffer(depth, normal, thickness, albedo, covered, back, GRAIN * radius)


def _far_normals(
    depth: np.ndarray, thickness: np.ndarray, covered: np.ndarray, camera: PinholeCamera, radius: float
) -> np.ndarray:
    """Outward normals [h,w,3] of the far side, `thickness` behind the near one; 0 where there is none."""
    import cv2

    there = (covered > 0) & (depth > 0)
    back = np.zeros((*depth.shape, 3), np.float32)
    if not there.any():
        return back
    sigma = min(FAR_EVEN * radius * camera.focal[0] / float(np.median(depth[there])), 0.05 * max(camera.size))
    behind = depth + thickness / np.linalg.norm(camera.rays(camera.pixel_grid()), axis=-1).astype(np.float32)
    inverse = np.where(there, 1.0 / np.maximum(behind, NEAR), 0.0).astype(np.float32)
    share = there.astype(np.float32)
    for layer in (inverse, share):
        cv2.GaussianBlur(layer, (0, 0), sigma, dst=layer, borderType=cv2.BORDER_CONSTANT)
    inverse = np.where(there, inverse / np.maximum(share, 1e-3), 0.0).astype(np.float32)
    rotation = np.asarray(camera.camera_from_world.rotation, np.float64)
    plane_normals(inverse, _lens(camera), rotation, np.float32(LIMIT * radius), back)
    return -back


def _lens(camera: PinholeCamera) -> np.ndarray:
    return np.array([*camera.focal, *camera.center], np.float64)


def _placed(points: np.ndarray, radius: float, camera: PinholeCamera) -> tuple[np.ndarray, ...]:
    """Centres, lists of the bands, and x/z and y/z of the pixels: what the loops over spheres take."""
    centres, box = np.empty((len(points), 3), np.float32), np.empty((len(points), 5), np.int32)
    pose, lens = camera.camera_from_world, _lens(camera)
    rotation, translation = np.asarray(pose.rotation, np.float64), np.asarray(pose.translation, np.float64)
    place_spheres(points, rotation, translation, radius, lens, np.array(camera.size, np.int64), NEAR, centres, box)
    starts, listed = banded(box, camera.size[1])
    across = ((np.arange(camera.size[0] + SIDE) + 0.5 - lens[2]) / lens[0]).astype(np.float32)
    down = ((np.arange(camera.size[1]) + 0.5 - lens[3]) / lens[1]).astype(np.float32)
    return centres, box, starts, listed, across, down


def _sphere_depth(points: np.ndarray, radius: float, camera: PinholeCamera) -> tuple[np.ndarray, float]:
    """Depth of the nearest sphere (m; infinite: none), and the median depth of what is drawn (m; 0: nothing is)."""
    centres, box, starts, listed, across, down = _placed(points, radius, camera)
    depth = np.empty((camera.size[1], camera.size[0]), np.float32)
    sphere_depths(centres, box, starts, listed, radius, across, down, depth)
    drawn = centres[box[:, 4] > 0, 2]
    return depth, float(np.median(drawn)) if len(drawn) else 0.0


def _through_spheres(
    points: np.ndarray, radius: float, camera: PinholeCamera, depth: np.ndarray, colors: np.ndarray, typical: float
) -> tuple[np.ndarray, ...]:
    """Sum of all lengths in spheres (m), the mean colour near the surface, and the share of what is around a pixel that
    spheres cover, all evened out; they change slowly, so that large spheres are summed at half the resolution. typical:
    median depth, m."""
    import cv2

    width, height = camera.size
    if typical <= 0:
        return np.zeros_like(depth), np.full((*depth.shape, 3), GRAY, np.float32), np.zeros_like(depth)
    coarse = camera.focal[0] * radius / typical >= COARSE and min(camera.size) >= 16
    small = camera.resized((width // 2, height // 2)) if coarse else camera
    centres, box, starts, listed, across, down = _placed(points, radius, small)
    sums = np.zeros((6 if len(colors) else 2, small.size[1], small.size[0]), np.float32)
    sphere_chords(centres, box, starts, listed, radius, across, down, depth, colors, sums)
    step = 2 if coarse else 1
    sums[-1] = np.isfinite(depth[: step * small.size[1] : step, : step * small.size[0] : step])
    near = depth[::4, ::4]
    near = near[np.isfinite(near)]
    pixels = radius * small.focal[0] / (float(np.median(near)) if len(near) else typical)
    for k, picture in enumerate(sums):
        sigma = min((EVEN if k else EVEN_THICKNESS) * pixels, 20.0)
        reach = 2 * int(2.5 * sigma + 0.5) + 1
        cv2.GaussianBlur(picture, (reach, reach), sigma, dst=picture, borderType=cv2.BORDER_CONSTANT)
    found = [sums[0], sums[-1]]
    if len(colors):
        found.append(np.empty((*sums.shape[1:], 3), np.float32))
        np.divide(np.moveaxis(sums[1:4], 0, -1), np.maximum(sums[4], 1e-12)[..., None], out=found[-1])
    if coarse:
        found = [cv2.resize(p, (width, height), interpolation=cv2.INTER_LINEAR) for p in found]
    thickness, near, carried = found if len(colors) else (*found, np.full((height, width, 3), GRAY, np.float32))
    return thickness, carried, near


def _close_notches(inverse: np.ndarray, radius: float, camera: PinholeCamera, typical: float) -> None:
    """Fills what a ball of a radius does not get into, in the picture: gaps between spheres in which others are seen
    far behind, and notches between those of an outline. What lies no deeper than a sphere is left to the smoothing."""
    import cv2

    reach = NOTCH * camera.focal[0] * radius / max(typical, NEAR)
    if typical <= 0 or reach < 0.7:
        return
    wide = 2 * min(round(reach), MOST) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    closed = cv2.morphologyEx(np.maximum(inverse, 0.0), cv2.MORPH_CLOSE, disc, borderType=cv2.BORDER_REPLICATE)
    filled_notches(inverse, closed, np.float32(radius))


def _smoothed(inverse: np.ndarray, radius: float, camera: PinholeCamera) -> np.ndarray:
    """Inverse depth as of `inverse_depths` without the bumps of the spheres."""
    limit, fall, other = np.float32(LIMIT * radius), np.float32(FALL * radius), np.empty_like(inverse)
    for share, samples in [*((share, max(PER_BELL, share / BUMP)) for share in SMOOTHING), (FINISH, math.inf)]:
        apart = np.float32(samples)
        narrow_range(inverse, other, True, camera.focal[0], share * radius, apart, limit, fall)
        narrow_range(other, inverse, False, camera.focal[1], share * radius, apart, limit, fall)
    return inverse


def mesh_surface(
    mesh: TriangleMesh,
    camera: PinholeCamera,
    *,
    radius: float = 0.0,
    normals: Float[np.ndarray, "v 3"] | None = None,
) -> SurfaceBuffer:
    """The surface of a closed mesh, with its smooth normals; the colours of its vertices are what it carries.

    Thickness is all of the liquid along the ray, in however many parts. A mesh with holes gives wrong ones there.

    Args:
        mesh: m, world.
        camera: who looks.
        radius: m, of the particles that the mesh was made of: it knows nothing finer. 0: it is exact.
        normals: unit, outward, with which light is mirrored and bent on the near side; None: those of the mesh.
    """
    require(np.isfinite(radius) and radius >= 0, f"a radius of {radius}", "0 m or more")
    found = rasterize_closed(mesh.vertices, mesh.faces, camera)
    vertices = np.ascontiguousarray(mesh.vertices, np.float32)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    values = np.zeros((len(vertices), 6), np.float32)
    smooth_normals(vertices, faces, values)
    unit_rows(values)
    values[:, 3:] = GRAY if mesh.colors is None else linear_from_srgb(mesh.colors)
    front = interpolated(found.front, values, faces)
    if normals is not None:
        front[..., :3] = interpolated(found.front, np.ascontiguousarray(normals, np.float32), faces)
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
    return SurfaceBuffer(depth, normal, thickness, albedo, covered, back, GRAIN * radius)
