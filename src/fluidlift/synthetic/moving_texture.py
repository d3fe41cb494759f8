"""Small clips with exactly known motion: a procedural texture carried along a flow that a formula gives.

The picture at time t shows, at each point x, the texture at the place where the fluid at x was at the middle frame,
found by following the flow (Runge-Kutta, fourth order). So brightness is constant along paths, and the true
displacement is the flow map itself. Each hard situation of real clips can be laid over it alone (`Situation`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require

Velocity = Callable[[Float[np.ndarray, "*n 2"]], Float[np.ndarray, "*n 2"]]
"""steady velocity, px/frame, at points (u, v) in px"""
Inside = Callable[[Float[np.ndarray, "*n 2"]], Bool[np.ndarray, "*n"]]
"""whether points (u, v) lie in the stream"""

PERIOD = 512
"""px after which the texture repeats"""
STEPS = 2
"""Runge-Kutta steps per frame; at 10 px per frame and a radius of 30 px the error is below 1e-3 px"""


@dataclass(frozen=True)
class Situation:
    """What makes optical flow hard. All off by default."""

    brightness: float = 0.0
    """change of exposure from frame to frame, as a share (0.03: 3 % brighter each frame)"""
    highlights: float = 0.0
    """share of the stream under white glints that stay in place and flicker"""
    textured: float = 1.0
    """share of the stream that shows a pattern, in patches that drift with it; the rest is one dark colour"""
    shake: float = 0.0
    """px, standard deviation of the camera's place in each frame"""
    noise: float = 1.0
    """grey levels, standard deviation of the sensor's noise"""
    front: bool = False
    """the stream enters dry ground and fills a third of its path at the first frame"""


@dataclass(frozen=True)
class MovingTexture:
    """A clip of T frames and its truth."""

    frames: UInt8[np.ndarray, "t h w 3"]
    """sRGB"""
    flow: Float[np.ndarray, "t-1 h w 2"]
    """px/frame: motion of the fluid over the ground from t to t+1, at the pixel centres of frame t; 0 outside the
    mask. A camera that shakes adds `shift[t+1] - shift[t]` to what the picture shows."""
    mask: Bool[np.ndarray, "t h w"]
    """the fluid"""
    textured: Bool[np.ndarray, "t h w"]
    """fluid pixels with a pattern and without a glint: where flow can be seen"""
    shift: Float[np.ndarray, "t 2"]
    """px: where the camera's shake put the ground in each frame"""


def uniform(size: tuple[int, int], speed: float) -> tuple[Velocity, Inside]:
    """A straight channel over the middle two thirds of the height, all at one speed, to the right."""
    h = size[1]

    def velocity(points: np.ndarray) -> np.ndarray:
        return np.broadcast_to([speed, 0.0], points.shape)

    return velocity, lambda points: np.abs(points[..., 1] - h / 2) < h / 3


def bend(size: tuple[int, int], speed: float) -> tuple[Velocity, Inside]:
    """A channel that turns through a circular arc about a point below the picture; fastest in its middle.

    Speed = `speed` (1 - 0.75 s^2), s from -1 to 1 between the banks: a quarter of it is left at the banks.
    """
    w, h = size
    center = np.array([w / 2, 1.5 * h])
    radius, half = 1.0 * h, 0.3 * h

    def across(points: np.ndarray) -> np.ndarray:
        return (np.linalg.norm(points - center, axis=-1) - radius) / half

    def velocity(points: np.ndarray) -> np.ndarray:
        away = points - center
        along = np.stack([-away[..., 1], away[..., 0]], axis=-1) / np.linalg.norm(away, axis=-1, keepdims=True)
        s = np.clip(across(points), -1.0, 1.0)
        return speed * (1 - 0.75 * s**2)[..., None] * along

    return velocity, lambda points: np.abs(across(points)) < 1.0


def vortex(size: tuple[int, int], speed: float) -> tuple[Velocity, Inside]:
    """A Lamb-Oseen vortex in the middle of the picture, at most `speed`, clockwise on the screen; fluid everywhere."""
    w, h = size
    center, core = np.array([w / 2, h / 2]), 0.2 * min(w, h)
    peak = 0.6382  # largest value of (1 - exp(-q^2)) / q, at q = 1.1209

    def velocity(points: np.ndarray) -> np.ndarray:
        away = points - center
        q2 = (away**2).sum(axis=-1) / core**2
        turn = speed / (peak * core) * np.where(q2 > 1e-8, -np.expm1(-q2) / np.maximum(q2, 1e-8), 1.0)
        return turn[..., None] * np.stack([-away[..., 1], away[..., 0]], axis=-1)

    return velocity, lambda points: np.ones(points.shape[:-1], bool)


def expansion(size: tuple[int, int], speed: float) -> tuple[Velocity, Inside]:
    """A channel that widens from a quarter to half of the height over the picture, to the right.

    From the stream function psi = -Q f(s), s = y / half width, f = s - s^3/4: free of divergence, along the banks,
    `speed` at the middle of the narrow end.
    """
    w, h = size

    def half_width(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        narrow, wide = h / 8, h / 4
        turn = np.clip(x / w, 0.0, 1.0) * math.pi
        slope = np.where((x > 0) & (x < w), 0.5 * (wide - narrow) * np.sin(turn) * math.pi / w, 0.0)
        return narrow + 0.5 * (wide - narrow) * (1 - np.cos(turn)), slope

    def velocity(points: np.ndarray) -> np.ndarray:
        half, slope = half_width(points[..., 0])
        s = np.clip((points[..., 1] - h / 2) / half, -1.0, 1.0)
        along = speed * (h / 8) / half * (1 - 0.75 * s**2)
        return np.stack([along, along * s * slope], axis=-1)

    return velocity, lambda points: np.abs(points[..., 1] - h / 2) < half_width(points[..., 0])[0]


FLOWS: dict[str, Callable[[tuple[int, int], float], tuple[Velocity, Inside]]] = {
    "uniform": uniform, "bend": bend, "vortex": vortex, "expansion": expansion,
}  # fmt: skip


def moving_texture(
    name: str = "bend",
    *,
    frames: int = 8,
    size: tuple[int, int] = (128, 96),
    speed: float = 3.0,
    seed: int = 0,
    situation: Situation = Situation(),
) -> MovingTexture:
    """A clip of a texture that drifts along a known flow, and its truth.

    Args:
        name: of the flow, one of `FLOWS`.
        frames: 2 or more. The pattern is drawn undistorted in the middle frame; shear draws it out towards both ends.
        size: width and height, px.
        speed: largest, px/frame.
        seed: of all random numbers: the same seed gives the same clip.
        situation: what makes it hard.

    Raises:
        ValueError: an unknown flow, fewer than two frames, or shares outside 0 to 1.
    """
    require(name in FLOWS, f"flow '{name}'", "one of " + ", ".join(FLOWS))
    require(frames >= 2, f"{frames} frame(s)", "at least two")
    require(0 <= situation.highlights <= 1 and 0 <= situation.textured <= 1, "a share of the stream", "0 to 1")
    rng = np.random.default_rng(seed)
    velocity, inside = FLOWS[name](size, speed)
    pattern, patches, ground, glints = (_noise(rng, grain) for grain in (1.6, 9.0, 2.2, 3.5))
    shift = np.zeros((frames, 2)) if situation.shake == 0 else rng.normal(0.0, situation.shake, (frames, 2))
    points = np.stack(np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5), axis=-1)
    middle = frames // 2
    bare = np.quantile(patches, 1 - situation.textured) if situation.textured < 1 else -np.inf
    glint = np.quantile(glints, 1 - situation.highlights) if situation.highlights > 0 else np.inf
    pictures, flows, masks, seen = [], [], [], []
    for t in range(frames):
        here = points - shift[t]
        origin = carried(velocity, here, middle - t)
        mask = inside(here)
        if situation.front:
            mask &= carried(velocity, here, -t)[..., 0] < size[0] / 3
        foam = _at(patches, origin)
        with_pattern = foam > bare
        water = 0.22 + 0.5 * _at(pattern, origin) * (with_pattern if situation.textured < 1 else 1.0)
        flicker = _at(glints, here) + 0.15 * rng.normal()
        shining = flicker > glint
        dry = 0.35 + 0.3 * _at(ground, here)
        value = np.where(mask, np.where(shining, 1.0, water), dry)
        exposure = max(1.0 + situation.brightness * (t - middle), 0.0)
        tint = np.where(mask[..., None], [0.85, 1.0, 1.05], [1.1, 1.0, 0.8])
        linear = 255.0 * exposure * value[..., None] * tint + rng.normal(0.0, situation.noise, (*value.shape, 1))
        pictures.append(np.round(np.clip(linear, 0, 255)).astype(np.uint8))
        masks.append(mask)
        seen.append(mask & with_pattern & ~shining)
        if t + 1 < frames:
            flows.append(np.where(mask[..., None], carried(velocity, here, 1) - here, 0.0).astype(np.float32))
    return MovingTexture(np.stack(pictures), np.stack(flows), np.stack(masks), np.stack(seen), shift)


def carried(velocity: Velocity, points: Float[np.ndarray, "*n 2"], time: float) -> Float[np.ndarray, "*n 2"]:
    """Where the fluid at `points` (px) is after `time` frames (negative: was), by Runge-Kutta of fourth order."""
    steps = max(1, math.ceil(abs(time) * STEPS))
    h = time / steps
    x = np.asarray(points, np.float64)
    for _ in range(steps if time else 0):
        a = velocity(x)
        b = velocity(x + 0.5 * h * a)
        c = velocity(x + 0.5 * h * b)
        x = x + h / 6 * (a + 2 * b + 2 * c + velocity(x + h * c))
    return x


def _noise(rng: np.random.Generator, grain: float) -> Float[np.ndarray, "n n"]:
    """Smooth noise that repeats after `PERIOD` px, evenly spread over 0 to 1, with grains of about 3 `grain` px."""
    raw = ndimage.gaussian_filter(rng.normal(size=(PERIOD, PERIOD)), grain, mode="wrap")
    rank = np.empty(raw.size)
    rank[np.argsort(raw, axis=None)] = np.linspace(0, 1, raw.size)
    return rank.reshape(raw.shape).astype(np.float32)


def _at(noise: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values of the noise at points (px), float64."""
    at = np.mod(points - 0.5, PERIOD).astype(np.float32)
    return cv2.remap(noise, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP).astype(np.float64)
