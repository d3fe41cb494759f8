"""White water on the surface of a clear liquid: what its splats show brighter than it could mirror.

Water that falls or breaks is full of air and white from everywhere; drawn as clear water it would hardly be seen. The
colours of the splats are those of the film, or of simulated white water. A mirror explains `GLARE` (F - F0) of them,
with F Fresnel's share for the clip's camera and F0 that straight on, where it mirrors the side of the camera and no
sky: on a calm river at a flat view all that is seen, on a fall's face next to nothing.
What is brighter is foam, by how near it is to the brightest of the clip's fluid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.look.environment import Environment
from fluidlift.look.liquid import SurfaceBuffer
from fluidlift.look.liquid_kernels import reflectance
from fluidlift.look.optics import fresnel
from fluidlift.look.smoothstep import eased, smoothstep
from fluidlift.numerics.sharing import shared
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types import PinholeCamera

GLARE = 8.0
"""linear radiance of the brightest sky that a surface may mirror, 1 being white in the clip: three stops over it, as a
hazy sky is over trees and water that are exposed well. A flat view is built steeper than it is, too (a relief)"""
BRIGHTEST = 80.0
"""percentile of the fluid's darkest channel that counts as white: of falls and rapids a fifth is nothing but foam"""
BROAD = 0.03
"""of the picture's longer side, over which the surface's normal is smoothed: bumps of it are those of particles"""
FINE = 6.0
"""samples per standard deviation of that, at least: next to all pixels no mean of unit normals, be they noise, changes
by 0.01"""
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

    def cover(self, surface: SurfaceBuffer, camera: PinholeCamera, refractive_index: float) -> Float[np.ndarray, "h w"]:
        """Share, 0 to 1, of each pixel's surface that foam hides.

        Args:
            surface: as `camera` sees it.
            camera: who looks.
            refractive_index: of the liquid.
        """
        found = np.zeros(surface.depth.shape, np.float32)
        broad = _smoothed(surface.normal * (surface.depth > 0)[..., None])
        pose, eye = camera.camera_from_world, np.asarray(self.eye, np.float64) - camera.position
        lens = np.array([*camera.focal, *camera.center], np.float64)
        numbers = np.array([refractive_index, self.white, GLARE, *COVERS], np.float64)
        rotation = np.ascontiguousarray(pose.rotation, np.float64)
        foam_kernel(surface.depth, broad, surface.albedo, (lens, rotation), eye, numbers, found)
        return found

    def cover_plain(
        self, surface: SurfaceBuffer, camera: PinholeCamera, refractive_index: float
    ) -> Float[np.ndarray, "h w"]:
        """What `cover` does, in NumPy, for reading."""
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


@shared(lambda depth, *_: (0, depth.shape[0]), error_model="numpy")
def foam_kernel(begin, end, depth, normals, carried, view, eye, numbers, out):
    """`FilmedWhite.cover_plain` from smoothed normals, pixel by pixel. view: fx, fy, cx, cy, and the camera's rotation;
    eye: where the clip's camera stood, from this one's place on (m, world); numbers: refractive index, white, `GLARE`,
    `COVERS`."""
    lens, rotation = view
    index, white, glare, some, whole = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    straight = reflectance(1.0, index)
    for i in range(begin, end):
        y = (i + 0.5 - lens[3]) / lens[1]
        for j in range(depth.shape[1]):
            z = np.float64(depth[i, j])
            if not z > 0.0:
                continue
            x, along, way, long = (j + 0.5 - lens[2]) / lens[0], 0.0, 0.0, 0.0
            for k in range(3):
                n = np.float64(normals[i, j, k])
                w = eye[k] - z * (rotation[0, k] * x + rotation[1, k] * y + rotation[2, k])
                along, way, long = along + w * n, way + w * w, long + n * n
            cosine = abs(along) / max(math.sqrt(way) * math.sqrt(long), 1e-9)
            share = reflectance(min(cosine, 1.0), index) if cosine > 0.0 else 1.0
            least = min(carried[i, j, 0], carried[i, j, 1], carried[i, j, 2])
            left = (least - glare * (share - straight)) / white
            out[i, j] = eased((left - some) / (whole - some))


def _smoothed(normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Blurred over `BROAD`. A bell of tens of pixels is as well known in a smaller picture, of means over squares of a
    `FINE`-th of it, read between them: by squares and reading it gets as much wider as it is narrower there."""
    import cv2

    height, width = normal.shape[:2]
    sigma = max(BROAD * max(height, width), 1.0)
    step = int(sigma / FINE)
    if step < 2:
        return cv2.GaussianBlur(normal, (0, 0), sigma)
    # a square of n pixels has the variance (n^2 - 1) / 12, reading between samples n apart n^2 / 6
    narrow = np.sqrt(sigma**2 - (step**2 - 1) / 12.0 - step**2 / 6.0) / step
    down, right = -height % step, -width % step
    whole = cv2.copyMakeBorder(normal, 0, down, 0, right, cv2.BORDER_REFLECT_101) if down or right else normal
    few = cv2.resize(whole, (whole.shape[1] // step, whole.shape[0] // step), interpolation=cv2.INTER_AREA)
    few = cv2.GaussianBlur(few, (0, 0), float(narrow))
    return cv2.resize(few, (whole.shape[1], whole.shape[0]), interpolation=cv2.INTER_LINEAR)[:height, :width]


def with_foam(
    image: Float[np.ndarray, "h w 3"],
    surface: SurfaceBuffer,
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
