"""White water on the surface of a clear liquid: what its splats show brighter than it could mirror.

Water that falls or breaks is full of air and white from everywhere; drawn as clear water it would hardly be seen. The
colours of the splats are those of the film, or of simulated white water. A mirror explains `GLARE` (F - F0) of them,
with F Fresnel's share for the clip's camera and F0 that straight on, where it mirrors the side of the camera and no
sky: on a calm river at a flat view all that is seen, on a fall's face next to nothing.
What is brighter is foam, by how near it is to the brightest of the clip's fluid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.look.environment import Environment
from fluidlift.look.liquid import LiquidSurface
from fluidlift.look.optics import fresnel
from fluidlift.look.smoothstep import smoothstep
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types import PinholeCamera

GLARE = 8.0
"""linear radiance of the brightest sky that a surface may mirror, 1 being white in the clip: three stops over it, as a
hazy sky is over trees and water that are exposed well. A flat view is built steeper than it is, too (a relief)"""
BRIGHTEST = 80.0
"""percentile of the fluid's darkest channel that counts as white: of falls and rapids a fifth is nothing but foam"""
BROAD = 0.03
"""of the picture's longer side, over which the surface's normal is smoothed: bumps of it are those of particles"""
DARKEST_WHITE = 0.35
"""linear, which white is at least: the brightest of a dark river is no foam. Fresh foam in deep shade, two stops
down, has about that"""
COVERS = (0.35, 0.85)
"""of white, from which a pixel has some foam, and from which nothing but foam"""
ALBEDO = 0.9
"""linear, of foam that hides the water under it: dense bubbles scatter as snow does (in the visible; over the whole
spectrum of the sun whitecaps have 0.5 to 0.6, Koepke 1984)"""


@dataclass(frozen=True)
class FilmedWhite:
    """By what foam is told from a mirror image in the colours of a film."""

    eye: Float[np.ndarray, "3"]
    """where the clip's camera stood, m"""
    white: float
    """linear darkest channel of its foam"""

    @classmethod
    def of(cls, camera: PinholeCamera, colors: Float[np.ndarray, "n 3"]) -> FilmedWhite:
        """From the clip's camera and the sRGB colours (0 to 1) of its fluid."""
        darkest = np.clip(np.asarray(colors, np.float64), 0.0, 1.0).min(axis=1)
        brightest = float(np.percentile(linear_from_srgb(darkest), BRIGHTEST)) if len(darkest) else 1.0
        return cls(np.asarray(camera.position, np.float64), max(brightest, DARKEST_WHITE))

    def cover(self, surface: LiquidSurface, camera: PinholeCamera, refractive_index: float) -> Float[np.ndarray, "h w"]:
        """Share, 0 to 1, of each pixel's surface that foam hides.

        Args:
            surface: as `camera` sees it.
            camera: who looks.
            refractive_index: of the liquid.
        """
        found = np.zeros(surface.depth.shape, np.float32)
        there = surface.depth > 0
        points = camera.unproject(camera.pixel_grid()[there], surface.depth[there])
        way, normal = self.eye - points, _smoothed(surface.normal * there[..., None])[there]
        lengths = np.linalg.norm(way, axis=1) * np.linalg.norm(normal, axis=1)
        cosine = np.einsum("ni,ni->n", way, normal) / np.maximum(lengths, 1e-9)
        # what the clip's camera does not see has the colours of what it saw nearby
        share = fresnel(np.clip(np.abs(cosine), 0.0, 1.0), refractive_index)
        mirrored = GLARE * (share - fresnel(np.ones(1), refractive_index))
        left = surface.albedo[there].min(axis=-1) - mirrored
        found[there] = smoothstep(left / self.white, *COVERS)
        return found


def _smoothed(normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    import cv2

    return cv2.GaussianBlur(normal, (0, 0), max(BROAD * max(normal.shape), 1.0))


def with_foam(
    image: Float[np.ndarray, "h w 3"],
    surface: LiquidSurface,
    cover: Float[np.ndarray, "h w"],
    environment: Environment,
) -> Float[np.ndarray, "h w 3"]:
    """A picture of the liquid (linear) with foam that covers a share of it, matt and lit by the environment."""
    share = cover * surface.covered
    there = share > 0.0
    found = image.copy()
    light = ALBEDO * environment.irradiance(surface.normal[there])
    found[there] += share[there, None] * (light - found[there])
    return found
