"""Terrain in pictures: as surfels beside the fluid's splats, and as a depth that hides what lies behind rocks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.look.vessel import vessel_apart
from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.numerics.textures import sample_texture
from fluidlift.types import (
    Gaussians,
    PinholeCamera,
    Terrain,
    TriangleMesh,
    concatenate,
    decompose_covariances,
    sh_from_rgb,
)

SIDES = ((24.0, 65.0), (24.0, -65.0), (45.0, 65.0), (45.0, -65.0))
"""elevation and azimuth, degrees, of views from the side, the usual one first"""
SEEN = 0.6
"""share of the fluid's picture that the ground may not hide, from which a view will do"""
UNDERSIDE = 1.0
"""cells above its lowest vertex from which on a ground has no underside: the slab of a pour is three cells thick"""
SKETCH = 96
"""px, width of the pictures in which that is looked at"""
MARCH = 96
"""steps along a ray to the ground at most. One is at least a twentieth of a cell, and eight tenths of the distance to
the ground, so that a ray that grazes it for so long is taken to miss it"""
LIGHT = np.array([0.35, -0.45, 0.82])
"""direction towards a high light beside the viewer, world"""

TEXTURED = 60_000
"""surfels of a textured ground, at most: what a preview's panel shows; large stills take more"""


def terrain_surfels(
    terrain: Terrain, *, opacity: float = 0.98, most: int = TEXTURED, glass: float | None = None
) -> Gaussians:
    """Flat, shaded Gaussians on the terrain's surface, so that one rasteriser draws everything.

    One per vertex, as large as the surface that it stands for, a cell at most. Where there is a texture, they lie on
    the faces, and these are cut up as far as `most` surfels allow.

    Args:
        terrain: the ground.
        opacity: of each.
        most: surfels of a textured ground.
        glass: opacity of what stands on the ground, a pour's vessel (`vessel.vessel_apart`); 0: it is left out; None:
            it is ground as the rest.
    """
    if glass is not None:
        table, vessel = vessel_apart(terrain.mesh, terrain.grid.spacing)
        found = terrain_surfels(replace(terrain, mesh=table), opacity=opacity, most=most)
        if vessel is None or glass <= 0:
            return found
        walls = terrain_surfels(replace(terrain, mesh=vessel.sheet), opacity=glass, most=most)
        return concatenate([found, walls])
    mesh = terrain.mesh
    if len(mesh.vertices) == 0:
        return Gaussians.empty()
    if mesh.texture is not None:
        return _textured_surfels(mesh, opacity, most)
    normals = vertex_normals(mesh)
    h = np.clip(np.sqrt(_vertex_areas(mesh)), 0.25 * terrain.grid.spacing, terrain.grid.spacing)
    colors = np.full((len(normals), 3), 0.5) if mesh.colors is None else mesh.colors
    # nobody looks at the underside, and its large faces stick out at the rim; walls of a vessel may lean outwards
    stands = terrain.opaque & (mesh.vertices[:, 2] > mesh.vertices[:, 2].min() + UNDERSIDE * terrain.grid.spacing)
    seen = (normals[:, 2] > -0.3) | stands
    return _surfels(mesh.vertices[seen], normals[seen], h[seen], colors[seen], opacity)


def _textured_surfels(mesh: TriangleMesh, opacity: float, most: int) -> Gaussians:
    assert mesh.uv is not None and mesh.texture is not None
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    cross = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    seen = cross[:, 2] > -1.4 * area  # steeper than 45 degrees from below: the floor, which nobody looks at
    spacing = math.sqrt(2.0 * float(area[seen].sum()) / most)
    while float(np.square(_parts((a, b, c), spacing))[seen].sum()) > most and spacing < np.ptp(mesh.vertices):
        spacing *= 1.1  # faces are cut into whole numbers of parts
    normals = vertex_normals(mesh)[mesh.faces]
    at = _cut(np.where(seen, area, 0.0), (a, b, c), spacing)
    share = np.stack([1 - at.s - at.t, at.s, at.t], -1)[..., None]
    where, uv, normal = ((v[at.face] * share).sum(axis=1) for v in (np.stack([a, b, c], 1), mesh.uv, normals))
    # smooth across faces, but a side's edge at the top stays an edge
    flat = (cross / np.maximum(2 * area, 1e-20)[:, None])[at.face]
    normal = np.where(((normal * flat).sum(axis=1) > 0.8)[:, None], normal, flat)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    # a surfel shows the mean of the texels about its middle: its overlap with its neighbours evens out the rest
    texel = float(np.ptp(mesh.vertices[:, 0])) / mesh.texture.shape[1]
    covered = max(round(0.25 * float(np.median(at.size)) / texel), 1)
    # a leg of a right triangle: its hypotenuse would make the picture soft
    size = at.size * np.maximum(np.sqrt(2.0 * area) / np.maximum(_longest((a, b, c)), 1e-20), 0.5)[at.face]
    even = ndimage.uniform_filter(mesh.texture, (covered, covered, 0), mode="nearest")
    return _surfels(where, normal, size, sample_texture(even, uv), opacity)


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


UNPAINTED = (0.75, 0.35, 0.2)
"""sRGB, of a mesh without colours of its own: brick, which no fluid is"""


def mesh_surfels(mesh: TriangleMesh, spacing: float, *, most: int = 60_000) -> Gaussians:
    """Flat Gaussians all over the faces of a mesh, about `spacing` (m) apart, farther where there would be too many.

    Args:
        mesh: any triangles; a large one gets many surfels.
        spacing: m.
        most: surfels, about.
    """
    a, b, c = (np.asarray(mesh.vertices, np.float64)[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    spacing = max(spacing, math.sqrt(2.0 * float(area.sum()) / most))
    at = _cut(area, (a, b, c), spacing)
    share = np.stack([1 - at.s - at.t, at.s, at.t], -1)[..., None]
    where = (np.stack([a, b, c], 1)[at.face] * share).sum(axis=1)
    normals = 0.5 * cross[at.face] / area[at.face, None]
    painted = np.array([UNPAINTED] * len(where))
    if mesh.colors is not None:
        painted = (np.asarray(mesh.colors, np.float64)[mesh.faces[at.face]] * share).sum(axis=1)
    return _surfels(where, normals, at.size, painted, 0.98)


@dataclass(frozen=True)
class _Places:
    """Points on faces: a + s (b - a) + t (c - a)."""

    face: np.ndarray
    s: np.ndarray
    t: np.ndarray
    size: np.ndarray
    """m that each stands for"""


def _longest(corners: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    a, b, c = corners
    return np.sqrt(np.max([np.square(b - a).sum(1), np.square(c - b).sum(1), np.square(a - c).sum(1)], axis=0))


def _parts(corners: tuple[np.ndarray, np.ndarray, np.ndarray], spacing: float) -> np.ndarray:
    """Into how many parts the longest side of each face is cut."""
    return np.clip(np.ceil(_longest(corners) / spacing), 1, 200).astype(int)


def _cut(area: np.ndarray, corners: tuple[np.ndarray, np.ndarray, np.ndarray], spacing: float) -> _Places:
    """Centres of the n^2 triangles that each face with an area is cut into, at most `spacing` long."""
    parts, longest, found = _parts(corners, spacing), _longest(corners), []
    for n in np.unique(parts):
        # n (n + 1) / 2 upright ones and the others between them
        i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        upright, between = i + j < n, i + j < n - 1
        s = np.concatenate([i[upright] + 1 / 3, i[between] + 2 / 3]) / n
        t = np.concatenate([j[upright] + 1 / 3, j[between] + 2 / 3]) / n
        face = np.flatnonzero((parts == n) & (area > 0))
        each, k = np.repeat(face, len(s)), len(face)
        found.append((each, np.tile(s, k), np.tile(t, k), longest[each] / n))
    return _Places(*(np.concatenate(column) for column in zip(*found, strict=True)))


def terrain_depth(
    terrain: Terrain, camera: PinholeCamera, *, where: Bool[np.ndarray, "h w"] | None = None
) -> Float[np.ndarray, "h w"]:
    """Camera depth (m) at which each pixel's ray meets the terrain; inf where it does not (sphere tracing), and beside
    the pixels that are asked for."""
    if where is not None:
        out = np.full(where.shape, np.inf)
        out[where] = _met(terrain, camera, camera.rays(camera.pixel_grid()[where]))
        return out
    return _met(terrain, camera, camera.rays(camera.pixel_grid()).reshape(-1, 3)).reshape(camera.size[::-1])


def _met(terrain: Terrain, camera: PinholeCamera, rays: np.ndarray) -> np.ndarray:
    grid = terrain.grid
    length = np.linalg.norm(rays, axis=1)
    eye = camera.position
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (grid.low - eye) / rays, (grid.high - eye) / rays
    near = np.nanmax(np.minimum(a, b), axis=1)
    far = np.nanmin(np.maximum(a, b), axis=1)
    z = np.maximum(near, 1e-6) + 1e-6
    hit = np.zeros(len(z), bool)
    active = np.where(far > z)[0]
    for _ in range(MARCH):
        if len(active) == 0:
            break
        p = eye + rays[active] * z[active, None]
        distance = sample_nodes(terrain.signed_distance, grid, p)
        close = distance < 0.05 * grid.spacing
        hit[active[close]] = True
        # the distance transform is not exact: step a little less than it allows
        z[active] += np.where(close, 0.0, np.maximum(0.8 * distance, 0.05 * grid.spacing) / length[active])
        active = active[~close & (z[active] < far[active])]
    return np.where(hit, z, np.inf)


def visible_beside_rocks(
    means: Float[np.ndarray, "n 3"],
    camera: PinholeCamera,
    depth: Float[np.ndarray, "h w"],
    where: Bool[np.ndarray, "h w"],
    *,
    margin: float | Float[np.ndarray, "h w"],
) -> Bool[np.ndarray, " n"]:
    """False for points that lie more than `margin` (m) behind the solid seen at a pixel of `where`."""
    row, col, z = camera.nearest_pixels(means)
    return ~(where[row, col] & (z > (depth + margin)[row, col]))


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


def side_camera(
    camera: PinholeCamera,
    fluid: Gaussians,
    ground: Gaussians,
    points: Float[np.ndarray, "n 3"],
    *,
    size: tuple[int, int] | None = None,
) -> PinholeCamera:
    """The first of some views from the side in which the ground hides little of the fluid, else the one in which it
    hides least: a bank or the wall of a steep bed may stand before it on one side.

    Args:
        camera: the original view.
        fluid: what should be seen.
        ground: what may hide it.
        points: what must be in the picture, m.
        size: of the picture; None keeps the original's.
    """
    from fluidlift.look.rasterize import render

    whole = orbit_camera(camera, points, size=size)
    small = (SKETCH, max(16, round(SKETCH * whole.size[1] / whole.size[0])))
    best, most = whole, -1.0
    marks = np.concatenate([np.ones(len(fluid), np.float32), np.zeros(len(ground), np.float32)])[:, None]
    both = concatenate([fluid, ground])
    for elevation, azimuth in SIDES:
        view = orbit_camera(camera, points, azimuth=azimuth, elevation=elevation, size=size)
        sketch = view.resized(small)
        alone = float(render(fluid, sketch).alpha.sum())
        seen = float(render(both, sketch, features=marks).image.sum()) / max(alone, 1e-6)
        if seen > most + 0.05:
            best, most = view, seen
        if most >= SEEN:
            break
    return best
