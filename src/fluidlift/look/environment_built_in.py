"""Light for pictures without a panorama: a clear day and a studio, as equirectangular pictures."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from fluidlift.look.environment_filter import solid_angles
from fluidlift.look.environment_lookup import grid_directions
from fluidlift.look.smoothstep import smoothstep

ROWS = 256
"""of a built-in picture: 0.7 degrees each"""

SUN = (40.0, -95.0)
"""degrees: elevation, azimuth from +y towards +x: at the left of a viewer who looks along +y"""
SUN_RADIUS = 1.5
"""degrees; larger than the real one (0.27) so that it does not fall between pixels, with the same light"""
SUN_SHARE = 0.7
"""of the sun in the irradiance of level ground on a clear day, at this elevation"""
SUN_COLOR = (1.0, 0.93, 0.82)
GROUND = (0.20, 0.17, 0.13)
"""linear albedo of dry earth"""

ROOM = 0.12
"""radiance of the studio's walls"""
BOXES = (
    # elevation, azimuth (degrees), half height, half width (degrees), radiance, colour
    (55.0, -55.0, 16.0, 24.0, 9.0, (1.0, 0.97, 0.92)),
    (30.0, 70.0, 28.0, 9.0, 3.5, (0.90, 0.95, 1.0)),
    (25.0, 172.0, 8.0, 40.0, 2.5, (1.0, 1.0, 1.0)),
    (86.0, 0.0, 14.0, 14.0, 2.0, (1.0, 1.0, 1.0)),
)
"""key at the left, ahead; a tall strip at the right; a wide one behind the viewer; one above"""


def _unit(elevation: float, azimuth: float) -> np.ndarray:
    e, a = math.radians(elevation), math.radians(azimuth)
    return np.array([math.cos(e) * math.sin(a), math.cos(e) * math.cos(a), math.sin(e)])


def _level_irradiance(radiance: np.ndarray) -> float:
    """Luminance of a white level body under this light."""
    weights = solid_angles(len(radiance)) * np.maximum(np.cos((np.arange(len(radiance)) + 0.5) * math.pi / ROWS), 0.0)
    luminance = radiance.mean(axis=1) @ np.array([0.2126, 0.7152, 0.0722])
    return float(luminance @ weights / weights.sum())


def sky_radiance() -> Float[np.ndarray, "h 2*h 3"]:
    """A clear day, linear float32, scaled so that a level white body has luminance 1.

    The brightness of the sky is the CIE's standard clear one of low turbidity (ISO 15469, type 12); its colour goes
    from blue above to a pale horizon, and to white around the sun.
    """
    d = grid_directions(ROWS).astype(np.float64)
    sun = _unit(*SUN)
    up = np.maximum(d[..., 2], 0.0)
    apart = np.arccos(np.clip(d @ sun, -1.0, 1.0))
    gradation = 1.0 - np.exp(-0.32 / np.maximum(up, 0.01))
    scattered = 1.0 + 10.0 * (np.exp(-3.0 * apart) - math.exp(-1.5 * math.pi)) + 0.45 * np.cos(apart) ** 2
    pale = np.exp(-5.0 * up)[..., None] + 0.6 * np.exp(-6.0 * apart)[..., None]
    blue, white = np.array([0.42, 0.66, 1.25]), np.array([0.95, 1.0, 1.06])
    air = (gradation * scattered)[..., None] * (blue + (white - blue) * np.minimum(pale, 1.0))
    above = d[..., 2] > 0
    air = np.where(above[..., None], air, 0.0)
    air *= (1 - SUN_SHARE) / _level_irradiance(air)
    disc = 1.0 - smoothstep(np.degrees(apart), 0.6 * SUN_RADIUS, 1.4 * SUN_RADIUS)
    disc = disc[..., None] * np.array(SUN_COLOR)
    light = air + disc * (SUN_SHARE / _level_irradiance(disc))
    # the ground returns its share of what falls on it; the horizon lies in haze
    haze = np.exp(-np.maximum(-d[..., 2], 0.0) / 0.03)[..., None]
    horizon = light[ROWS // 2 - 1].mean(axis=0)
    light = np.where(above[..., None], light, haze * 0.5 * horizon + (1 - 0.5 * haze) * np.array(GROUND))
    return light.astype(np.float32)


def studio_radiance() -> Float[np.ndarray, "h 2*h 3"]:
    """A dark room with soft boxes, linear float32, scaled so that a level white body has luminance 1."""
    d = grid_directions(ROWS).astype(np.float64)
    wall = ROOM * (0.55 + 0.45 * smoothstep(d[..., 2], -0.4, 0.8))
    light = np.repeat(wall[..., None], 3, axis=2)
    for elevation, azimuth, half_height, half_width, radiance, color in BOXES:
        forward = _unit(elevation, azimuth)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        ahead = d @ forward
        across = np.degrees(np.arctan2(np.abs(d @ right), ahead))
        along = np.degrees(np.arctan2(np.abs(d @ np.cross(right, forward)), ahead))
        inside = (1 - smoothstep(across, half_width - 2, half_width + 2)) * (
            1 - smoothstep(along, half_height - 2, half_height + 2)
        )
        light += np.where(ahead > 0, inside, 0.0)[..., None] * radiance * np.array(color)
    return (light / _level_irradiance(light)).astype(np.float32)
