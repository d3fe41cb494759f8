"""Terrain in pictures: as surfels beside the fluid's splats, and as a depth that hides what lies behind rocks."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.types import Gaussians, PinholeCamera, Terrain, TriangleMesh, decompose_covariances, sh_from_rgb

LIGHT = np.array([0.35, -0.45, 0.82])
"""direction towards a high light beside the viewer, world"""


def vertex_normals(mesh: TriangleMesh) -> Float[np.ndarray, "v 3"]:
    """Area-weighted unit normals."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    face = np.cross(b - a, c - a)
    normals = np.zeros((len(mesh.vertices), 3))
    for k in range(3):
        np.add.at(normals, mesh.faces[:, k], face)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def terrain_surfels(terrain: Terrain, *, opacity: float = 0.98) -> Gaussians:
    """One flat, shaded Gaussian per vertex of the terrain's surface, so that one rasteriser draws everything; as large
    as the surface that the vertex stands for, a cell at most."""
    mesh = terrain.mesh
    if len(mesh.vertices) == 0:
        return Gaussians.empty()
    normals = vertex_normals(mesh)
    h = np.clip(np.sqrt(_vertex_areas(mesh)), 0.25 * terrain.grid.spacing, terrain.grid.spacing)
    colors = np.full((len(normals), 3), 0.5) if mesh.colors is None else mesh.colors
    seen = normals[:, 2] > -0.3  # nobody looks at the underside, and its large faces stick out at the rim
    return _surfels(mesh.vertices[seen], normals[seen], h[seen], colors[seen], opacity)


def _vertex_areas(mesh: TriangleMesh) -> np.ndarray:
    """m^2 of each vertex: a third of the faces that meet in it."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.bincount(mesh.faces.ravel(), np.repeat(area / 3.0, 3), len(mesh.vertices))


def _surfels(points: np.ndarray, normals: np.ndarray, spacing: np.ndarray | float, colors, opacity: float) -> Gaussians:
    """Flat Gaussians, shaded as under `LIGHT`."""
    shade = 0.55 + 0.45 * np.clip(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0.0, 1.0)
    outer = normals[:, :, None] * normals[:, None, :]
    h = np.broadcast_to(np.asarray(spacing, np.float64), (len(points),))[:, None, None]
    quats, scales = decompose_covariances((0.62 * h) ** 2 * (np.eye(3) - outer) + (0.12 * h) ** 2 * outer)
    return Gaussians(points, quats, scales, np.full(len(points), opacity), sh_from_rgb(colors * shade[:, None]))


def mesh_surfels(
    mesh: TriangleMesh, spacing: float, *, color: tuple[float, float, float] = (0.75, 0.35, 0.2), most: int = 60_000
) -> Gaussians:
    """Flat Gaussians all over the faces of a mesh, about `spacing` (m) apart, farther where there would be too many.

    Args:
        mesh: any triangles; a large one gets many surfels.
        spacing: m.
        color: sRGB.
        most: surfels, about.
    """
    a, b, c = (np.asarray(mesh.vertices, np.float64)[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    spacing = max(spacing, math.sqrt(2.0 * float(area.sum()) / most))
    longest = np.sqrt(np.max([np.square(b - a).sum(1), np.square(c - b).sum(1), np.square(a - c).sum(1)], axis=0))
    parts = np.clip(np.ceil(longest / spacing), 1, 200).astype(int)
    points, normals, sizes = [], [], []
    for n in np.unique(parts):
        # centres of the n^2 triangles that a face is cut into: n (n + 1) / 2 upright ones and the others between them
        i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        upright, between = i + j < n, i + j < n - 1
        s = np.concatenate([i[upright] + 1 / 3, i[between] + 2 / 3]) / n
        t = np.concatenate([j[upright] + 1 / 3, j[between] + 2 / 3]) / n
        at = (parts == n) & (area > 0)
        place = a[at][:, None] * (1 - s - t)[:, None] + b[at][:, None] * s[:, None] + c[at][:, None] * t[:, None]
        points.append(place.reshape(-1, 3))
        normals.append(np.repeat(0.5 * cross[at] / area[at, None], len(s), axis=0))
        sizes.append(np.repeat(longest[at] / n, len(s)))
    where = np.concatenate(points)
    return _surfels(where, np.concatenate(normals), np.concatenate(sizes), np.array([color] * len(where)), 0.98)


def terrain_depth(terrain: Terrain, camera: PinholeCamera, *, steps: int = 96) -> Float[np.ndarray, "h w"]:
    """Camera depth (m) at which each pixel's ray meets the terrain; inf where it does not (sphere tracing)."""
    grid = terrain.grid
    rays = camera.rays(camera.pixel_grid()).reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    eye = camera.position
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (grid.low - eye) / rays, (grid.high - eye) / rays
    near = np.nanmax(np.minimum(a, b), axis=1)
    far = np.nanmin(np.maximum(a, b), axis=1)
    z = np.maximum(near, 1e-6) + 1e-6
    hit = np.zeros(len(z), bool)
    active = np.where(far > z)[0]
    for _ in range(steps):
        if len(active) == 0:
            break
        p = eye + rays[active] * z[active, None]
        distance = sample_nodes(terrain.signed_distance, grid, p)
        close = distance < 0.05 * grid.spacing
        hit[active[close]] = True
        # the distance transform is not exact: step a little less than it allows
        z[active] += np.where(close, 0.0, np.maximum(0.8 * distance, 0.05 * grid.spacing) / length[active])
        active = active[~close & (z[active] < far[active])]
    return np.where(hit, z, np.inf).reshape(camera.size[1], camera.size[0])


def visible_beside_rocks(
    means: Float[np.ndarray, "n 3"],
    camera: PinholeCamera,
    depth: Float[np.ndarray, "h w"],
    where: Bool[np.ndarray, "h w"],
    *,
    margin: float,
) -> Bool[np.ndarray, "n"]:
    """False for points that lie more than `margin` (m) behind the solid seen at a pixel of `where`."""
    row, col, z = camera.nearest_pixels(means)
    return ~(where[row, col] & (z > depth[row, col] + margin))


def orbit_camera(
    camera: PinholeCamera,
    points: Float[np.ndarray, "n 3"],
    *,
    azimuth: float = 65.0,
    elevation: float = 24.0,
    size: tuple[int, int] | None = None,
    fov: float = 40.0,
) -> PinholeCamera:
    """A camera turned around the middle of some points, far enough away to see all of them.

    Args:
        camera: the original view; azimuth is counted from it.
        points: what must be seen, m.
        azimuth: degrees around the vertical, counter-clockwise seen from above.
        elevation: degrees above the horizontal.
        size: of the picture; None keeps the original's.
        fov: degrees across the longer side.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    centre = 0.5 * (low + high)
    away = camera.position - centre
    angle = math.atan2(away[1], away[0]) + math.radians(azimuth)
    tilt = math.radians(elevation)
    size = size or camera.size
    toward = np.array([math.cos(angle) * math.cos(tilt), math.sin(angle) * math.cos(tilt), math.sin(tilt)])
    view = PinholeCamera.looking(centre + toward, centre, fov, size)
    box = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    seen = (box - centre) @ view.camera_from_world.rotation.T
    # the nearest distance from which every corner of the box is inside the picture, and a rim of 6 %
    half = np.array([size[0] / (2 * view.focal[0]), size[1] / (2 * view.focal[1])]) / 1.06
    distance = float((np.abs(seen[:, :2]) / half - seen[:, 2:]).max())
    distance = max(distance, 1.5 * float(-seen[:, 2].min()))
    return PinholeCamera.looking(centre + distance * toward, centre, fov, size)
