"""Ground and obstacles in a picture, in the light of an environment, with the shadows that they and the liquid cast.

The environment is taken apart: its strongest light casts one shadow with a soft edge (Williams 1978; Fernando 2005),
and the rest comes from some directions all around, each with a shadow map of its own, which together are the ambient
occlusion. Through a liquid light passes: it is absorbed along its way, so that honey throws an amber shadow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.ground_kernels import filled_in, paint, shadowed, world_points
from fluidlift.look.liquid import Behind
from fluidlift.look.materials import Material
from fluidlift.look.optics import fresnel, transmittance
from fluidlift.look.screen_space import linear_from_srgb
from fluidlift.look.screen_space_kernels import smooth_normals, unit_rows
from fluidlift.numerics.triangles import rasterize_closed, rasterize_triangles
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.terrain import TriangleMesh

if TYPE_CHECKING:
    from fluidlift.look.environment import Environment

AWAY = 100.0
"""radii of the scene between it and a light: near enough to parallel light, and exact enough in float32"""
SHADOW = 1024
"""px, width of the strongest light's map"""
AMBIENT = 256
"""px, width of the maps of the directions all around"""
DIRECTIONS = 12
"""from which the rest of the light comes"""
STEP = 3
"""px between pixels whose ambient light is found"""
ALIKE = 0.01
"""share of the depth within which pixels belong to the same surface"""
FAINT = 0.02
"""share of the strongest light under which it is no light of its own"""
SOFT = 0.012
"""half width of the strongest light's shadow edge, of the scene's radius"""
GRAY = 0.5
"""sRGB of meshes without colours"""
CREASE = 0.7
"""cosine between a face and its smooth normal below which the face's own is taken: edges stay edges"""


@dataclass(frozen=True)
class GroundLight:
    """How ground is lit."""

    directions: int = DIRECTIONS
    """from which ambient light comes, each with a shadow map; 0: no ambient occlusion"""
    shadow: int = SHADOW
    """px, width of the shadow map of the strongest light"""
    soft: float = SOFT
    """half width of its edge, of the scene's radius"""

    def __post_init__(self) -> None:
        require(0 <= self.directions <= 256, f"{self.directions} directions", "0 to 256")
        require(16 <= self.shadow <= 8192, f"a shadow map of {self.shadow} px", "16 to 8192")
        require(np.isfinite(self.soft) and self.soft >= 0, f"a shadow edge of {self.soft}", "0 or more")


def ground_picture(
    meshes: Sequence[TriangleMesh],
    camera: PinholeCamera,
    environment: Environment,
    behind: Behind | None = None,
    caster: TriangleMesh | None = None,
    *,
    material: Material | None = None,
    lit: GroundLight | None = None,
) -> Behind:
    """Meshes lit by the environment, before what lies behind them.

    Args:
        meshes: terrain and obstacles, with textures or vertex colours (sRGB), which are taken for the albedo of matt
            surfaces.
        camera: who looks.
        environment: the light.
        behind: what is seen where there are no meshes, or nearer than they; None: the environment itself.
        caster: a closed mesh that is not drawn but throws its shadow, as the surface of the liquid.
        material: of the caster: what light is left behind it; None: no light passes.
        lit: shadow maps.

    Returns:
        Linear picture and depth.

    Raises:
        ValueError: `behind` of another size.
    """
    width, height = camera.size
    lit = lit or GroundLight()
    behind = behind or surroundings(camera, environment)
    require(behind.depth.shape == (height, width), f"a background of {behind.depth.shape}", f"({height}, {width})")
    meshes = [m for m in meshes if len(m.faces)]
    if not meshes:
        return behind
    depth, albedo, normal = _drawn(meshes, camera)
    drawn = (depth > 0) & ((behind.depth <= 0) | (depth < behind.depth))
    depth = np.where(drawn, depth, 0.0).astype(np.float32)
    scene = _Scene.of(meshes, caster, material)
    image = behind.image.copy()
    ambient = _ambient_picture(scene, camera, environment, depth, normal, lit)[drawn]
    points = _points(np.argwhere(drawn), depth, camera)
    image[drawn] = albedo[drawn] * _received(points, normal[drawn], scene, environment, ambient, lit)
    return Behind(image, np.where(drawn, depth, behind.depth))


def surroundings(camera: PinholeCamera, environment: Environment) -> Behind:
    """The environment as the camera sees it, infinitely far away."""
    width, height = camera.size
    rays = camera.rays(camera.pixel_grid())
    return Behind(environment.toward(rays), np.zeros((height, width), np.float32))


def _drawn(meshes: Sequence[TriangleMesh], camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, linear albedo and unit normals towards the viewer of the nearest mesh."""
    width, height = camera.size
    depth = np.zeros((height, width), np.float32)
    albedo, normal = np.zeros((height, width, 3), np.float32), np.zeros((height, width, 3), np.float32)
    for mesh in meshes:
        found = rasterize_triangles(mesh.vertices, mesh.faces, camera)
        vertices, faces = np.ascontiguousarray(mesh.vertices, np.float64), np.ascontiguousarray(mesh.faces, np.int64)
        smooth = np.zeros(vertices.shape)
        smooth_normals(vertices, faces, smooth)
        unit_rows(smooth)
        textured = mesh.uv is not None and mesh.texture is not None
        uv = np.asarray(mesh.uv, np.float32) if textured else np.zeros((1, 3, 2), np.float32)
        texture = _LINEAR[mesh.texture] if textured else np.zeros((1, 1, 3), np.float32)
        colors = np.full(vertices.shape, GRAY) if mesh.colors is None else mesh.colors
        paint(
            found.face, found.barycentric, found.depth, vertices, faces, smooth, linear_from_srgb(colors),
            np.ascontiguousarray(uv), texture, textured, _view(camera), CREASE, depth, albedo, normal,
        )  # fmt: skip
    return depth, albedo, normal


_LINEAR = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)


def _view(camera: PinholeCamera) -> np.ndarray:
    return np.array([*camera.focal, *camera.center, *np.ravel(camera.camera_from_world.rotation)], np.float64)


def _points(pixels: np.ndarray, depth: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """World points [n,3] (m) of pixels (row, column)."""
    points = np.empty((len(pixels), 3))
    world_points(np.ascontiguousarray(pixels), depth, _view(camera), np.asarray(camera.position, float), points)
    return points


def received(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    meshes: Sequence[TriangleMesh],
    environment: Environment,
    caster: TriangleMesh | None = None,
    *,
    material: Material | None = None,
    lit: GroundLight | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Irradiance over pi (linear, the unit of `Environment.irradiance`) at points of surfaces, with all shadows.

    Args:
        points: m, world, on the meshes.
        normals: unit, outward.
        meshes, environment, caster, material, lit: as of `ground_picture`.
    """
    lit = lit or GroundLight()
    p, n = np.asarray(points, np.float64), np.asarray(normals, np.float32)
    scene = _Scene.of(meshes, caster, material)
    return _received(p, n, scene, environment, _ambient(p, n, scene, environment, lit), lit)


def _received(
    points: np.ndarray, normals: np.ndarray, scene: _Scene, environment: Environment, ambient: np.ndarray,
    lit: GroundLight,
) -> np.ndarray:  # fmt: skip
    toward, strength, share = environment.light()
    whole = environment.irradiance(normals)
    if share <= FAINT or len(points) == 0:
        return whole * ambient
    direct = np.minimum(np.clip(normals @ toward, 0.0, None)[:, None] * strength, whole)
    left = scene.light_left(points, normals, toward, lit.shadow, lit.soft * scene.radius)
    return (whole - direct) * ambient + direct * left


def _ambient_picture(
    scene: _Scene, camera: PinholeCamera, environment: Environment, depth: np.ndarray, normal: np.ndarray,
    lit: GroundLight,
) -> np.ndarray:  # fmt: skip
    """`_ambient` for the pixels with a depth, found in some of them: it changes slowly."""
    out = np.ones((*depth.shape, 3), np.float32)
    some = depth[::STEP, ::STEP] > 0
    if not lit.directions or not some.any():
        return out
    coarse = np.ones((*some.shape, 3), np.float32)
    pixels = STEP * np.argwhere(some)
    coarse[some] = _ambient(_points(pixels, depth, camera), normal[pixels[:, 0], pixels[:, 1]], scene, environment, lit)
    filled_in(coarse, STEP, depth, normal, ALIKE, out)
    return out


def _ambient(
    points: np.ndarray, normals: np.ndarray, scene: _Scene, environment: Environment, lit: GroundLight
) -> np.ndarray:
    """Share [n,3] of the ambient light that reaches points: what comes from each direction, weighted as it falls in."""
    if not lit.directions:
        return np.ones((len(points), 3), np.float32)
    ways = spread_directions(lit.directions)
    radiance = np.maximum(environment.blurred(ways, 0.7), 1e-4)
    toward, _, share = environment.light()
    around = ways @ toward > math.cos(math.radians(35.0))
    if share > FAINT and around.any() and not around.all():  # the strongest light has a shadow of its own
        radiance[around] = np.minimum(radiance[around], radiance[~around].mean(axis=0))
    total, left = np.zeros((len(points), 3), np.float32), np.zeros((len(points), 3), np.float32)
    for way, color in zip(ways, radiance, strict=True):
        weight = np.maximum(normals @ way, 0.0).astype(np.float32)[:, None] * color
        total += weight
        left += weight * scene.light_left(points, normals, way, AMBIENT, 0.0)
    # undersides that none of the directions reaches stay as they are
    return np.where(total > 1e-5, left / np.maximum(total, 1e-5), 1.0).astype(np.float32)


def spread_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Unit directions spread evenly over the part of the sphere from a little below the horizon up (a spiral)."""
    z = 1.0 - (np.arange(count) + 0.5) / count * 1.15
    azimuth = math.pi * (1.0 + math.sqrt(5.0)) * (np.arange(count) + 0.5)
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=-1).astype(np.float32)


@dataclass(frozen=True)
class _Scene:
    """What casts shadows."""

    vertices: np.ndarray
    faces: np.ndarray
    caster: TriangleMesh | None
    material: Material | None
    middle: np.ndarray
    radius: float

    @classmethod
    def of(cls, meshes: Sequence[TriangleMesh], caster: TriangleMesh | None, material: Material | None) -> _Scene:
        counts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        vertices = np.concatenate([np.asarray(m.vertices, np.float64) for m in meshes])
        faces = np.concatenate([np.asarray(m.faces) + first for m, first in zip(meshes, counts)])
        caster = caster if caster is not None and len(caster.faces) else None
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        if caster is not None:
            low, high = np.minimum(low, caster.vertices.min(axis=0)), np.maximum(high, caster.vertices.max(axis=0))
        radius = max(0.5 * float(np.linalg.norm(high - low)), 1e-9)
        return cls(vertices, faces, caster, material, 0.5 * (low + high), radius)

    def light_left(
        self, points: np.ndarray, normals: np.ndarray, toward: np.ndarray, size: int, soft: float
    ) -> np.ndarray:
        """Share [n,3] of the light from one direction that reaches points; `soft` (m): half width of the edges."""
        eye = self.middle + AWAY * self.radius * np.asarray(toward, float)
        pose = PinholeCamera.looking(eye, self.middle, 2.0, (1, 1)).camera_from_world
        focal = 0.5 * size * (AWAY - 1.0)
        sun = PinholeCamera((focal, focal), (size / 2, size / 2), (size, size), pose)
        solid = rasterize_triangles(self.vertices, self.faces, sun).depth
        first, left = np.zeros_like(solid), np.ones((*solid.shape, 3), np.float32)
        if self.caster is not None:
            first, left = self._through_caster(sun)
        texel = 2.0 * self.radius / size
        numbers = np.array([focal, size / 2, size / 2, *np.ravel(pose.rotation), *pose.translation], np.float64)
        lit = np.empty((len(points), 3), np.float32)
        way = np.asarray(toward, np.float64)
        shadowed(points, normals, numbers, way, texel, solid, first, left, soft / texel, lit)
        return lit

    def _through_caster(self, sun: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
        """Depth at which the caster begins (0: nowhere), and the share of light left behind it."""
        assert self.caster is not None
        if self.material is None:
            found = rasterize_triangles(self.caster.vertices, self.caster.faces, sun)
            return found.depth, np.where(found.hit, 0.0, 1.0)[..., None].repeat(3, axis=-1).astype(np.float32)
        closed = rasterize_closed(self.caster.vertices, self.caster.faces, sun)
        m = self.material
        through = transmittance(np.asarray(m.absorption) + m.scattering, closed.inside)
        through *= float(1.0 - fresnel(np.ones(1), m.refractive_index)[0])
        hit = closed.front.hit
        return closed.front.depth, np.where(hit[..., None], through, 1.0).astype(np.float32)
