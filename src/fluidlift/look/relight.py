"""Relighting of splats: image-based light, split sum; after GaussianShader (Jiang et al. 2024, arXiv:2311.17977).

    c = (1 - F) body irradiance(n) + F reflected(r, roughness) + glow

with the irradiance over pi and the reflected light both taken from an environment, and F Fresnel's reflectance at the
surface, averaged over its roughness. Unlike there, the diffuse term is not baked: the body's albedo is what is left of
the clip's colours when a guess of the clip's light is divided out, and is then lit by the environment. All colours
here are linear light.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.environment import LUMINANCE, Environment
from fluidlift.look.environment_lookup import picture_place, picture_value
from fluidlift.look.fluid_normals import fluid_normals
from fluidlift.look.materials import Material
from fluidlift.look.smoothstep import smoothstep
from fluidlift.numerics.sharing import shared
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians

__all__ = ["environment_brdf", "fluid_normals", "heat", "own_albedo", "reflectance", "relit"]

SOURCE_GROUND = 0.3
"""guess of the clip's light: an even sky, and a ground that returns this share of it"""
LARGEST_ALBEDO = 0.95
"""of anything in the world (fresh snow)"""
SPLAT_ROUGHNESS = 0.25
"""of a splat under a perfect mirror: it stands for a bent piece of surface, and its normal is known to a few degrees"""
FACING = (-0.3, 0.1)
"""cosine to the viewer below which a splat shows no surface at all (it is seen through a gap, from behind), and from
which it does in full"""
_F0, _F1 = np.float32(FACING[0]), np.float32(FACING[1] - FACING[0])
_CHUNK = 1024
BRDF_NODES = 64
"""of the table of reflectances"""
HEAT = (0.25, 0.99)
"""shares of the splats that are darker than the coldest and the hottest part of what glows"""
COLD = 0.6
"""absolute temperature of the coldest part over that of the hottest: a crust at 860 K barely glows"""
WIEN = np.array([16.5, 18.3, 21.6], np.float32)
"""h c / (wavelength k T) at 611, 549 and 465 nm and 1430 K, a basalt melt"""


def relit(
    gaussians: Gaussians,
    normals: Float[np.ndarray, "n 3"],
    share: Float[np.ndarray, " n"],
    camera: PinholeCamera,
    material: Material,
    environment: Environment,
    among: Float[np.ndarray, "m 3"] | None = None,
    depths: Float[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Linear radiance of every splat towards the camera, to be drawn as its feature.

    Args:
        gaussians: world, m; their view-independent colours are those of the clip (sRGB).
        normals, share: of `fluid_normals`.
        camera: who looks.
        material: what the fluid is taken for. What it does not hide by scattering, and what it carries, shows the
            clip's own colours.
        environment: the light.
        among: linear colours against which the clip's are hot or cold, if the material glows; None: these splats' own.
            The same ones for a whole film keep the glow of what stays.
        depths: m of fluid at each splat (`fluid_depths`): thin parts are clearer than deep ones; None: alike.

    Returns:
        float32, at least 0. Without glow, no material gives more than the brightest light around.

    Raises:
        ValueError: normals or shares of another number.
    """
    n = len(gaussians)
    require(np.shape(normals) == (n, 3) and np.shape(share) == (n,), f"normals {np.shape(normals)}", f"({n}, 3)")
    normals, share = np.ascontiguousarray(normals, np.float32), np.ascontiguousarray(share, np.float32)
    own = linear_from_srgb(gaussians.rgb)
    body = body_color(gaussians, own_albedo(own, normals, share), material, depths)
    pictures, numbers = _prepared(material, environment, camera.position)
    out = np.empty((n, 3), np.float32)
    shade_kernel(gaussians.means, normals, share, body, pictures, numbers, out)
    return out + glow(own, material, among) if max(material.emission) > 0 else out


def relit_plain(
    means: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    share: Float[np.ndarray, " n"],
    body: Float[np.ndarray, "n 3"],
    eye: Float[np.ndarray, "3"],
    material: Material,
    environment: Environment,
) -> Float[np.ndarray, "n 3"]:
    """What `shade_kernel` does, for reading: linear radiance without glow. `body` is the linear albedo."""
    toward = eye - means
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    cosine = (toward * normals).sum(axis=1)
    roughness = splat_roughness(material.roughness)
    fresnel = share * smoothstep(cosine, *FACING) * reflectance(cosine, roughness, material.refractive_index)
    mirrored = environment.blurred(2 * cosine[:, None] * normals - toward, roughness)
    # inside, light comes from everywhere
    light = share[:, None] * environment.irradiance(normals) + (1 - share)[:, None] * environment.mean
    return (1 - fresnel)[:, None] * body * light + fresnel[:, None] * mirrored


def _prepared(material: Material, environment: Environment, eye: np.ndarray) -> tuple[tuple, np.ndarray]:
    """For `shade_kernel`: pictures of the light and reflectances by cosine, and numbers that all splats share."""
    roughness = splat_roughness(material.roughness)
    sharper, duller, share = environment.between(roughness)
    normal, grazing = _schlick(material.refractive_index)
    numbers = np.array([*eye, *environment.mean, share], np.float32)
    mirror = np.clip(_brdf_table(roughness) @ (normal, grazing), 0.0, 1.0).astype(np.float32)
    return (environment.diffuse, sharper, duller, mirror), numbers


@shared(lambda means, *_: (0, -(-means.shape[0] // _CHUNK)), error_model="numpy", fastmath={"contract"})
def shade_kernel(begin, end, means, normals, share, body, pictures, numbers, out):
    diffuse, sharper, duller, mirror = pictures
    ex, ey, ez, mean_r, mean_g, mean_b, dull = numbers
    one, last = np.float32(1), len(mirror) - 1
    dim = one - dull
    n = means.shape[0]
    for chunk in range(begin, end):
        for p in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
            x, y, z = ex - means[p, 0], ey - means[p, 1], ez - means[p, 2]
            far = max(math.sqrt(x * x + y * y + z * z), np.float32(1e-12))
            x, y, z = x / far, y / far, z / far
            cosine = x * nx + y * ny + z * nz
            if not math.isfinite(cosine):
                out[p, :] = np.float32(0)
                continue
            t = min(max((cosine - _F0) / _F1, np.float32(0)), one)
            c = min(max(cosine, np.float32(0)), one)
            c = math.sqrt(c) * np.float32(last)
            k = min(np.int64(c), last - 1)
            fresnel = mirror[k] + (c - np.float32(k)) * (mirror[k + 1] - mirror[k])
            fresnel *= share[p] * t * t * (np.float32(3) - np.float32(2) * t)
            across, down = picture_place(nx, ny, nz)
            er, eg, eb = picture_value(diffuse, across, down)
            s = share[p]
            r = (one - fresnel) * body[p, 0] * (s * er + (one - s) * mean_r)
            g = (one - fresnel) * body[p, 1] * (s * eg + (one - s) * mean_g)
            b = (one - fresnel) * body[p, 2] * (s * eb + (one - s) * mean_b)
            if fresnel > 0:
                c = np.float32(2) * cosine
                across, down = picture_place(c * nx - x, c * ny - y, c * nz - z)
                r0, g0, b0 = picture_value(sharper, across, down)
                r1, g1, b1 = picture_value(duller, across, down)
                r += fresnel * (dim * r0 + dull * r1)
                g += fresnel * (dim * g0 + dull * g1)
                b += fresnel * (dim * b0 + dull * b1)
            out[p, 0], out[p, 1], out[p, 2] = r, g, b


def own_albedo(
    colors_linear: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], share: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Albedo of splats from their colours in the clip: a guess of the clip's light is divided out.

    The guess is an overcast sky over a dim ground, irradiance a + b n_z, at an exposure that shows the mean of what is
    seen as it is: most water is filmed outdoors, a hard sun would leave its shadows in the colours either way, and a
    smooth guess does no harm where it is wrong. Colours that move through the picture are shaded for where they are
    (`look.appearance`), so the normals of now are the ones to divide by.
    """
    a, b = 0.5 * (1 + SOURCE_GROUND), 0.5 * (1 - SOURCE_GROUND)
    light = np.float32(a) + np.float32(b) * normals[:, 2] * share
    seen = np.maximum(normals[:, 2], 0.0) * share  # what looks down into the ground was not seen
    exposure = float((light * seen).sum() / seen.sum()) if seen.sum() > 1e-6 * len(seen) else a
    return np.minimum(colors_linear * (np.float32(exposure) / light)[:, None], np.float32(LARGEST_ALBEDO))


def body_color(
    gaussians: Gaussians,
    own: Float[np.ndarray, "n 3"],
    material: Material,
    depths: Float[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Linear albedo of the body: the material's where it scatters, the clip's own through it where it is clear.

    Where no depths are given, that of the liquid is taken to be that of a slab as spread as the splats are along their
    thinnest direction; of what is clear, the light that comes back has gone through half of it twice.
    """
    depth = np.asarray(_thickness(gaussians) if depths is None else depths, np.float32)[..., None]
    absorption, shows = np.asarray(material.absorption, np.float32), np.float32(1 - material.carried)
    left = (1 + shows * np.expm1(np.float32(-material.scattering) * depth)) * np.exp(-absorption * (depth * shows))
    if material.scattering == 0:
        return left * own
    # as in a liquid's picture, the body's own colour takes the place of all that is lost
    lost = -shows * np.expm1(-(absorption + np.float32(material.scattering)) * depth)
    return left * own + lost * np.asarray(material.albedo, np.float32)


def splat_roughness(roughness: float) -> float:
    """Roughness of a surface that is drawn with splats: slopes that one splat stands for add to those of the surface.

    Variances of slopes add up, alpha^2 = alpha_surface^2 + alpha_splat^2 with alpha = roughness^2 (Kaplanyan et al.,
    "Filtering Distributions of Normals for Shading Antialiasing", 2016). It keeps highlights from glittering.
    """
    return (roughness**4 + SPLAT_ROUGHNESS**4) ** 0.25


def reflectance(
    cosine: Float[np.ndarray, "*n"] | float, roughness: float, refractive_index: float
) -> Float[np.ndarray, "*n"]:
    """Share of an even light that a rough surface reflects: Schlick's Fresnel term, averaged over the GGX lobe.

    Args:
        cosine: between normal and viewer; below 0 counts as 0.
        roughness: 0 to 1.
        refractive_index: of the body, next to air. At 1 there is no surface: 0.
    """
    normal, grazing = _schlick(refractive_index)
    scale, offset = environment_brdf(cosine, roughness)
    return np.asarray(np.clip(normal * scale + grazing * offset, 0.0, 1.0))


def _schlick(refractive_index: float) -> tuple[float, float]:
    """Reflectance along the normal and at grazing light.

    Towards an index of 1 the latter vanishes too, which Schlick's form (1, for every index) does not know.
    """
    normal = ((refractive_index - 1) / (refractive_index + 1)) ** 2
    return normal, min(50 * normal, 1.0)


def environment_brdf(
    cosine: Float[np.ndarray, "*n"] | float, roughness: float
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """(A, B) such that a GGX surface with reflectance F0 along its normal reflects F0 A + B of an even light.

    The second factor of the split sum of Karis, "Real Shading in Unreal Engine 4", 2013, integrated once per roughness
    with Smith's shadowing; analytic fits such as that of Lazarov 2013 leave errors of up to 0.17 in A.
    """
    table = _brdf_table(float(roughness))
    at = np.sqrt(np.clip(cosine, 0.0, 1.0))
    nodes = np.linspace(0.0, 1.0, len(table))
    return np.asarray(np.interp(at, nodes, table[:, 0])), np.asarray(np.interp(at, nodes, table[:, 1]))


@lru_cache(maxsize=64)
def _brdf_table(roughness: float) -> Float[np.ndarray, "k 2"]:
    """A and B at cosines (i / (k - 1))^2: sums over half vectors of equal weight, which is what they are drawn by."""
    alpha2 = max(roughness, 0.02) ** 4
    u, v = (np.arange(64) + 0.5) / 64, (np.arange(48) + 0.5) / 48 * math.pi
    z = np.sqrt((1 - u) / (1 + (alpha2 - 1) * u))[:, None]
    x = np.sqrt(1 - z * z) * np.cos(v)
    c = np.maximum(np.linspace(0.0, 1.0, BRDF_NODES) ** 2, 1e-4)[:, None, None]
    toward = np.sqrt(1 - c * c) * x + c * z
    light = np.maximum(2 * toward * z - c, 0.0)
    shadow = 4 * light * c / (c + np.sqrt(alpha2 + (1 - alpha2) * c * c))
    shadow /= np.maximum(light + np.sqrt(alpha2 + (1 - alpha2) * light * light), 1e-12)
    weight = shadow * np.maximum(toward, 0.0) / (z * c)
    schlick = (1 - np.clip(toward, 0.0, 1.0)) ** 5
    return np.stack([(weight * (1 - schlick)).mean(axis=(1, 2)), (weight * schlick).mean(axis=(1, 2))], axis=1)


def heat(
    colors_linear: Float[np.ndarray, "n 3"], among: Float[np.ndarray, "m 3"] | None = None
) -> Float[np.ndarray, " n"]:
    """0 to 1: how hot each splat is where a material glows: the brighter in the clip, the hotter, `among` these."""
    bright = colors_linear @ LUMINANCE
    if len(bright) == 0:
        return bright
    ranked = bright if among is None or len(among) == 0 else among @ LUMINANCE
    shares = np.linspace(*HEAT, 16)  # by rank, between these, so that any clip gives crust, glow and melt
    steps = np.quantile(ranked[:: max(len(ranked) // 20_000, 1)], shares) + 1e-7 * np.arange(16)
    return np.interp(bright, steps, (shares - HEAT[0]) / (HEAT[1] - HEAT[0])).astype(np.float32)


def glow(
    colors_linear: Float[np.ndarray, "n 3"], material: Material, among: Float[np.ndarray, "m 3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Linear radiance of a material with emission: that of a black body which cools where `heat` is less.

    In Wien's law a channel falls by exp(-x (T_hot / T - 1)), x = h c / (wavelength k T_hot): blue first, red last.
    """
    cooler = 1.0 / (COLD + (1.0 - COLD) * heat(colors_linear, among)) - 1.0
    return np.exp(-WIEN * cooler[:, None]) * np.asarray(material.emission, np.float32)


def _thickness(gaussians: Gaussians) -> float:
    """m: of a slab as spread as the splats are along their thinnest direction (variance d^2 / 12)."""
    step = max(len(gaussians) // 20_000, 1)
    points, sizes = gaussians.means[::step].astype(np.float64), gaussians.scales[::step].astype(np.float64)
    ok = np.isfinite(points).all(axis=1) & np.isfinite(sizes).all(axis=1)
    if not ok.any():
        return 0.0
    spread = np.cov(points[ok].T, bias=True)
    own = float((sizes[ok] ** 2).mean())
    return math.sqrt(12 * (max(float(np.linalg.eigvalsh(spread)[0]), 0.0) + own))
