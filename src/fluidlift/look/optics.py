"""Light at the surface of a transparent body and inside it: Fresnel, Snell, Beer and Lambert (Born and Wolf 1999), and
the colour of a deep body that scatters (van de Hulst 1980) and what a layer of it lets through (Kubelka, Munk 1931)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require

WHITEST = 1.0 - 1e-6
"""linear colour of a deep cloudy body, at most: one that absorbs nothing has no depth at which light has faded"""
WET_DEEP = 6.0
"""optical depth from which ground below a liquid is too dark to matter"""


def fresnel(cos_incident: Float[np.ndarray, "*n"], refractive_index: float) -> Float[np.ndarray, "*n"]:
    """Share of unpolarised light that a smooth dielectric surface reflects: the mean of both polarisations, exact.

    Args:
        cos_incident: cosine between the outward normal and the direction the light comes from. Positive: from
            outside; negative: from within the body, where there is total reflection beyond the critical angle.
        refractive_index: of the body next to what surrounds it, above 0.

    Raises:
        ValueError: an index that is not positive.
    """
    require(np.isfinite(refractive_index) and refractive_index > 0, f"refractive index {refractive_index}", "above 0")
    cos = np.clip(np.asarray(cos_incident), -1.0, 1.0)
    # index on the far side over that on the near side
    ratio = np.where(cos >= 0, refractive_index, 1.0 / refractive_index).astype(cos.dtype)
    near = np.abs(cos)
    left = 1.0 - (1.0 - near * near) / (ratio * ratio)
    far = np.sqrt(np.maximum(left, 0.0))
    across = (near - ratio * far) / np.maximum(near + ratio * far, 1e-20)
    along = (ratio * near - far) / np.maximum(ratio * near + far, 1e-20)
    share = 0.5 * (across * across + along * along)
    # at grazing incidence both are 1; 0 / 0 there where the indices are equal
    return np.where((left <= 0) | (near <= 0), 1.0, share).astype(cos.dtype)


def refract(
    directions: Float[np.ndarray, "*n 3"], normals: Float[np.ndarray, "*m 3"], ratio: float
) -> tuple[Float[np.ndarray, "*n 3"], Bool[np.ndarray, "*n"]]:
    """Directions of light behind a surface (Snell), and False where it is reflected in total.

    Args:
        directions: unit, the way the light goes.
        normals: unit, towards where the light comes from; those that point the other way are turned.
        ratio: index on the near side over that on the far side, such as 1 / 1.333 into water.

    Returns:
        Unit directions (where nothing passes: those of the mirror), and whether light passes.
    """
    d, n = np.asarray(directions), np.asarray(normals)
    cos = -(d * n).sum(axis=-1, keepdims=True)
    n = np.where(cos < 0, -n, n)
    cos = np.abs(cos)
    left = 1.0 - ratio * ratio * (1.0 - cos * cos)
    passes = left >= 0
    bent = ratio * d + (ratio * cos - np.sqrt(np.maximum(left, 0.0))) * n
    return np.where(passes, bent, d + 2.0 * cos * n).astype(d.dtype), passes[..., 0]


def mirrored(directions: Float[np.ndarray, "*n 3"], normals: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Directions of light after a mirror, for unit normals on either side of it."""
    d, n = np.asarray(directions), np.asarray(normals)
    return d - 2.0 * (d * n).sum(axis=-1, keepdims=True) * n


def transmittance(
    absorption: Float[np.ndarray, "3"] | tuple[float, float, float], thickness: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 3"]:
    """Share of the light left after `thickness` metres (Beer and Lambert): exp(-absorption thickness)."""
    depth = np.maximum(np.asarray(thickness), 0.0)
    return np.exp(-depth[..., None] * np.asarray(absorption, depth.dtype))


def passed(
    fade: Float[np.ndarray, " c"],
    cloud: Float[np.ndarray, " c"],
    inside: float,
    depth: float | Float[np.ndarray, "..."],
) -> Float[np.ndarray, "... c"]:
    """Share of light that gets through `depth` metres of a cloudy body, straight on or scattered forward.

    Two fluxes of light, one each way (Kubelka and Munk 1931; Kubelka 1948): T = (1 - R^2) e / (1 - R^2 e^2) with
    e = exp(-fade depth). What the layer sends back, R_d = R (1 - e^2) / (1 - R^2 e^2), is thrown onto it by the surface
    again and again: T / (1 - inside R_d). Of a clear body (R = 0) that is Beer and Lambert's e. The arrays are
    broadcast.

    Args:
        fade: 1/m, of light far inside; `cloud`: R, what a half space of it returns (`two_fluxes`).
        inside: share of even light that the surface throws back (`held_inside`).
        depth: m, 0 or more.
    """
    left, r = np.exp(-fade * depth), cloud * cloud
    return (1.0 - r) * left / np.maximum(1.0 - r * left * left - inside * cloud * (1.0 - left * left), 1e-30)


def cloud_seen(
    fluxes: tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]],
    extinction: Float[np.ndarray, " c"],
    inside: float,
    depth: Float[np.ndarray, "n 1"],
    free: Float[np.ndarray, "n 1"],
) -> tuple[Float[np.ndarray, "n c"], Float[np.ndarray, "n c"], Float[np.ndarray, "n c"]]:
    """What is seen of `depth` metres of a cloudy body, straight on: the share of what is behind that comes straight
    through, the share that is scattered forward, and how much of the body's own colour shows (1: that of a deep one).

    A ray of sight, followed backwards, is scattered or not. What is scattered meets surfaces from inside, of which each
    throws a share `inside` back. Where the body rests on something (free 0) that is its near surface, and the rest of
    the light is `passed`. Else (free 1) it is both: f and b of what reaches the near and the far one end up before it.

    Args:
        fluxes: fading (1/m) and cloud (`two_fluxes`).
        extinction: 1/m.
        inside, depth: as of `passed`.
        free: of its far side, 0 to 1.
    """
    fade, cloud = fluxes
    left = np.exp(-fade * depth)
    many = np.maximum(1.0 - (cloud * left) ** 2, 1e-30)
    through, back = (1.0 - cloud**2) * left / many, cloud * (1.0 - left * left) / many
    straight = np.minimum(np.exp(-extinction * depth), through)
    near = 1.0 - inside * back
    # what surfaces throw back runs at a slant: even light goes twice the depth (Kubelka's K = 2 a)
    twice = left * left
    many = np.maximum(1.0 - (cloud * twice) ** 2, 1e-30)
    slanted, again = (1.0 - cloud**2) * twice / many, 1.0 - inside * cloud * (1.0 - twice * twice) / many
    f = (1.0 - inside) * again / (again * again - (inside * slanted) ** 2)
    b = inside * slanted / again * f
    haze = (1.0 - free) * (through / near - straight) + free * ((through - straight) * f + back * b)
    own = (1.0 - free) * (1.0 - inside) * back / near + free * (back * f + (through - straight) * b)
    return straight, haze, own * (1.0 - inside * cloud) / ((1.0 - inside) * np.maximum(cloud, 1e-30))


def two_fluxes(
    extinction: Float[np.ndarray, " c"], color: Float[np.ndarray, " c"], refractive_index: float = 1.0
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Fading (1/m) and cloud (R, what a half space returns under its surface) of a body of an extinction (1/m) whose
    colour (linear) when deep is known.

    Of light that is scattered half goes on, so that light fades by less than the extinction: along a path by
    K (1 + R) / (1 - R), where K is what is absorbed. Both follow from `scattering_share`.
    """
    c = np.clip(np.asarray(color, float), 0.0, WHITEST)
    share, inside = scattering_share(c, refractive_index), held_inside(refractive_index)
    cloud = c / (1 - inside + inside * c)
    absorbed = np.asarray(extinction, float) * (1.0 - share)
    return absorbed * (1.0 + cloud) / (1.0 - cloud), cloud


def deep_color(
    absorption: Float[np.ndarray, " c"] | tuple[float, float, float], scattering: float, refractive_index: float = 1.0
) -> Float[np.ndarray, " c"]:
    """Linear colour, under white light, of a body so deep that nothing is seen behind it.

    Of light in a half space with isotropic scattering the share R = (1 - s)(1 - 0.139 s) / (1 + 1.17 s) returns, where
    s = sqrt(absorption / (absorption + scattering)) (van de Hulst, Multiple Light Scattering, 1980). A surface throws a
    share I of that back inside, again and again: (1 - I) R / (1 - I R) gets out. What the surface mirrors is not in it.

    Args:
        absorption, scattering: 1/m; scattering as if it were isotropic (reduced).
        refractive_index: of the body, next to air; 1: no surface.
    """
    absorbed = np.asarray(absorption, float)
    s = np.sqrt(absorbed / np.maximum(absorbed + scattering, 1e-30))
    returned = (1 - s) * (1 - 0.139 * s) / (1 + 1.17 * s) if scattering > 0 else np.zeros(3)
    inside = held_inside(refractive_index)
    return (1 - inside) * returned / (1 - inside * returned)


def scattering_share(color: Float[np.ndarray, " c"], refractive_index: float = 1.0) -> Float[np.ndarray, " c"]:
    """scattering / (absorption + scattering) of a deep body of this linear colour (0 to 1): the inverse of
    `deep_color`."""
    c, inside = np.clip(np.asarray(color, float), 0.0, 1.0), held_inside(refractive_index)
    r = c / (1 - inside + inside * c)
    # 0.139 s^2 - (1.139 + 1.17 R) s + (1 - R) = 0
    b, left = 1.139 + 1.17 * r, 1.0 - r
    s = (b - np.sqrt(b * b - 4 * 0.139 * left)) / (2 * 0.139)
    return 1.0 - np.clip(s, 0.0, 1.0) ** 2


def wet_light(
    depth: Float[np.ndarray, "*n"], refractive_index: float
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Even light in a level layer of liquid on matt ground: why wet ground is dark (Lekner and Dorf 1988).

    Ground of albedo r below it gets its light through the surface, on bent ways, and again what the surface throws back
    of its own: 1 + r back + (r back)^2 + ... times. What it sends up is n^2 times as bright inside as outside.

    Args:
        depth: optical (1/m times m), straight down, 0 or more.
        refractive_index: of the liquid, next to air's.

    Returns:
        Over what the ground gets without a surface, by straight ways (2 E3 of the depth, less what the surface mirrors
        straight on): the light that arrives, over n^2; the share `back`; and what
        the ground gets by straight ways, of the even light.
    """
    thick, *columns = wet_table(float(refractive_index))
    at = np.clip(np.asarray(depth, np.float64), 0.0, thick[-1])
    arrives, back, straight = (np.interp(at, thick, c) for c in columns)
    return arrives, back, straight


@lru_cache(maxsize=16)
def wet_table(index: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Optical depths up to `WET_DEEP`, evenly spaced in their roots, and the results of `wet_light` there."""
    thick = WET_DEEP * np.linspace(0.0, 1.0, 65) ** 2
    cos = (np.arange(1000) + 0.5) / 1000
    held = fresnel(-cos, index)
    left = np.exp(-thick[:, None] / cos)
    arrives = (2 * cos * (1.0 - held) * left).mean(axis=1)
    straight = (1.0 - fresnel(np.ones(1), index)) * (2 * cos * left).mean(axis=1)
    return thick, arrives / straight, (2 * cos * held * left * left).mean(axis=1), straight


@lru_cache(maxsize=64)
def held_inside(refractive_index: float) -> float:
    """Share of even light inside a body that its surface throws back: by reciprocity 1 - (1 - E) / n^2, where E is the
    share of even light outside that is mirrored."""
    cos = (np.arange(2000) + 0.5) / 2000
    outside = float((2 * cos * fresnel(cos, refractive_index)).mean())
    return 1.0 - (1.0 - outside) / refractive_index**2
