"""What the slope of a water surface does to its brightness, seen at a slant.

A surface mirrors and shows its body by its slope (Stilwell 1969). *Assumption:* the sky is equally bright everywhere,
and the water's body gives back `BODY` of its light. Then L(s) = F + (1 - F) R, F Fresnel's reflectance at the angle of
view that a slope s towards the viewer makes, and d ln L / d s is known; R is not, and a sky that is darker at its
horizon takes away from it, so each slope comes with an interval. What stands on a shore is mirrored as well: a slope s
moves its picture by 2 s, and brightness changes as the mean picture does over that angle. *Limit:* slopes across the
line of sight change no brightness to first order.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.look.optics import fresnel

BODY = (0.02, 0.05, 0.15)
"""irradiance reflectance of the water's body: clear and deep, usual, muddy (Kirk 1994 has 0.01 to 0.2 for rivers)"""
WATER = 1.33
"""refractive index"""


def brightness_of_slope(incidence: float, body: float, *, horizon: float = 1.0) -> float:
    """d ln L / d s of water seen at an angle (radians from the plumb line), per slope towards the viewer; not signed.

    Args:
        incidence: 0 to pi / 2.
        body: irradiance reflectance.
        horizon: brightness of the sky at its horizon over that at its zenith, between which it goes with the sine of
            the elevation: 1 is a uniform sky, 1/3 CIE's overcast one.
    """

    def light(s: float) -> float:
        reflected = float(_mirrored(np.array([incidence - s]))[0])
        elevation = np.clip(0.5 * np.pi - incidence + 2.0 * s, 0.0, 0.5 * np.pi)
        sky = horizon + (1.0 - horizon) * np.sin(elevation)
        # irradiance over pi of such a sky, in its zenith's radiance
        return reflected * sky + (1.0 - reflected) * body * (horizon + (1.0 - horizon) * 2.0 / 3.0)

    step = 0.01
    return abs(float(np.log(light(step)) - np.log(light(-step)))) / (2.0 * step)


def level_brightness(incidence: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Brightness of level water of usual body at angles (radians from the plumb line), under a uniform sky of 1; above
    the horizon that of the horizon."""
    share = _mirrored(incidence)
    return share + (1.0 - share) * BODY[1]


def mirrored_share(incidence: float) -> float:
    """Of the light that such water sends at an angle (radians from the plumb line), what it mirrors."""
    angle = np.array([incidence])
    return float((_mirrored(angle) / level_brightness(angle))[0])


def _mirrored(incidence: np.ndarray) -> np.ndarray:
    """Fresnel's reflectance of water at angles [n] (radians from the plumb line)."""
    return fresnel(np.cos(np.clip(incidence, 0.0, 0.5 * np.pi)), WATER)


def gain_and_range(incidence: float, mirrored: float = 0.0) -> tuple[float, tuple[float, float]]:
    """d ln L / d s (usual body, uniform sky), and low and high factor by which a slope may be off.

    Args:
        incidence: radians from the plumb line.
        mirrored: d ln L / d s by what stands on the shore, root mean square over the surface.
    """
    usual = brightness_of_slope(incidence, BODY[1])
    # 0.6: half way, in logarithm, to CIE's overcast sky, under which the horizon may cancel Fresnel's part altogether
    other = [brightness_of_slope(incidence, body, horizon=h) for body in BODY for h in (1.0, 0.6)]
    gain = float(np.hypot(usual, mirrored))
    # what stands on the shore may be sharper than its mean over time, or be the bed, seen through the water
    return gain, (gain / float(np.hypot(max(other), 2.0 * mirrored)), gain / max(min(other), 0.2 * usual))
