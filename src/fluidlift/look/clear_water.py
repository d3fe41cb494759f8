"""Water that one sees through: where its bent rays meet the bed, the bed's own colours, and what the water absorbs.

What comes up from a bed of albedo A below a level surface is

    I = (1 - F) exp(-a s) A e(a h) / (1 - A b(a h)) + F L

s is the bent way up, h the depth, e and b the light that even skylight brings down and that the surface throws back
(`optics.wet_light`), F Fresnel's share of the sky L that is mirrored. The looks transparent and surface draw that; here
it is solved for A, and a is found from how light falls with the way through the water.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.look.environment import Environment
from fluidlift.look.materials import WATER
from fluidlift.look.optics import fresnel, mirrored, refract, wet_light
from fluidlift.numerics.srgb import linear_from_srgb, srgb_from_linear
from fluidlift.types import Estimate, PinholeCamera

INDEX = WATER.refractive_index
BLOCK = 0.04
"""of the picture's longer side: squares whose mean light is one observation of the absorption; stones are smaller"""
FULL = 0.6
"""of a square must show the bed"""
FEWEST = 12
"""squares: fewer make no interval"""
KNOWN = 0.5
"""of its value: an absorption whose 95 % interval is wider to either side is not known"""
SURE = 1.96
"""standard deviations to either side of a 95 % interval"""
WIDER = 0.03
"""of the picture's longer side: the sky that is mirrored is no brighter than the darkest place within it"""
STEPS, HALVES = 48, 12
"""along a ray: a 24th of the depth, then that over 4096"""
ROUNDS = 6
"""of fixed points; each leaves a tenth of the error at depths of a twentieth of the distance"""
ALIKE = 0.4
"""standard deviation of ln(albedo of a bed over that of the dry ground beside it): silt on it, or grass on the bank"""
SKIES = (0.5, 3.0)
"""times as bright as that of the looks the mirrored sky may be: under trees, and overcast (as bright as white ground; a
clear one has a third of that)"""
PRECISE = 0.05
"""of its value: a standard deviation below it counts as determined, as for every fitted number"""
NAME, CHANNELS = "water_absorption", ("red", "green", "blue")
LOWEST = 1e-4
"""linear light that counts as none"""


@dataclass(frozen=True)
class BedRays:
    """Where the line of sight of each pixel meets the bed, bent at the surface; nan where it does not."""

    points: Float[np.ndarray, "h w 3"]
    """m, world"""
    up: Float[np.ndarray, "h w"]
    """m through the water"""
    deep: Float[np.ndarray, "h w"]
    """m of water over the place"""
    share: Float[np.ndarray, "h w"]
    """mirrored at the surface (Fresnel)"""
    mirror: Float[np.ndarray, "h w 3"]
    """unit direction from which that light comes"""


def bed_rays(
    camera: PinholeCamera,
    depth: Float[np.ndarray, "h w"],
    bed: Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, " n"]],
    level: Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, " n"]],
) -> BedRays:
    """Follow the lines of sight through a level surface.

    Args:
        camera: in the world.
        depth: camera z of the surface, m; 0 where there is none.
        bed, level: z of the ground and of the water's surface at places x and y, m.
    """
    there = depth > 0
    grid = camera.pixel_grid()[there]
    surface = camera.unproject(grid, depth[there])
    rays = camera.rays(grid)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    normal = np.tile([0.0, 0.0, 1.0], (len(unit), 1))
    way, _ = refract(unit, normal, 1.0 / INDEX)
    run = _met(surface, way, bed)
    at = surface + run[:, None] * way
    shape = depth.shape

    def spread(values: np.ndarray) -> np.ndarray:
        out = np.full((*shape, *values.shape[1:]), np.nan)
        out[there] = values
        return out

    deep = np.maximum(level(at[:, :2]) - bed(at[:, :2]), 0.0)
    share = fresnel(np.maximum(-unit[:, 2], 1e-3), INDEX)
    return BedRays(spread(at), spread(run), spread(deep), spread(share), spread(mirrored(unit, normal)))


def _met(surface: np.ndarray, way: np.ndarray, bed: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """m along unit ways [n,3] from places at the surface [n,3] to where they first meet the bed: steps, then halves."""
    high = surface[:, 2] - bed(surface[:, :2])
    # ground as low as the lowest below the surface is reached by then, and twice as low a place beside it
    most = 2.0 * max(float(high.max(initial=0.0)), 0.0) / np.maximum(-way[:, 2], 0.1)
    near, far, going = np.zeros(len(way)), most.copy(), high > 0
    for k in range(1, STEPS + 1):
        run = most * k / STEPS
        at = surface + run[:, None] * way
        below = going & (at[:, 2] <= bed(at[:, :2]))
        far = np.where(below, run, far)
        going &= ~below
        near = np.where(going, run, near)
    for _ in range(HALVES):
        half = 0.5 * (near + far)
        at = surface + half[:, None] * way
        below = at[:, 2] <= bed(at[:, :2])
        near, far = np.where(below, near, half), np.where(below, half, far)
    return np.where(high > 0, far, 0.0)


def without_mirror(
    light: Float[np.ndarray, "h w 3"],
    seen: Bool[np.ndarray, "h w"],
    rays: BedRays,
    sky: Environment,
    *,
    times: float = 1.0,
) -> Float[np.ndarray, "h w 3"]:
    """Linear light that came up from the bed to below the surface; nan where none is seen.

    The sky that is mirrored is that of the looks, as far as the picture is nowhere darker around (the dark channel of
    He, Sun and Tang 2009): under trees less of it is.

    Args:
        light: linear, of what stays in the picture.
        seen: where that is the bed.
        rays: of its pixels.
        sky: the environment.
        times: how bright that is.
    """
    there = seen & np.isfinite(rays.up)
    out = np.full(light.shape, np.nan)
    if not there.any():
        return out
    reach = 2 * max(round(WIDER * max(seen.shape)), 1) + 1
    darkest = np.where(there[..., None], cv2.GaussianBlur(np.asarray(light, np.float32), (0, 0), 1.0), np.inf)
    darkest = np.stack([cv2.erode(darkest[..., k].astype(np.float32), np.ones((reach, reach))) for k in range(3)], -1)
    full = times * rays.share[there, None] * sky.toward(rays.mirror[there].astype(np.float32))
    out[there] = (light[there] - np.minimum(full, darkest[there])) / (1.0 - rays.share[there, None])
    return out


def absorption_of(
    light: Float[np.ndarray, "h w 3"],
    seen: Bool[np.ndarray, "h w"],
    rays: BedRays,
    sky: Environment,
    *,
    dry: Float[np.ndarray, "3"] | None = None,
) -> dict[str, Estimate]:
    """What the water absorbs, 1/m, per channel: how the light of its bed falls with the way through the water.

    The mean of the bed's albedo over a square is taken not to depend on the depth; what it varies by otherwise widens
    the interval, and so does the sky, which may be half or three times as bright. Depths are those of the
    terrain: were they twice as large, all would be half. Pure water's, known to nothing, where the light does not tell.

    Args:
        light, seen, rays, sky: as for `without_mirror`.
        dry: linear, usual light of the dry ground beside the water, which its bed is likely made of (`ALIKE`); else a
            bed that is hardly anywhere shallow would come out brighter than any ground. None: nothing is known.
    """
    below = [without_mirror(light, seen, rays, sky, times=times) for times in (1.0, *SKIES)]
    found = []
    for k in range(3):
        shore = None if dry is None else float(dry[k])
        value, sigma = _fitted(below[0][..., k], rays, shore)
        others = [_fitted(b[..., k], rays, shore)[0] for b in below[1:]]
        found.append((value, float(np.hypot(sigma, 0.5 * (max(others) - min(others))))))
    told = any(np.isfinite(sigma) and SURE * sigma < KNOWN * value for value, sigma in found)
    out = {}
    for name, least, (value, sigma) in zip(CHANNELS, WATER.absorption, found, strict=True):
        if not told:
            out[f"{NAME}_{name}"] = Estimate(
                least, math.inf, False, least, "1/m", None, "pure water's: its bed does not tell"
            )
            continue
        taken, low = max(value, least), max(min(value, least), value - SURE * sigma)
        source = "how the bed darkens with the depth that was built"
        out[f"{NAME}_{name}"] = Estimate(
            taken, sigma, sigma < PRECISE * taken, least, "1/m", (low, max(value + SURE * sigma, least)), source
        )
    return out


def absorption_in(estimates: Mapping[str, Estimate]) -> tuple[float, float, float] | None:
    """1/m of red, green and blue among an asset's estimates; None where its bed was not seen, or tells nothing."""
    found = [estimates.get(f"{NAME}_{channel}") for channel in CHANNELS]
    if any(e is None or not math.isfinite(e.sigma) for e in found):
        return None
    red, green, blue = (e.value for e in found if e is not None)
    return red, green, blue


def _fitted(below: np.ndarray, rays: BedRays, dry: float | None) -> tuple[float, float]:
    """Absorption, 1/m, of one channel and its standard deviation: the widest of squares of two sizes, since what lies
    on a bed is alike over more than one."""
    best = 0.0, math.inf
    for times in (2, 1):
        block = times * max(round(BLOCK * max(below.shape)), 2)
        rows = _squares(below, rays, block)
        value, sigma = (
            _slope(rows[:, 0], rows[:, 1], rows[:, 2], dry) if len(rows) >= FEWEST / times**2 else (0.0, math.inf)
        )
        sigma = best[1] if times == 1 and math.isfinite(best[1]) and best[1] > sigma else sigma
        best = value, sigma
    return best


def _squares(below: np.ndarray, rays: BedRays, block: int) -> np.ndarray:
    """[n,3]: mean way up, depth, and logarithm of the mean light, of squares that show the bed."""
    known, rows = np.isfinite(below) & (rays.deep > 0), []
    for i in range(0, below.shape[0] - block + 1, block):
        for j in range(0, below.shape[1] - block + 1, block):
            part = np.s_[i : i + block, j : j + block]
            inside = known[part]
            if inside.mean() >= FULL:
                light = math.log(max(float(below[part][inside].mean()), LOWEST))
                rows.append([rays.up[part][inside].mean(), rays.deep[part][inside].mean(), light])
    return np.array(rows).reshape(-1, 3)


def _slope(up: np.ndarray, deep: np.ndarray, light: np.ndarray, dry: float | None) -> tuple[float, float]:
    """Absorption, 1/m, and its standard deviation, from logarithms of light; infinite where nothing is known."""
    value, sigma, noise = 0.0, math.inf, ALIKE
    _, back, _ = wet_light(np.zeros(1), INDEX)
    shallow = 0.0 if dry is None else float(np.log(dry * _let_in(np.zeros(1)) / (1.0 - dry * back))[0])
    for _ in range(ROUNDS):
        # even light goes down on slanted ways: as far as one way of this length
        optical = max(value, 1e-3) * deep
        way = up - np.log(_let_in(optical) / _let_in(np.zeros(1))) / max(value, 1e-3)
        spread = float(((way - way.mean()) ** 2).sum())
        if spread < 1e-12 or len(light) < 3:
            return 0.0, math.inf
        # the dry ground counts as one square without water, whose noise is ALIKE
        weight = np.ones(len(light)) if dry is None else np.append(np.ones(len(light)), (noise / ALIKE) ** 2)
        ways, lights = (way, light) if dry is None else (np.append(way, 0.0), np.append(light, shallow))
        mean = (weight * ways).sum() / weight.sum(), (weight * lights).sum() / weight.sum()
        lean, spread = ways - mean[0], float((weight * (ways - mean[0]) ** 2).sum())
        value = -float((weight * lean * (lights - mean[1])).sum()) / spread
        rest = (lights - mean[1] + value * lean)[: len(light)]
        noise = math.sqrt(float((rest**2).sum()) / (len(light) - 2))
        sigma = noise / math.sqrt(spread)
    return value, sigma


def _let_in(optical: np.ndarray) -> np.ndarray:
    arrives, _, straight = wet_light(optical, INDEX)
    return arrives * straight


def dry_ground(
    below: Float[np.ndarray, "h w 3"],
    rays: BedRays,
    absorption: tuple[float, float, float],
    *,
    brightest: Float[np.ndarray, "3"] | float = 1.0,
) -> Float[np.ndarray, "h w 3"]:
    """Linear albedo of the bed as if it were dry; nan where it is not seen.

    Args:
        below: as `without_mirror` gives it.
        rays: of its pixels.
        absorption: 1/m, of the water.
        brightest: that a bed may be, 0 to 1: along a shore that was built too deep it would come out white.
    """
    out = np.full(below.shape, np.nan)
    there = np.isfinite(below).all(axis=-1)
    for k, a in enumerate(absorption):
        arrives, back, straight = wet_light(a * rays.deep[there], INDEX)
        sent = np.maximum(below[there][:, k], 0.0) * np.exp(a * rays.up[there])
        dry = sent / np.maximum(arrives * straight + sent * back, 1e-6)
        out[there, k] = np.clip(dry, 0.0, np.broadcast_to(brightest, 3)[k])
    return out


def straight_picture(
    albedo: Float[np.ndarray, "h w 3"], rays: BedRays, camera: PinholeCamera
) -> tuple[np.ndarray, Bool[np.ndarray, "h w"]]:
    """The bed where straight lines of sight meet it, sRGB u8 [h,w,3], and where that is known.

    Args:
        albedo: linear, where bent lines meet it; nan elsewhere.
        rays: of its pixels.
        camera: of the picture.
    """
    known = np.isfinite(albedo).all(axis=-1) & np.isfinite(rays.up)
    require(bool(known.any()), "no bed that is seen", "some")
    moved = np.zeros((*known.shape, 2), np.float32)
    uv, _ = camera.project(rays.points[known])
    moved[known] = uv - camera.pixel_grid()[known]
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), 2.0)
    moved = cv2.GaussianBlur(moved * known[..., None], (0, 0), 2.0) / np.maximum(weight, 1e-6)[..., None]
    grid = (camera.pixel_grid() - 0.5).astype(np.float32)
    at = grid.copy()
    for _ in range(ROUNDS):
        there = cv2.remap(moved, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        at = grid - there
    light = np.where(known[..., None], albedo, 0.0).astype(np.float32)
    part = cv2.remap(known.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    found = cv2.remap(light, at[..., 0], at[..., 1], cv2.INTER_LINEAR) / np.maximum(part, 1e-6)[..., None]
    picture = np.round(255.0 * srgb_from_linear(np.clip(found, 0.0, 1.0))).astype(np.uint8)
    return picture, part > 0.99


def linear_picture(picture: np.ndarray) -> np.ndarray:
    """Linear light [h,w,3] of sRGB u8."""
    return linear_from_srgb(picture.astype(np.float32) / 255.0)
