"""Small clips of a vessel seen obliquely, with exact masks: what is poured into it, boils or stirs in it, or nothing.

A vessel is a cone about an upright axis with a rim, on a table, seen by a pinhole camera. What a pixel shows follows
from where its ray meets the liquid's level disc, the rim, the walls inside and outside, or the table. Liquid at a frame
is what is seen of the level disc, less what floats in it, and the jet above it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

from fluidlift.synthetic.hand_pour import LENS, NOISE, SUPERSAMPLING

Happening = Literal["fill", "boil", "stir", "empty", "beside"]
"""a level that rises under a jet; bubbles in some of the surface; a pattern that turns; nothing in it; the same, and a
jet that falls on the table beside it"""
FOCAL = 2.5
"""of the picture's longer side: that of a lens from near"""
FRAME_RATE = 25.0
"""1/s"""
FALLING = 150.0
"""px/s, at which a jet's pattern runs down"""


@dataclass(frozen=True)
class FilmedVessel:
    """A clip of T frames, and what of it is fluid."""

    frames: UInt8[np.ndarray, "t h w 3"]
    """sRGB"""
    fluid: Bool[np.ndarray, "t h w"]
    contents: Bool[np.ndarray, "t h w"]
    """of that, what lies in the vessel"""
    floating: Bool[np.ndarray, "t h w"]
    """what floats in it"""


@dataclass(frozen=True)
class _Look:
    """What differs from clip to clip; lengths in radii of the rim's outer edge."""

    pitch: float
    """radians that the camera looks down"""
    middle: tuple[float, float]
    """of the rim in the picture, px"""
    radius: float
    """half of the rim's width in the picture, px"""
    inner: float
    depth: float
    taper: float
    """radii that the walls draw in per depth"""
    below: tuple[float, float]
    """of the level below the rim, in the first and the last frame"""
    colors: np.ndarray
    """[4,3], sRGB of table, outside, inside and liquid"""
    grain: tuple[float, float]
    """grey levels, standard deviation of the pattern on the table and in the liquid"""
    light: float
    """radians, where light comes from"""
    jet: float
    """width of the jet, px"""
    boiling: float
    """share of the surface that boils"""
    pieces: int


@dataclass(frozen=True)
class _Patterns:
    """Patterns of deviation 1 that frames show."""

    table: np.ndarray
    running: np.ndarray
    """down a jet"""
    stirred: np.ndarray
    bubbles: np.ndarray
    """[t,n,n], one for every second frame"""
    boils: np.ndarray
    """bool [n,n]"""
    pieces: list[tuple[tuple[float, ...], np.ndarray, np.ndarray]]

    @classmethod
    def of(cls, rng: np.random.Generator, look: _Look, shape: tuple[int, int], frames: int) -> _Patterns:
        """For pictures of a shape, in samples."""
        table = _pattern(rng, shape, 6.0 * SUPERSAMPLING)
        running = _pattern(rng, (8 * shape[0], 64), 4.0 * SUPERSAMPLING)
        stirred = _pattern(rng, (256, 256), 9.0)
        bubbles = _pattern(rng, (frames // 2 + 2, 128, 128), 2.5, still=(0,))
        where = _pattern(rng, (128, 128), 20.0)
        boils = where > np.quantile(where, 1.0 - look.boiling)
        return cls(table, running, stirred, bubbles, boils, _pieces(rng, look))


def filmed_vessel(
    seed: int, happening: Happening, *, frames: int = 30, size: tuple[int, int] = (320, 240), pieces: bool = False
) -> FilmedVessel:
    """A made clip; everything about it follows from the seed.

    Args:
        seed: of its look, its motion and its noise.
        happening: in the vessel.
        frames: of the clip.
        size: width and height, px.
        pieces: whether something floats in it.
    """
    rng = np.random.default_rng(seed)
    look = _drawn(rng, happening, size, pieces)
    patterns = _Patterns.of(rng, look, (size[1] * SUPERSAMPLING, size[0] * SUPERSAMPLING), frames)
    found: list[list[np.ndarray]] = [[], [], [], []]
    for t in range(frames):
        picture, *masks = _frame(look, patterns, happening, t, t / (frames - 1), size)
        small = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), LENS) + rng.normal(scale=NOISE, size=(size[1], size[0], 1))
        found[0].append(np.clip(small, 0, 255).round().astype(np.uint8))
        for kept, mask in zip(found[1:], masks, strict=True):
            kept.append(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5)
    return FilmedVessel(*(np.stack(part) for part in found))


def _frame(
    look: _Look, patterns: _Patterns, happening: Happening, t: int, part: float, size: tuple[int, int]
) -> tuple[np.ndarray, ...]:
    """Picture of a frame, and masks of its fluid, of that in the vessel, and of what floats there, in samples."""
    seconds = t / FRAME_RATE
    below = look.below[0] + (look.below[1] - look.below[0]) * part
    meets, x, y, depth = _met(look, below, size)
    picture = look.colors[0] + (look.grain[0] * patterns.table)[..., None]
    shade = 1.0 + 0.25 * np.cos(np.arctan2(y, x) - look.light)
    inside = (2.0 - shade) * (1.0 - 0.35 * depth / look.depth)
    outside, rim, wall, level = range(1, 5)
    for number, color, bright in ((outside, 1, shade), (rim, 1, 1.15 + 0.0 * x), (wall, 2, inside)):
        picture[meets == number] = (look.colors[color] * bright[..., None])[meets == number]
    wet, floats = meets == level, np.zeros(x.shape, bool)
    if happening in ("empty", "beside"):
        picture[wet], wet = look.colors[2] * 0.65, floats
    picture[wet] = _liquid(look, patterns, happening, t, x, y)[wet]
    for (cx, cy, along, long, wide), color, grain in patterns.pieces:
        sway = 0.01 * np.sin(9.0 * seconds + 5.0 * cx)
        u = (x - cx - sway) * np.cos(along) + (y - cy) * np.sin(along)
        v = (y - cy) * np.cos(along) - (x - cx - sway) * np.sin(along)
        there = wet & ((u / long) ** 2 + (v / wide) ** 2 < 1.0)
        picture[there] = (color + (25.0 * _looked_up(grain, 3.0 * u, 3.0 * v))[..., None])[there]
        floats = floats | there
    wet, falls = wet & ~floats, np.zeros(x.shape, bool)
    if happening in ("fill", "beside"):
        falls, spout = _falling(look, below, happening, seconds, size)
        rows = np.arange(len(x))[:, None] + np.zeros(x.shape)
        ran = np.mod(4000.0 - FALLING * SUPERSAMPLING * seconds + rows, len(patterns.running) - 1)
        run = ndimage.map_coordinates(patterns.running, [ran, 20.0 + 0.0 * rows], order=1)
        picture[falls] = (look.colors[3] + 12.0 + (look.grain[1] * run)[..., None])[falls]
        picture[spout] = look.colors[1] * 0.6
        falls, wet, floats = falls & ~spout, wet & ~falls & ~spout, floats & ~falls & ~spout
    return picture, wet | falls, wet, floats


def _liquid(look: _Look, patterns: _Patterns, happening: Happening, t: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Color [h,w,3] of a liquid's surface at places of the disc in frame t."""
    glint = np.exp(-((x - 0.3 * np.cos(look.light)) ** 2 + (y - 0.3) ** 2) / 0.08)
    value = 18.0 * glint
    if happening == "boil":
        later = 0.5 * t - t // 2
        foam = (1.0 - later) * patterns.bubbles[t // 2] + later * patterns.bubbles[t // 2 + 1]
        value = value + 3.0 * look.grain[1] * _looked_up(np.maximum(foam, 0.0) * patterns.boils, x, y)
    else:
        radius = np.hypot(x, y)
        turned = np.arctan2(y, x) + 2.5 * t / FRAME_RATE * np.exp(-3.0 * radius)
        amount = look.grain[1] * (np.exp(-2.0 * radius) if happening == "fill" else 1.0)
        value = value + amount * _looked_up(patterns.stirred, radius * np.cos(turned), radius * np.sin(turned))
    return look.colors[3] + value[..., None]


def _drawn(rng: np.random.Generator, happening: Happening, size: tuple[int, int], pieces: bool) -> _Look:
    """A look at random: mugs, cups and bowls, dark in bright and bright in dark."""
    bright, dark = rng.uniform(140, 220, 3), rng.uniform(15, 70, 3)
    inside, liquid = (bright, dark) if rng.random() < 0.6 else (dark, bright)
    outside = inside * rng.uniform(0.8, 1.1) if rng.random() < 0.7 else rng.uniform(60, 200, 3)
    table = rng.uniform(20, 200, 3)
    depth = rng.uniform(0.6, 1.6)
    taper = np.tan(np.radians(rng.uniform(0.0, 30.0)))
    below = rng.uniform(0.15, 0.45) * depth
    drawn = (below + rng.uniform(0.25, 0.4) * depth, below) if happening == "fill" else (below, below)
    drawn = (0.995 * depth, 0.995 * depth) if happening in ("empty", "beside") else drawn  # the floor, above the table
    return _Look(
        pitch=np.radians(rng.uniform(28.0, 60.0)),
        middle=(rng.uniform(0.4, 0.6) * size[0], rng.uniform(0.4, 0.55) * size[1]),
        radius=rng.uniform(0.19, 0.3) * size[0], inner=rng.uniform(0.86, 0.95), depth=depth, taper=taper, below=drawn,
        colors=np.stack([table, outside, inside, liquid]), grain=(rng.uniform(3, 14), rng.uniform(6, 20)),
        light=rng.uniform(-np.pi, np.pi), jet=rng.uniform(4.0, 9.0), boiling=rng.uniform(0.3, 1.0),
        pieces=int(rng.integers(2, 5)) if pieces else 0,
    )  # fmt: skip


def _pattern(
    rng: np.random.Generator, shape: tuple[int, ...], coarse: float, still: tuple[int, ...] = ()
) -> np.ndarray:
    """A smooth pattern of deviation 1; along the axes `still` it is new at each place."""
    scale = [0.0 if axis in still else coarse for axis in range(len(shape))]
    found = ndimage.gaussian_filter(rng.normal(size=shape), scale, mode="wrap")
    return found / found.std()


def _looked_up(pattern: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A pattern over (-1, 1) at places of the disc."""
    half = 0.5 * np.array(pattern.shape)
    return ndimage.map_coordinates(pattern, [half[0] * (1.0 + y), half[1] * (1.0 + x)], order=1, mode="grid-wrap")


def _pieces(rng: np.random.Generator, look: _Look) -> list[tuple[tuple[float, ...], np.ndarray, np.ndarray]]:
    """Place, course, length and width of what floats, its color and its pattern."""
    color = rng.uniform(30, 220, 3)
    found = []
    for _ in range(look.pieces):
        reach, way = rng.uniform(0.0, 0.5), rng.uniform(0.0, 2.0 * np.pi)
        outline = (reach * np.cos(way), reach * np.sin(way), way, rng.uniform(0.15, 0.35), rng.uniform(0.08, 0.15))
        found.append((outline, color, _pattern(rng, (96, 96), 2.0)))
    return found


def _met(look: _Look, below: float, size: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """What the ray of each sample meets first (0 table, 1 outside, 2 rim, 3 wall, 4 level), and there x, y and depth.

    Axes: x right, y towards the camera, z up, the rim's middle at 0, in radii of the rim.
    """
    origin, rays = _rays(look, size)
    nearest = np.full(rays.shape[:2], np.inf)
    meets, at = np.zeros(nearest.shape, int), np.zeros(rays.shape)

    def keep(number: int, way: np.ndarray, ok: np.ndarray) -> None:
        first = ok & (way > 0) & (way < nearest)
        nearest[first], meets[first] = way[first], number
        at[first] = (origin + way[..., None] * rays)[first]

    for number, height in ((0, -look.depth), (2, 0.0), (4, -below)):
        way = (height - origin[2]) / rays[..., 2]
        r = np.hypot(*(origin[:2] + way[..., None] * rays[..., :2])[..., [0, 1]].transpose(2, 0, 1))
        edge = look.inner - below * look.taper
        keep(number, way, {0: r < np.inf, 2: (r <= 1.0) & (r >= look.inner), 4: r <= edge}[number])
    for number, radius in ((1, 1.0), (3, look.inner)):
        # (o + t d) on r = radius + taper z
        a = rays[..., 0] ** 2 + rays[..., 1] ** 2 - (look.taper * rays[..., 2]) ** 2
        at_origin = radius + look.taper * origin[2]
        b = origin[0] * rays[..., 0] + origin[1] * rays[..., 1] - look.taper * rays[..., 2] * at_origin
        c = origin[0] ** 2 + origin[1] ** 2 - at_origin**2
        root = np.sqrt(np.maximum(b * b - a * c, 0.0))
        for sign in (-1.0, 1.0):
            way = (-b + sign * root) / a
            z = origin[2] + way * rays[..., 2]
            keep(number, way, (b * b > a * c) & (z <= 0.0) & (z >= -look.depth))
    return meets, at[..., 0], at[..., 1], np.maximum(-at[..., 2], 0.0)


def _rays(look: _Look, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The camera's place and the rays [h,w,3] of all samples."""
    focal = FOCAL * max(size)
    away = focal / look.radius
    back = np.array([0.0, np.cos(look.pitch), np.sin(look.pitch)])
    down = np.array([0.0, np.sin(look.pitch), -np.cos(look.pitch)])
    u = (np.arange(size[0] * SUPERSAMPLING) + 0.5) / SUPERSAMPLING - look.middle[0]
    v = (np.arange(size[1] * SUPERSAMPLING) + 0.5) / SUPERSAMPLING - look.middle[1]
    rays = -focal * back + u[None, :, None] * np.array([1.0, 0.0, 0.0]) + v[:, None, None] * down
    return away * back, rays


def _falling(
    look: _Look, below: float, happening: Happening, seconds: float, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Samples of a jet that falls onto the liquid or beside the vessel, and of the spout that it comes from."""
    aside = 1.6 if look.middle[0] < 0.5 * size[0] else -1.6
    lands = (0.15, -0.05) if happening == "fill" else (aside, 0.3)
    scale, depth = look.radius, below if happening == "fill" else look.depth
    u = look.middle[0] + scale * lands[0] + 1.5 * np.sin(2.0 * np.pi * seconds / 0.9)
    v = look.middle[1] + scale * (lands[1] * np.sin(look.pitch) + depth * np.cos(look.pitch))
    top = look.middle[1] - scale * np.sin(look.pitch) * 0.75
    columns = (np.arange(size[0] * SUPERSAMPLING) + 0.5)[None] / SUPERSAMPLING
    rows = (np.arange(size[1] * SUPERSAMPLING) + 0.5)[:, None] / SUPERSAMPLING
    thin = look.jet * (1.0 - 0.3 * np.clip((rows - top) / size[1], 0.0, 1.0))
    jet = (np.abs(columns - u) < 0.5 * thin) & (rows > top) & (rows < v)
    spout = ((columns - u) / (2.5 * look.jet)) ** 2 + ((rows - top) / (1.2 * look.jet)) ** 2 < 1.0
    return jet, spout | ((np.abs(columns - u) < 2.0 * look.jet) & (rows < top))
