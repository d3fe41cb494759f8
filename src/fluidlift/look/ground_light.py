"""What light reaches points of surfaces: shadow maps of things that stay, kept, and of things that move.

The environment is taken apart: its strongest light casts one shadow with a soft edge (Williams 1978; Fernando 2005),
and the rest comes from some directions all around, each with a shadow map of its own, which together are the ambient
occlusion. Through a liquid light passes: it is absorbed along its way, so that honey throws an amber shadow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.look.ground_kernels import TILE, shadowed, tap_places
from fluidlift.look.materials import Material
from fluidlift.look.optics import fresnel, held_inside, passed, transmittance
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
FAINT = 0.02
"""share of the strongest light under which it is no light of its own"""
SOFT = 0.012
"""half width of the strongest light's shadow edge, of the scene's radius"""
PLACES = 16
"""of the radius of what stays: steps in which the maps of what moves are placed, so that their edges do not crawl"""


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


@dataclass(frozen=True)
class Casters:
    """What casts shadows. Its maps are kept: they are drawn once, however many points ask for them."""

    vertices: np.ndarray
    faces: np.ndarray
    caster: TriangleMesh | None
    material: Material | None
    middle: np.ndarray
    radius: float
    share: float = 1.0
    """of the width of a map: things that move get texels as large as those of what stays"""
    inset: float = 0.0
    """m that the caster stands outside of the liquid that it is made of: shadows begin so far behind its surface"""
    _maps: dict = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(
        cls,
        meshes: Sequence[TriangleMesh],
        caster: TriangleMesh | None = None,
        material: Material | None = None,
        beside: Casters | None = None,
        *,
        inset: float = 0.0,
    ) -> Casters | None:
        """Of opaque meshes and of a liquid, which lets light through if its material is known.

        Args:
            meshes, caster, material: as of `ground_picture.GroundMeshes` and its `picture`.
            beside: what stays, where these are what moves.
            inset: m, as of the field.

        Returns:
            None where nothing has a face.
        """
        meshes = [m for m in meshes if len(m.faces)]
        caster = caster if caster is not None and len(caster.faces) else None
        if not meshes and caster is None:
            return None
        counts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        vertices = np.concatenate([np.zeros((0, 3)), *(np.asarray(m.vertices, np.float64) for m in meshes)])
        faces = np.concatenate(
            [np.zeros((0, 3), int), *(np.asarray(m.faces) + first for m, first in zip(meshes, counts))]
        )
        all_points = vertices if caster is None else np.concatenate([vertices, caster.vertices])
        low, high = all_points.min(axis=0), all_points.max(axis=0)
        middle, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-9)
        if beside is None:
            return cls(vertices, faces, caster, material, middle, radius, inset=inset)
        step = beside.radius / PLACES
        middle = step * np.round(middle / step)
        radius = step * math.ceil(radius / step + 1.0)
        return cls(vertices, faces, caster, material, middle, radius, min(radius / beside.radius, 4.0), inset)

    def light_left(
        self, points: np.ndarray, normals: np.ndarray, toward: np.ndarray, size: int, soft: float
    ) -> np.ndarray:
        """Share [n,3] of the light from one direction that reaches points; `soft` (m): half width of the edges."""
        width = max(16, round(size * self.share))
        texel = 2.0 * self.radius / width
        key = (width, soft, *np.round(np.asarray(toward, float), 9))
        if key not in self._maps:
            self._maps[key] = self._map(np.asarray(toward, float), width, soft / texel)
        numbers, solid, first, left, tiles = self._maps[key]
        lit = np.empty((len(points), 3), np.float32)
        way = np.asarray(toward, np.float64)
        reach = soft / texel
        shadowed(points, normals, numbers, way, texel, solid, first, left, tiles, tap_places(reach), reach, lit)
        return lit

    def _map(self, toward: np.ndarray, size: int, reach: float) -> tuple[np.ndarray, ...]:
        """The light's own picture: its camera, depth of what lets nothing pass, depth at which the liquid begins, share
        of the light behind that, and the nearest depth in and around every tile."""
        eye = self.middle + AWAY * self.radius * toward
        pose = PinholeCamera.looking(eye, self.middle, 2.0, (1, 1)).camera_from_world
        focal = 0.5 * size * (AWAY - 1.0)
        sun = PinholeCamera((focal, focal), (size / 2, size / 2), (size, size), pose)
        solid = np.zeros((size, size), np.float32)
        if len(self.faces):
            solid = rasterize_triangles(self.vertices, self.faces, sun).depth
        first, left = np.zeros_like(solid), np.ones((*solid.shape, 3), np.float32)
        if self.caster is not None:
            first, left = self._through_caster(sun)
        numbers = np.array([focal, size / 2, size / 2, *np.ravel(pose.rotation), *pose.translation], np.float64)
        nearest = np.minimum(np.where(solid > 0, solid, np.inf), np.where(first > 0, first, np.inf))
        room = -size % TILE
        blocks = np.pad(nearest, ((0, room), (0, room)), constant_values=np.inf)
        tiles = blocks.reshape(len(blocks) // TILE, TILE, -1, TILE).min(axis=(1, 3))
        around = 2 * math.ceil((reach + 2.0) / TILE) + 1
        return numbers, solid, first, left, ndimage.minimum_filter(tiles, around, mode="constant", cval=np.inf)

    def _through_caster(self, sun: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
        """Depth at which the caster begins (0: nowhere), and the share of light left behind it."""
        assert self.caster is not None
        if self.material is None:
            found = rasterize_triangles(self.caster.vertices, self.caster.faces, sun)
            first = found.depth + np.float32(self.inset) * found.hit
            return first, np.where(found.hit, 0.0, 1.0)[..., None].repeat(3, axis=-1).astype(np.float32)
        closed = rasterize_closed(self.caster.vertices, self.caster.faces, sun)
        m = self.material
        inside = np.maximum(closed.inside - 2.0 * self.inset, 0.0)
        fade, cloud = (np.asarray(part, np.float32) for part in m.fluxes)
        held = held_inside(float(m.refractive_index))
        through = passed(fade, cloud, held, inside[..., None]) if cloud.any() else transmittance(fade, inside)
        through *= float(1.0 - fresnel(np.ones(1), m.refractive_index)[0])
        hit = closed.front.hit
        first = closed.front.depth + np.float32(self.inset) * hit
        return first, np.where(hit[..., None], through, 1.0).astype(np.float32)


@dataclass(frozen=True)
class Around:
    """Ambient light: directions, and the radiance that each stands for."""

    ways: Float[np.ndarray, "k 3"]
    radiance: Float[np.ndarray, "k 3"]

    @classmethod
    def of(cls, environment: Environment, count: int) -> Around:
        """Some directions of an environment, without its strongest light, which has a shadow of its own."""
        ways = spread_directions(count)
        radiance = np.maximum(environment.blurred(ways, 0.7), 1e-4) if count else np.zeros((0, 3), np.float32)
        toward, _, share = environment.light()
        near = ways @ toward > math.cos(math.radians(35.0))
        if share > FAINT and near.any() and not near.all():
            radiance[near] = np.minimum(radiance[near], radiance[~near].mean(axis=0))
        return cls(ways, radiance)

    def shares(self, points: np.ndarray, normals: np.ndarray, casters: Casters | None) -> np.ndarray | None:
        """What reaches points of each direction's light: [k,n,3], of opaque casters [k,n,1]; None: all of it."""
        if casters is None:
            return None
        kept = 3 if casters.caster is not None else 1
        found = [casters.light_left(points, normals, way, AMBIENT, 0.0)[:, :kept] for way in self.ways]
        return np.stack(found) if found else None

    def left(self, normals: np.ndarray, *shares: np.ndarray | None) -> np.ndarray:
        """Share [n,3] of all ambient light: what comes from each direction, weighted as it falls in."""
        n = len(normals)
        if not len(self.ways):
            return np.ones((n, 3), np.float32)
        total, left = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
        for k, (way, color) in enumerate(zip(self.ways, self.radiance, strict=True)):
            weight = np.maximum(normals @ way, 0.0).astype(np.float32)[:, None] * color
            total += weight
            for share in shares:
                if share is not None:
                    weight = weight * share[k]
            left += weight
        # undersides that none of the directions reaches stay as they are
        return np.where(total > 1e-5, left / np.maximum(total, 1e-5), 1.0).astype(np.float32)


def spread_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Unit directions spread evenly over the part of the sphere from a little below the horizon up (a spiral)."""
    z = 1.0 - (np.arange(count) + 0.5) / max(count, 1) * 1.15
    azimuth = math.pi * (1.0 + math.sqrt(5.0)) * (np.arange(count) + 0.5)
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=-1).astype(np.float32)


def direct_light(
    normals: np.ndarray, environment: Environment
) -> tuple[np.ndarray, np.ndarray | None, Float[np.ndarray, "3"]]:
    """All light (over pi) on surfaces with these normals; the strongest light's part (None: it does not stand out); and
    the direction towards it."""
    toward, strength, share = environment.light()
    whole = environment.irradiance(normals)
    if share <= FAINT or len(normals) == 0:
        return whole, None, toward
    return whole, np.minimum(np.clip(normals @ toward, 0.0, None)[:, None] * strength, whole), toward
