"""Ground and obstacles in a picture, in the light of an environment, with the shadows that they and the liquid cast.

What stays is prepared once (`GroundMeshes`): its shadow maps, and for a camera that stands still all of its picture. In
every frame only what moves is drawn, with its shadow. Where light comes from is told in `ground_light`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.ground_kernels import filled_in, lay_over, paint, world_points
from fluidlift.look.ground_light import Around, Casters, GroundLight, direct_light, spread_directions
from fluidlift.look.liquid import Behind
from fluidlift.look.materials import Material
from fluidlift.look.screen_space_kernels import smooth_normals, unit_rows
from fluidlift.look.smoothstep import smoothstep
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.numerics.triangles import rasterize_triangles
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.terrain import TriangleMesh

if TYPE_CHECKING:
    from fluidlift.look.environment import Environment

__all__ = [
    "GRAY", "GroundLight", "GroundMeshes", "place_of", "received", "spread_directions",
    "surroundings",
]  # fmt: skip

STEP = 3
"""px between pixels whose ambient light is found"""
ALIKE = 0.01
"""share of the depth within which pixels belong to the same surface"""
GRAY = 0.5
"""sRGB of meshes without colours"""
CREASE = 0.7
"""cosine between a face and its smooth normal below which the face's own is taken: edges stay edges"""
BROAD = 0.08
"""of the picture's longer side: over this, what ground slopes by is evened out"""
BROADLY = 8
"""px between those that are taken for it"""
LYING = tuple(np.cos(np.radians([65.0, 50.0])))
"""cosine of slopes: what is steeper than the first stands, what is less steep than the second lies"""
CLEFT = 0.02
"""share of the ambient light that gets into the narrowest cleft, which none of the directions meets"""


class GroundMeshes:
    """Meshes lit by an environment, which stay where they are, prepared for pictures.

    Args:
        meshes: terrain and obstacles, with textures or vertex colours (sRGB), which are taken for the albedo of matt
            surfaces.
        environment: the light.
        lit: shadow maps.
        casters: what throws shadows in place of these meshes, as `casters` of another ground.
    """

    def __init__(
        self,
        meshes: Sequence[TriangleMesh],
        environment: Environment,
        lit: GroundLight | None = None,
        *,
        casters: Casters | None = None,
    ) -> None:
        self.meshes, self.environment, self.lit = [m for m in meshes if len(m.faces)], environment, lit or GroundLight()
        self.casters = casters or Casters.of(self.meshes)
        self.around = Around.of(environment, self.lit.directions)
        self._last: tuple[tuple, _Surfaces] | None = None
        self._near: tuple[tuple, np.ndarray] | None = None

    def picture(
        self,
        camera: PinholeCamera,
        behind: Behind | None = None,
        caster: TriangleMesh | None = None,
        *,
        material: Material | None = None,
        bodies: Sequence[TriangleMesh] = (),
        inset: float = 0.0,
    ) -> Behind:
        """Linear picture and depth of these meshes before what lies behind them. What is found of the meshes alone is
        kept for the last camera: the picture is the same, and the next one costs what moves.

        Args:
            camera: who looks.
            behind: what is seen where there are no meshes, or nearer than they; None: the environment itself.
            caster: a closed mesh that is not drawn but throws its shadow, as the surface of the liquid.
            material: of the caster: what light is left behind it; None: no light passes.
            bodies: meshes that move.
            inset: m that the caster stands outside of the liquid that it is made of.

        Raises:
            ValueError: `behind` of another size.
        """
        width, height = camera.size
        behind = behind or surroundings(camera, self.environment)
        require(behind.depth.shape == (height, width), f"a background of {behind.depth.shape}", f"({height}, {width})")
        bodies = [m for m in bodies if len(m.faces)]
        if not self.meshes and not bodies:
            return behind
        moving = (
            Casters.of(bodies, beside=self.casters),
            Casters.of([], caster, material, beside=self.casters, inset=inset),
        )
        seen = self._seen(camera)
        layers = [seen]
        if bodies:
            depth, albedo, normal = seen.depth.copy(), seen.albedo.copy(), seen.normal.copy()
            _draw(bodies, camera, depth, albedo, normal)
            moved = depth != seen.depth
            layers.append(_Surfaces(self, camera, np.where(moved, depth, 0.0).astype(np.float32), albedo, normal))
        image, before, direct = behind.image.copy(), behind.depth.copy(), None
        for layer in layers:
            light, strongest = layer.image(moving)
            lay_over(light, layer.depth, image, before)
            if strongest is not None:
                seen_there = ((layer.depth > 0) & (before == layer.depth))[..., None]
                direct = strongest if direct is None else np.where(seen_there, strongest, direct)
        if direct is not None and behind.depth.any():
            direct = np.where((before == behind.depth)[..., None], np.float32(0.0), direct)
        return Behind(image, before, direct=direct)

    def depth(self, camera: PinholeCamera) -> Float[np.ndarray, "h w"]:
        """Camera z (m; 0: none) of these meshes: of the ground that a photograph in place of its picture shows."""
        key = place_of(camera)
        if self._last is not None and self._last[0] == key:
            return self._last[1].depth
        if self._near is None or self._near[0] != key:
            nearest = np.full(camera.size[::-1], np.inf, np.float32)
            for mesh in self.meshes:
                found = rasterize_triangles(mesh.vertices, mesh.faces, camera)
                nearest = np.where(found.hit, np.minimum(nearest, found.depth), nearest)
            self._near = key, np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)
        return self._near[1]

    def albedo(self, camera: PinholeCamera) -> Float[np.ndarray, "h w 3"]:
        """Linear; 0 where there is none of these meshes."""
        return self._seen(camera).albedo

    def lying(self, camera: PinholeCamera) -> Float[np.ndarray, "h w"]:
        """1 where these meshes lie, 0 where they stand, as they are seen at large: the foot of a rock and a low bank
        are parts of ground that lies."""
        import cv2

        normal = self._seen(camera).normal[::BROADLY, ::BROADLY]
        mean = cv2.GaussianBlur(normal, (0, 0), BROAD * max(normal.shape))
        upward = mean[..., 2] / np.maximum(np.linalg.norm(mean, axis=-1), 1e-12)
        return cv2.resize(smoothstep(upward, *LYING).astype(np.float32), camera.size)

    def _seen(self, camera: PinholeCamera) -> _Surfaces:
        key = place_of(camera)
        if self._last is None or self._last[0] != key:
            width, height = camera.size
            depth = np.zeros((height, width), np.float32)
            albedo, normal = np.zeros((height, width, 3), np.float32), np.zeros((height, width, 3), np.float32)
            _draw(self.meshes, camera, depth, albedo, normal)
            self._last = key, _Surfaces(self, camera, depth, albedo, normal)
        return self._last[1]


Moving = tuple[Casters | None, Casters | None]
"""solid bodies, and the liquid"""
NOTHING: Moving = (None, None)


@dataclass(frozen=True)
class _Surfaces:
    """What a camera sees of surfaces, and how much light what stays leaves them."""

    ground: GroundMeshes
    camera: PinholeCamera
    depth: np.ndarray
    """[h,w] camera z, m; 0 where there are none"""
    albedo: np.ndarray
    normal: np.ndarray

    @cached_property
    def _pixels(
        self,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | np.float32 | None]:
        """Where surfaces are; there: points, normals, all light but the strongest, that one, and its share that what
        stays lets through."""
        there = self.depth > 0
        points, normals = _points(np.argwhere(there), self.depth, self.camera), self.normal[there]
        whole, direct, toward = direct_light(normals, self.ground.environment)
        share = None if direct is None else self._sun(self.ground.casters, points, normals, toward)
        sky = whole if direct is None else np.asarray(whole - direct)
        return there, points, normals, sky, direct, share

    def _sun(
        self, casters: Casters | None, points: np.ndarray, normals: np.ndarray, toward: np.ndarray
    ) -> np.ndarray | np.float32:
        if casters is None:
            return np.float32(1.0)
        lit, stays = self.ground.lit, self.ground.casters or casters
        return casters.light_left(points, normals, toward, lit.shadow, lit.soft * stays.radius)

    @cached_property
    def _coarse(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Every `STEP`-th pixel where surfaces are; there: points, normals, and the shares of what stays."""
        some = self.depth[::STEP, ::STEP] > 0
        pixels = STEP * np.argwhere(some)
        points, normals = _points(pixels, self.depth, self.camera), self.normal[pixels[:, 0], pixels[:, 1]]
        return some, points, normals, self.ground.around.shares(points, normals, self.ground.casters)

    def _filled(self, shares: list[np.ndarray | None]) -> np.ndarray:
        """Share [n,3] of the ambient light that these leave the surfaces, found in some of the pixels: it changes
        slowly."""
        out, around = np.ones((*self.depth.shape, 3), np.float32), self.ground.around
        some, _, normals, _ = self._coarse
        there = self._pixels[0]
        if not len(around.ways) or not some.any():
            return out[there]
        coarse = np.ones((*some.shape, 3), np.float32)
        coarse[some] = around.left(normals, *shares)
        filled_in(coarse, STEP, self.depth, self.normal, ALIKE, out)
        return out[there]

    @cached_property
    def _open(self) -> tuple[np.ndarray, ...]:
        return self._opened([self._coarse[3]])

    def _opened(self, shares: list[np.ndarray | None]) -> tuple[np.ndarray, ...]:
        """Share of the ambient light that solids leave; that light in the open, with what surfaces send each other;
        and what of it gets into clefts."""
        left = self._filled(shares)
        there, sky = self._pixels[0], self._pixels[3]
        whole = (sky * bounced(left, self.albedo[there])).astype(np.float32)
        return left, whole, CLEFT * (1.0 - left) * whole

    def _ambient(self, bodies: Casters | None, liquid: Casters | None) -> np.ndarray:
        """Ambient light [n,3] at the surfaces."""
        _, points, normals, stays = self._coarse
        shares: list[np.ndarray | None]
        shares = [stays] if bodies is None else [stays, self.ground.around.shares(points, normals, bodies)]
        left, whole, cleft = self._open if bodies is None else self._opened(shares)
        if liquid is None:
            return left * whole + cleft
        found = self._filled([*shares, self.ground.around.shares(points, normals, liquid)])
        found *= whole
        found += cleft
        return found

    def image(self, moving: Moving) -> tuple[np.ndarray, np.ndarray | None]:
        """Linear light [h,w,3], and what of it is the strongest light's, with its cosine (as `Behind.direct`); 0
        where there are no surfaces."""
        return self._lit(moving) if any(moving) else self._standing

    @cached_property
    def _standing(self) -> tuple[np.ndarray, np.ndarray | None]:
        return self._lit(NOTHING)

    def _lit(self, moving: Moving) -> tuple[np.ndarray, np.ndarray | None]:
        there, points, normals, _, direct, share = self._pixels
        light, strongest = self._ambient(*moving), None
        if direct is not None and share is not None:
            toward, left = self.ground.environment.light()[0], share
            for casters in moving:
                left = left if casters is None else left * self._sun(casters, points, normals, toward)
            left = direct * left
            light += left
            strongest = np.zeros((*self.depth.shape, 4), np.float32)
            strongest[there] = np.concatenate([self.albedo[there] * left, (normals @ toward)[:, None]], axis=1)
        image = np.zeros_like(self.albedo)
        image[there] = self.albedo[there] * light
        return image, strongest


def bounced(left: Float[np.ndarray, "n 3"], albedo: Float[np.ndarray, "#n 3"]) -> Float[np.ndarray, "n 3"]:
    """How many times more ambient light surfaces get, with that which they send each other.

    What hides a share 1 - a of the sky is taken for as bright as the surface itself: B = albedo (a E + (1 - a) B), so
    that light is a / (1 - albedo (1 - a)) times E. A world of one white is 1 then, and none gets more than E. After
    Stewart and Langer 1997, as multi-bounce ambient occlusion of Jimenez et al. 2016.

    Args:
        left: share a of the ambient light that others leave, 0 to 1.
        albedo: linear, 0 to 1.
    """
    return 1.0 / (1.0 - albedo * (1.0 - CLEFT) * (1.0 - left))


def place_of(camera: PinholeCamera) -> tuple:
    """What tells two cameras apart."""
    pose = camera.camera_from_world
    return camera.size, *camera.focal, *camera.center, *np.ravel(pose.rotation), *np.ravel(pose.translation)


def surroundings(camera: PinholeCamera, environment: Environment) -> Behind:
    """The environment as the camera sees it, infinitely far away."""
    width, height = camera.size
    rays = camera.rays(camera.pixel_grid())
    return Behind(environment.toward(rays), np.zeros((height, width), np.float32))


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
    """Irradiance over pi (linear, the unit of `Environment.irradiance`) at points of surfaces, with all shadows and
    without the light that surfaces send each other (`bounced`).

    Args:
        points: m, world, on the meshes.
        normals: unit, outward.
        meshes, environment, caster, material, lit: as of `GroundMeshes` and its `picture`.
    """
    lit = lit or GroundLight()
    p, n = np.asarray(points, np.float64), np.asarray(normals, np.float32)
    stays = Casters.of(meshes)
    both = [c for c in (stays, Casters.of([], caster, material, beside=stays)) if c is not None]
    around = Around.of(environment, lit.directions)
    ambient = around.left(n, *(around.shares(p, n, c) for c in both))
    whole, direct, toward = direct_light(n, environment)
    if direct is None:
        return whole * ambient
    left = np.ones((len(p), 3), np.float32)
    for c in both:
        left *= c.light_left(p, n, toward, lit.shadow, lit.soft * both[0].radius)
    return (whole - direct) * ambient + direct * left


def _draw(
    meshes: Sequence[TriangleMesh], camera: PinholeCamera, depth: np.ndarray, albedo: np.ndarray, normal: np.ndarray
) -> None:
    """Depth, linear albedo and unit normals towards the viewer, where meshes are nearer than what is there."""
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


_LINEAR = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)


def _view(camera: PinholeCamera) -> np.ndarray:
    return np.array([*camera.focal, *camera.center, *np.ravel(camera.camera_from_world.rotation)], np.float64)


def _points(pixels: np.ndarray, depth: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """World points [n,3] (m) of pixels (row, column)."""
    points = np.empty((len(pixels), 3))
    world_points(np.ascontiguousarray(pixels), depth, _view(camera), np.asarray(camera.position, float), points)
    return points
