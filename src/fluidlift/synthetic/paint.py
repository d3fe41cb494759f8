"""Colours for synthetic pictures: noise, ground, water and honey under a sun and a sky. No physics, only looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import ndimage

SUN = np.array([-0.35, -0.45, 0.82]) / np.linalg.norm([-0.35, -0.45, 0.82])
"""towards the sun"""
ZENITH, HORIZON = np.array([0.22, 0.42, 0.75]), np.array([0.62, 0.70, 0.76])
"""linear colours of the sky"""


@dataclass(frozen=True)
class Noise:
    """Smooth random values, uniform in [0, 1], that repeat after `period` m."""

    table: Float[np.ndarray, "k k k"]
    period: float

    @classmethod
    def make(cls, rng: np.random.Generator, period: float, blur: float = 1.0, cells: int = 40) -> Noise:
        """White noise on `cells`^3 points, smoothed over `blur` of them and mapped to a uniform distribution."""
        raw = ndimage.gaussian_filter(rng.standard_normal((cells,) * 3), blur, mode="wrap")
        rank = np.empty(raw.size)
        rank[np.argsort(raw, axis=None)] = (np.arange(raw.size) + 0.5) / raw.size
        return cls(rank.reshape(raw.shape).astype(np.float32), period)

    def at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Values at points (m)."""
        at = np.asarray(points) / self.period * len(self.table)
        return ndimage.map_coordinates(self.table, at.T, order=1, mode="grid-wrap")


def smoothstep(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below `low`, 1 above `high`, cubic between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def mix(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """a where share is 0, b where it is 1; colours [n,3] or [3], share [n]."""
    return a + (b - a) * share[:, None]


def sky(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Linear colour of the sky in directions (unit), without the sun."""
    return mix(HORIZON, ZENITH, np.clip(directions[:, 2], 0, 1) ** 0.5)


def lit(color: np.ndarray, normals: Float[np.ndarray, "n 3"], shadow: np.ndarray | float = 1.0) -> np.ndarray:
    """A dull surface under sun and sky."""
    sun = np.clip(normals @ SUN, 0, 1) * shadow
    return color * (0.95 * sun + 0.22 + 0.16 * normals[:, 2])[:, None]


def to_picture(linear: Float[np.ndarray, "h w 3"]) -> np.ndarray:
    """u8 sRGB of linear colours: a soft shoulder, then the sRGB curve."""
    x = np.clip(linear, 0, None)
    x = np.where(x > 0.8, 0.8 + 0.2 * (1 - np.exp(-(x - 0.8) / 0.2)), x)
    x = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * np.clip(x, 0, 1)).astype(np.uint8)


@dataclass(frozen=True)
class GroundPaint:
    """Earth, sand and grass by height above the bed, and grey rock."""

    coarse: Noise
    fine: Noise
    pebbles: Noise
    dark: tuple[float, float, float] = (0.085, 0.060, 0.038)
    light: tuple[float, float, float] = (0.235, 0.165, 0.100)
    rock: tuple[float, float, float] = (0.21, 0.205, 0.195)
    grass: tuple[float, float, float] = (0.085, 0.115, 0.035)

    def color(self, points: np.ndarray, shares: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Linear colours at points (m); `shares` of rock, green and wet."""
        a, b, c = self.coarse.at(points), self.fine.at(points), self.pebbles.at(points)
        rock, green, wet = np.moveaxis(shares, -1, 0)
        earth = mix(np.array(self.dark), np.array(self.light), 0.45 * a + 0.3 * b + 0.25 * c)
        earth = earth * (0.86 + 0.32 * smoothstep(c, 0.45, 0.95))[:, None]
        turf = np.array(self.grass) * (0.35 + 0.5 * b + 0.35 * a + 0.45 * c)[:, None]
        stone = np.array(self.rock) * (0.45 + 0.5 * b + 0.25 * a + 0.2 * c)[:, None]
        dry = mix(mix(earth, turf, smoothstep(green + 0.35 * (a - 0.5), 0.3, 0.7)), stone, rock)
        return dry * (1 - 0.5 * wet)[:, None]


@dataclass(frozen=True)
class LiquidPaint:
    """How a liquid looks: its own colour, how fast it hides the bed, and the tone of what drifts on it."""

    body: tuple[float, float, float] = (0.010, 0.072, 0.078)
    absorption: tuple[float, float, float] = (26.0, 13.0, 12.0)
    """1/m for red, green, blue"""
    foam: tuple[float, float, float] = (0.80, 0.84, 0.84)
    foam_from: float = 0.62
    """tracer value at which foam begins (0 to 1)"""
    foam_to: float = 0.76
    gloss: float = 1.0

    def color(
        self, normals: np.ndarray, view: np.ndarray, thickness: np.ndarray, bed: np.ndarray, tracer: np.ndarray
    ) -> np.ndarray:
        """Linear colours [n,3].

        Args:
            normals: unit, out of the liquid.
            view: unit, from the eye to the surface.
            thickness: m along the view to the bed.
            bed: linear colours of the bed behind.
            tracer: [n,2], streaks and grain in [0, 1].
        """
        facing = np.clip(-(normals * view).sum(-1), 0, 1)
        mirror = view + 2 * facing[:, None] * normals
        mirror = mirror / np.maximum(np.linalg.norm(mirror, axis=-1, keepdims=True), 1e-9)
        pass_through = np.exp(-np.asarray(self.absorption) * thickness[:, None])
        own = np.asarray(self.body) * (0.75 + 0.5 * tracer[:, 1])[:, None]
        below = bed * pass_through + lit(own, normals) * (1 - pass_through) * 1.6
        fresnel = 0.02 + 0.98 * (1 - facing) ** 5
        glint = self.gloss * 1.5 * np.clip(mirror @ SUN, 0, 1) ** 90
        water = mix(below, sky(mirror), np.clip(self.gloss * fresnel, 0, 1)) + glint[:, None]
        foam = smoothstep(0.6 * tracer[:, 0] + 0.4 * tracer[:, 1], self.foam_from, self.foam_to)
        foam = foam * (1 - np.exp(-thickness / 0.012))
        return mix(water, lit(np.asarray(self.foam), normals), 0.88 * foam)
