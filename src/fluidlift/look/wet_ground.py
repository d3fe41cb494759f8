"""Ground that liquid stands on, in the picture behind that liquid: wet ground is darker than dry ground.

`ground_picture` knows how much light the liquid lets through to the ground. Here is what its surface does to that
light: it bends the ways down, and throws most of what matt ground sends up back onto it (`optics.wet_light`, for even
light; the strongest light has one way down).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numba as nb
import numpy as np
from jaxtyping import Float

from fluidlift.look.environment_stack import fading
from fluidlift.look.liquid import Behind, SurfaceBuffer
from fluidlift.look.liquid_kernels import CLOSED, RESTS, ROOM
from fluidlift.look.materials import Material
from fluidlift.look.optics import fresnel, held_inside, wet_light, wet_table
from fluidlift.look.smoothstep import eased, smoothstep
from fluidlift.numerics.sharing import shared
from fluidlift.types.camera import PinholeCamera

ALBEDO = 0.4
"""of obstacles, whose own is not at hand"""
LOWEST = 0.1
"""cosine under which the strongest light falls in, at least"""
MOST = 1.5
"""optical depth that bent ways are shorter than straight ones, at most: the shadow's own way may be another"""


def wetted(
    behind: Behind,
    surface: SurfaceBuffer,
    camera: PinholeCamera,
    material: Material,
    ground: tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]],
    *,
    shaded: bool = True,
) -> Behind:
    """The picture behind a liquid with the ground wet wherever liquid stands on it.

    Args:
        behind: the ground; what is not there (depth 0) is far away and stays dry.
        surface: of the liquid.
        camera: who looks.
        material: of the liquid.
        ground: linear albedo and depth (camera z, m) of the ground alone.
        shaded: the light that shows the ground there has come through the liquid; False: it is that of bare ground, and
            is weakened here, as even light would be.
    """
    image = behind.image.copy()
    pose = np.ascontiguousarray(camera.camera_from_world.rotation, np.float64)
    held = held_inside(float(material.refractive_index))
    fluxes = np.stack([*material.fluxes, np.full(3, held)])
    dampen(
        (surface.covered, surface.depth, surface.normal, surface.thickness, float(surface.grain)),
        (behind.depth, *(np.ascontiguousarray(g, np.float32) for g in ground)),
        np.array([*camera.focal, *camera.center, *(1.0 / f for f in camera.focal)], np.float64), pose, fluxes,
        np.stack(wet_table(float(material.refractive_index))), _slants(float(material.refractive_index)), shaded,
        np.zeros((0, 0, 4), np.float32) if behind.direct is None else np.asarray(behind.direct, np.float32), image,
    )  # fmt: skip
    return replace(behind, image=image)


@lru_cache(maxsize=16)
def _slants(index: float) -> np.ndarray:
    """For light that falls in under cosines from 0 to 1, evenly spaced: the share that enters, over n^2; the way
    inside, over the depth; the share that enters."""
    cos = np.linspace(0.0, 1.0, 513)
    enters = 1.0 - fresnel(np.maximum(cos, 1e-6), index)
    return np.stack([enters / index**2, 1.0 / np.sqrt(np.maximum(1.0 - (1.0 - cos**2) / index**2, 1e-6)), enters])


@nb.njit(cache=True, inline="always")
def _under_cloud(depth, cloud, held, back):
    """How many times more light gets through a cloudy layer than fades over its depth (fading times m); and the share
    of the ground's own light that comes back to it, from the cloud, and `back` from the surface of a clear layer.
    cloud, held: as of `optics.passed`."""
    if cloud <= 0.0:
        return 1.0, back
    twice, r = math.exp(-2.0 * depth), cloud * cloud
    many = max(1.0 - r * twice, 1e-30)
    thrown, through = cloud * (1.0 - twice) / many, (1.0 - r) / many
    again = 1.0 / (1.0 - held * thrown)
    return through * again, thrown + back * through * through * again


@shared(lambda liquid, *_: (0, liquid[1].shape[0]), error_model="numpy")
def dampen(lead, stop, liquid, ground, lens, pose, fluxes, table, slants, shaded, direct, image):
    """`wetted_plain`, pixel by pixel. liquid: covered, depth, normal, thickness, grain; ground: depth of what is
    behind, albedo and depth of the ground alone; fluxes: fading (1/m) and cloud (`Material.fluxes`), and what the
    surface holds inside; table: of `optics.wet_table`; slants: of `_slants`;
    direct: of `Behind`, or empty."""
    covered, near, normals, thickness, grain = liquid
    behind, albedo, own = ground
    extinction, cloud, held = fluxes[0], fluxes[1], fluxes[2, 0]
    last = table.shape[1] - 1
    # the table is even in the roots of depths, and the root of a product is that of its factors
    roots = last * np.sqrt(extinction / table[0, -1])
    steps, straight_in = slants.shape[1] - 1, slants[2, -1]
    for i in range(lead, stop):
        y = (i + 0.5 - lens[3]) * lens[5]
        for j in range(near.shape[1]):
            z, end = np.float64(near[i, j]), np.float64(behind[i, j])
            if not (covered[i, j] > 0.0 and z > 0.0 and end > z):
                continue
            x = (j + 0.5 - lens[2]) * lens[4]
            away = math.sqrt(x * x + y * y + 1.0)
            nearer = 1.0 / away
            thick = min(np.float64(thickness[i, j]), (end - z) * away)
            gap, room = end - z - thick * nearer - CLOSED * grain, max(RESTS * thick, ROOM * z * lens[4], 1e-9)
            if gap >= room:
                continue
            cos = 0.0
            for k in range(3):
                cos -= normals[i, j, k] * (pose[0, k] * x + pose[1, k] * y + pose[2, k])
            height = thick * min(max(cos * nearer, 0.0), 1.0)
            share = covered[i, j] * (1.0 - gap / room if gap > 0.0 else 1.0)
            if grain > 0.0:
                share *= eased(height / grain)
            longer, straight, enters = 1.0, 1.0, 0.0
            if direct.shape[0] > 0:
                at = min(max(np.float64(direct[i, j, 3]), LOWEST), 1.0) * steps
                low = min(int(at), steps - 1)
                part = at - low
                longer = slants[1, low] + part * (slants[1, low + 1] - slants[1, low])
                enters = slants[0, low] + part * (slants[0, low + 1] - slants[0, low])
                straight = steps / at
            same, root = abs(end - own[i, j]) <= 1e-4 * own[i, j], math.sqrt(height)
            for k in range(3):
                at = min(root * roots[k], np.float64(last))
                low = min(int(at), last - 1)
                part = at - low
                arrives = table[1, low] + part * (table[1, low + 1] - table[1, low])
                back = table[2, low] + part * (table[2, low + 1] - table[2, low])
                through, back = _under_cloud(extinction[k] * height, cloud[k], held, back)
                if not shaded:
                    arrives *= (table[3, low] + part * (table[3, low + 1] - table[3, low])) * through
                color = np.float64(albedo[i, j, k]) if same else ALBEDO
                first, light = 0.0, np.float64(image[i, j, k])
                if direct.shape[0] > 0:
                    first, depth = min(np.float64(direct[i, j, k]), light), height * extinction[k]
                    if shaded:  # by a straight way, and less what is mirrored straight on
                        way = math.exp(min(depth * (straight - longer), MOST)) / straight_in
                    else:
                        way = fading(depth * longer) * through
                    first, light = first * enters * way, light - first
                wet = (light * arrives + first) / (1.0 - color * back)
                image[i, j, k] += share * (wet - image[i, j, k])


def wetted_plain(
    behind: Behind,
    surface: SurfaceBuffer,
    camera: PinholeCamera,
    material: Material,
    ground: tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]],
    *,
    shaded: bool = True,
) -> Behind:
    """What `wetted` does, in NumPy, for reading."""
    share, height = standing(surface, behind, camera)
    wet = share > 0
    albedo, depth = ground
    own = np.abs(behind.depth[wet] - depth[wet]) <= 1e-4 * depth[wet]
    color = np.where(own[:, None], albedo[wet], ALBEDO)
    fade, cloud = material.fluxes
    thick = height[wet, None] * fade
    arrives, back, straight = wet_light(thick, material.refractive_index)
    # a cloud lets more through than fades, sends some back to the ground, and holds up what the surface throws back
    many = 1.0 - cloud**2 * np.exp(-2.0 * thick)
    through, thrown = (1.0 - cloud**2) / many, cloud * (1.0 - np.exp(-2.0 * thick)) / many
    again = 1.0 / (1.0 - held_inside(float(material.refractive_index)) * thrown)
    back = thrown + back * through**2 * again
    through = through * again
    straight = straight * through
    image = behind.image.copy()
    dry, first = image[wet], np.zeros((int(wet.sum()), 3))
    even = dry
    if behind.direct is not None:
        slant = np.clip(behind.direct[wet][:, 3:], LOWEST, 1.0).astype(np.float64)
        first = np.minimum(behind.direct[wet][:, :3], dry)
        even = dry - first
        index = material.refractive_index
        bent = np.sqrt(1.0 - (1.0 - slant**2) / index**2)
        way = np.exp(-thick / bent) * through
        if shaded:
            way = np.exp(np.minimum(thick / slant - thick / bent, MOST)) / (1.0 - fresnel(np.ones(1), index))
        first = first * way * (1.0 - fresnel(slant, index)) / index**2
    light = even * (arrives if shaded else arrives * straight) + first
    image[wet] += share[wet, None] * (light / (1.0 - color * back) - dry)
    return replace(behind, image=image)


def standing(
    surface: SurfaceBuffer, behind: Behind, camera: PinholeCamera
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """How much of what a pixel shows behind the liquid has that liquid standing on it, 0 to 1, and metres of it across
    its surface. The same gaps count as none as for the light that leaves it (`liquid_kernels`)."""
    rays = camera.rays(camera.pixel_grid()).astype(np.float32)
    away = np.linalg.norm(rays, axis=-1)
    z, end = surface.depth, behind.depth
    there = (surface.covered > 0) & (z > 0) & (end > z)
    thick = np.minimum(surface.thickness, (end - z) * away)
    gap = end - z - thick / away - CLOSED * surface.grain
    free = np.clip(gap / np.maximum(np.maximum(RESTS * thick, ROOM * z / camera.focal[0]), 1e-9), 0.0, 1.0)
    cos = np.clip(-np.einsum("hwk,hwk->hw", surface.normal, rays) / away, 0.0, 1.0)
    height = thick * cos
    # a film thinner than its particles can tell fades out, and what it wets with it
    film = smoothstep(height, 0.0, surface.grain) if surface.grain > 0 else 1.0
    share = np.where(there, surface.covered * (1.0 - free) * film, 0.0)
    return share.astype(np.float32), np.where(there, height, 0.0)
