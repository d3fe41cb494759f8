"""The light around a scene: a picture of all directions, and what surfaces of any roughness see of it.

Axes: the picture is equirectangular, [h,2h,3], linear light, z up. The first row looks up (+z), the last one down; the
middle of the picture looks along +y, its right quarter along +x, its left quarter along -x and its edges along -y: what
someone sees who stands inside and faces +y. Radiance has no unit here: a white diffuse body in a white environment of
radiance 1 has radiance 1, which is white on a display at exposure 0.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float

from fluidlift.errors import InputRejected, require
from fluidlift.look.environment_built_in import sky_radiance, studio_radiance
from fluidlift.look.environment_filter import Lobe, clamped_cosine, convolved, ggx_lobe, resized, solid_angles
from fluidlift.look.environment_lookup import grid_directions, lookup

BUILT_IN = ("white", "sky", "studio")
"""environments that need no file"""

LEVELS = ((0.12, 128), (0.2, 128), (0.35, 64), (0.5, 64), (0.7, 32), (1.0, 32))
"""roughness and rows of the prefiltered pictures: each lobe is wider than a pixel of its picture"""
DIFFUSE_ROWS = 32
"""of the picture of the irradiance, whose lobe is a hemisphere"""
LIGHT_ROWS = 128
"""of the picture in which the strongest light is looked for, and from which the others are made"""
LIGHT_RADIUS = 20.0
"""degrees around its brightest point that belong to a light: a sun with its glow, a soft box"""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""of linear sRGB (IEC 61966-2-1)"""


@dataclass(frozen=True, eq=False)
class Environment:
    """Light from infinitely far away. Filtered pictures are made when they are first asked for, and kept."""

    radiance: Float[np.ndarray, "h 2*h 3"]
    """float32, linear, equirectangular, z up; the module says which direction is where"""

    def __post_init__(self) -> None:
        r = np.ascontiguousarray(self.radiance, np.float32)
        require(r.ndim == 3 and r.shape[1:] == (2 * r.shape[0], 3) and len(r) >= 2, f"radiance {r.shape}", "[h,2h,3]")
        require(bool(np.isfinite(r).all()) and float(r.min()) >= 0, "radiance that is negative or not finite", ">= 0")
        object.__setattr__(self, "radiance", r)

    @classmethod
    def white(cls, radiance: float = 1.0) -> Environment:
        """The same light from everywhere (linear)."""
        return cls(np.full((16, 32, 3), radiance, np.float32))

    @classmethod
    def sky(cls) -> Environment:
        """A clear day: sun at 40 degrees, pale horizon, brown ground. A level white body has luminance 1."""
        return cls(sky_radiance())

    @classmethod
    def studio(cls) -> Environment:
        """A dark room with soft boxes. A level white body has luminance 1."""
        return cls(studio_radiance())

    def turned(self, degrees: float) -> Environment:
        """Turned about z, from +x towards +y: what was seen along +x is then seen along +y at 90 degrees."""
        columns = -degrees / 360.0 * self.radiance.shape[1]
        whole = math.floor(columns)
        part = np.float32(columns - whole)
        a, b = np.roll(self.radiance, whole, axis=1), np.roll(self.radiance, whole + 1, axis=1)
        return Environment((1 - part) * a + part * b if part > 1e-6 else a)

    def toward(self, directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Linear radiance float32 that comes from these directions (of any length)."""
        return lookup(self.radiance, directions)

    def blurred(
        self, directions: Float[np.ndarray, "*n 3"], roughness: float | Float[np.ndarray, "*n"]
    ) -> Float[np.ndarray, "*n 3"]:
        """What a rough mirror shows whose reflected ray goes in these directions: linear radiance, float32.

        The GGX lobe (alpha = roughness squared) is that of a viewer straight above, as in Karis, "Real Shading in
        Unreal Engine 4", 2013; between a few prefiltered roughnesses the result is interpolated.

        Args:
            directions: reflected rays, of any length.
            roughness: 0 (the environment itself) to 1; one number, or one per direction.
        """
        if np.ndim(roughness) == 0:
            sharper, duller, share = self.between(float(roughness))
            out = lookup(sharper, directions)
            return out if share == 0 else (1 - share) * out + share * lookup(duller, directions)
        directions = np.asarray(directions)
        at = np.broadcast_to(_level(roughness), directions.shape[:-1])
        out = np.zeros(directions.shape, np.float32)
        for k, picture in enumerate((self.radiance, *self._levels)):
            some = np.abs(at - k) < 1
            out[some] += (1 - np.abs(at[some] - k))[:, None].astype(np.float32) * lookup(picture, directions[some])
        return out

    def between(self, roughness: float) -> tuple[np.ndarray, np.ndarray, np.float32]:
        """The two pictures between which `blurred` interpolates, and the share of the duller one."""
        at = float(_level(roughness))
        if at == 0:
            return self.radiance, self.radiance, np.float32(0)
        pictures = (self.radiance, *self._levels)
        k = min(int(at), len(LEVELS) - 1)
        return pictures[k], pictures[k + 1], np.float32(at - k)

    def irradiance(self, normals: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """What falls on surfaces with these normals, over pi: the linear radiance of a white diffuse body there."""
        return lookup(self.diffuse, normals)

    @cached_property
    def mean(self) -> Float[np.ndarray, "3"]:
        """Radiance averaged over all directions, linear."""
        weights = solid_angles(len(self.radiance))
        total = (self.radiance.mean(axis=1, dtype=np.float64) * weights[:, None]).sum(axis=0)
        return (total / weights.sum()).astype(np.float32)

    def light(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
        """The strongest light, for shadows.

        What stands out from the surroundings within 20 degrees of the brightest point is taken to be one light.

        Returns:
            Unit direction towards it; the linear irradiance over pi that it alone gives a surface which faces it (the
            unit of `irradiance`, so that shadow is `irradiance(n) - max(n . direction, 0) * this`); and its share in
            the luminance of all that falls on such a surface, 0 (no light stands out) to 1.
        """
        return self._light

    @cached_property
    def _small(self) -> np.ndarray:
        return self.radiance if len(self.radiance) <= LIGHT_ROWS else resized(self.radiance, LIGHT_ROWS)

    @cached_property
    def _uniform(self) -> bool:
        """The same light from everywhere: every mean of it is that light."""
        return bool((self.radiance == self.radiance[0, 0]).all())

    def _filtered(self, rows: int, lobe: Lobe) -> np.ndarray:
        if self._uniform:
            return np.full((rows, 2 * rows, 3), self.radiance[0, 0], np.float32)
        return convolved(resized(self._small, rows), lobe)

    @cached_property
    def _levels(self) -> tuple[np.ndarray, ...]:
        return tuple(self._filtered(rows, ggx_lobe(roughness)) for roughness, rows in LEVELS)

    @cached_property
    def diffuse(self) -> Float[np.ndarray, "h 2*h 3"]:
        """The picture of the irradiance over pi, by normal."""
        return self._filtered(DIFFUSE_ROWS, clamped_cosine)

    @cached_property
    def _light(self) -> tuple[np.ndarray, np.ndarray, float]:
        if self._uniform:
            return np.array([0.0, 0.0, 1.0], np.float32), np.zeros(3, np.float32), 0.0
        small = resized(self._small, LIGHT_ROWS)
        directions = grid_directions(LIGHT_ROWS)
        weights = np.broadcast_to(solid_angles(LIGHT_ROWS)[:, None], small.shape[:2])
        bright = convolved(resized(small, LIGHT_ROWS // 4), ggx_lobe(0.35)) @ LUMINANCE  # no single hot pixel
        peak = grid_directions(LIGHT_ROWS // 4).reshape(-1, 3)[int(bright.argmax())]
        near = directions @ peak > math.cos(math.radians(LIGHT_RADIUS))
        around = (small * (weights * ~near)[..., None]).sum((0, 1)) / (weights * ~near).sum()
        excess = np.where(near[..., None], np.maximum(small - around, 0.0), 0.0) * weights[..., None]
        toward = np.einsum("hwc,c,hwk->k", excess, LUMINANCE, directions)
        if np.linalg.norm(toward) < 1e-6 * max(float(self.mean @ LUMINANCE), 1e-30):
            return np.array([0.0, 0.0, 1.0], np.float32), np.zeros(3, np.float32), 0.0
        toward = (toward / np.linalg.norm(toward)).astype(np.float32)
        given = (excess * np.maximum(directions @ toward, 0.0)[..., None]).sum((0, 1)) / math.pi
        whole = float(self.irradiance(toward) @ LUMINANCE)
        return toward, given.astype(np.float32), float(np.clip(given @ LUMINANCE / max(whole, 1e-30), 0.0, 1.0))


def _level(roughness: float | np.ndarray) -> np.ndarray:
    """Place among the environment itself (0) and its prefiltered pictures (1, 2, ...)."""
    steps = np.array([0.0, *(r for r, _ in LEVELS)])
    return np.interp(np.clip(roughness, 0.0, 1.0), steps, np.arange(len(steps)))


def built_in(name: str) -> Environment:
    """The environment of a name of `BUILT_IN`; the same one every time, with its filtered pictures.

    Raises:
        InputRejected: no such name.
    """
    if name not in BUILT_IN:
        near = difflib.get_close_matches(name, BUILT_IN, 1)
        raise InputRejected(
            f"no environment '{name}'",
            f"{', '.join(BUILT_IN)}, or a panorama (.hdr, .exr)",
            f"did you mean {near[0]}?" if near else "check the name",
        )
    return _made(name)


@lru_cache(maxsize=len(BUILT_IN))
def _made(name: str) -> Environment:
    return {"white": Environment.white, "sky": Environment.sky, "studio": Environment.studio}[name]()
