"""Small clips of water in the air over a pool, by a formula: fountains, and falls and spouts that are none.

Every drop flies as a stone does, without drag: from its nozzle (or its brink) to the pool, where it ends. Drops come in
clumps that share most of their velocity, as water that breaks up does, so that there is something to follow. The truth
is known: where the nozzles are, how high the water rises, how far it falls from them, and which pixels show it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.errors import require
from fluidlift.synthetic.paint import Noise, to_picture
from fluidlift.types import GRAVITY, PinholeCamera, RigidTransform

FRAME_RATE = 25.0
"""1/s"""
CLUMP = 24
"""drops that leave together"""
OWN = 0.25
"""of the spread of the velocities is a drop's own, the rest its clump's"""
BROAD = 0.5
"""m, half width of what does not pulse as one"""
EXPOSURE, SHOTS = 0.5, 4
"""of a frame's interval that the shutter is open, and instants that are summed for it"""
LENS, NOISE = 0.6, 1.5
"""px and grey levels, standard deviations of the blur of the lens and of the sensor's noise"""


@dataclass(frozen=True)
class Source:
    """Where drops leave, and how."""

    start: tuple[float, float, float]
    """m, the middle of where they leave"""
    half: tuple[float, float]
    """m, along x and y, of the place that they leave from"""
    velocity: tuple[float, float, float]
    """m/s, mean"""
    spread: tuple[float, float, float]
    """m/s, standard deviation"""
    rate: float
    """clumps per second"""


@dataclass(frozen=True)
class AirborneScene:
    """A pool at z = 0, what flies over it, and what stands behind."""

    sources: tuple[Source, ...]
    pool: tuple[float, float]
    """m, half axes along x and y of the elliptic pool around the origin"""
    distance: float
    """m from the camera to the origin"""
    pitch: float
    """degrees that the camera looks down"""
    aim: float
    """m above the pool that it looks at"""
    behind: str = "wall"
    """wall (dark, even), trees (mottled, with sky above), or rock: a face below each brink, ground above it"""
    drop: float = 0.02
    """m, radius of a drop"""
    fountain: bool = True
    """whether it rises from its pool"""

    @property
    def rise(self) -> float:
        """m that the mean drop of its strongest source gets above the pool."""
        return max(s.start[2] + max(s.velocity[2], 0.0) ** 2 / (2 * GRAVITY) for s in self.sources)


@dataclass(frozen=True)
class FilmedAirborne:
    """A clip of T frames and its truth."""

    frames: UInt8[np.ndarray, "t h w 3"]
    """sRGB"""
    air: Bool[np.ndarray, "t h w"]
    """where water is seen in the air"""
    pool: Bool[np.ndarray, "h w"]
    """where the pool is, behind what flies too"""
    camera: PinholeCamera
    """world z up, the pool at z = 0"""
    interval: float
    """s"""


def _single(height: float = 3.0, spread: float = 0.35) -> AirborneScene:
    up = float(np.sqrt(2 * GRAVITY * height))
    source = Source((0.0, 0.0, 0.05), (0.03, 0.03), (0.0, 0.0, up), (spread, spread, 0.05 * up), 700.0)
    return AirborneScene((source,), (2.8, 2.2), 11.0, 9.0, 1.6, drop=0.013)


def _row(count: int = 5, behind: str = "trees") -> AirborneScene:
    up = float(np.sqrt(2 * GRAVITY * 1.8))
    sources = tuple(
        Source((x, 0.0, 0.05), (0.02, 0.02), (0.0, 0.0, up), (0.22, 0.22, 0.05 * up), 320.0)
        for x in np.linspace(-2.0, 2.0, count)
    )
    return AirborneScene(sources, (3.2, 1.6), 10.5, 7.0, 1.0, behind, drop=0.013)


def _froth() -> AirborneScene:
    up = float(np.sqrt(2 * GRAVITY * 2.2))
    source = Source((0.0, 0.0, 0.05), (0.35, 0.35), (0.0, 0.0, 0.9 * up), (0.45, 0.45, 0.2 * up), 1800.0)
    return AirborneScene((source,), (3.0, 2.4), 12.5, 12.0, 1.7, drop=0.016)


def _inclined() -> AirborneScene:
    up = float(np.sqrt(2 * GRAVITY * 2.2))
    sources = tuple(
        Source((x, 0.0, 0.05), (0.02, 0.02), (-1.25 * np.sign(x), 0.0, up), (0.2, 0.2, 0.05 * up), 600.0)
        for x in (-1.6, 1.6)
    )
    return AirborneScene(sources, (3.4, 2.2), 10.5, 10.0, 1.1, "trees", drop=0.014)


def _windy() -> AirborneScene:
    up = float(np.sqrt(2 * GRAVITY * 3.5))
    sources = tuple(
        Source((0.9 + 0.15 * k, 0.1 * k, 0.05), (0.03, 0.03), (-0.8 - 0.2 * k, 0.0, up), (0.35, 0.3, 0.08 * up), 500.0)
        for k in range(3)
    )
    return AirborneScene(sources, (3.6, 2.4), 13.5, 11.0, 2.0, "trees", drop=0.014)


def _fall() -> AirborneScene:
    brink = Source((0.0, 0.9, 3.0), (0.9, 0.05), (0.0, -0.5, -0.4), (0.12, 0.12, 0.15), 1700.0)
    return AirborneScene((brink,), (2.6, 1.6), 9.0, 9.0, 1.4, "rock", fountain=False)


def _weir() -> AirborneScene:
    brink = Source((0.0, 0.9, 1.1), (2.4, 0.05), (0.0, -0.9, -0.2), (0.1, 0.12, 0.12), 2200.0)
    return AirborneScene((brink,), (3.4, 1.8), 8.0, 12.0, 0.6, "rock", fountain=False)


def _spout() -> AirborneScene:
    lip = Source((-0.9, 0.0, 2.2), (0.05, 0.05), (1.1, 0.0, 0.0), (0.06, 0.06, 0.06), 900.0)
    return AirborneScene((lip,), (2.2, 1.8), 8.0, 9.0, 1.1, "wall", fountain=False)


SCENES: dict[str, Callable[[], AirborneScene]] = {
    "single": _single, "row": _row, "froth": _froth, "inclined": _inclined, "windy": _windy,
    "fall": _fall, "weir": _weir, "spout": _spout,
}  # fmt: skip
"""fountains first; a fall over rock, a weir and a spout in a wall are none"""


def filmed_airborne(
    scene: str | AirborneScene, seed: int = 0, *, frames: int = 30, size: tuple[int, int] = (320, 240)
) -> FilmedAirborne:
    """A made clip; everything about it follows from the scene and the seed.

    Args:
        scene: one of `SCENES`, or another one.
        seed: of its drops, its patterns and its noise.
        frames: of the clip.
        size: width and height, px.

    Raises:
        ValueError: a scene of another name.
    """
    if isinstance(scene, str):
        require(scene in SCENES, f"a scene '{scene}'", ", ".join(SCENES))
        scene = SCENES[scene]()
    rng = np.random.default_rng(seed)
    camera = _camera(scene, size)
    paint = _Paint.make(rng)
    behind, pool, points = _ground(scene, camera, paint)
    drops = [_Drops.make(rng, source, scene.drop) for source in scene.sources]
    pictures, air = [], []
    for t in range(frames):
        cover = np.mean([_cover(drops, camera, (t + EXPOSURE * k / SHOTS) / FRAME_RATE) for k in range(SHOTS)], axis=0)
        landing = np.sum([d.landing(points, scene.pool) for d in drops], axis=0)
        picture = np.where(pool[..., None], _water(points, t / FRAME_RATE, landing, paint), behind)
        opacity = 1.0 - np.exp(-cover)
        white = np.array([0.72, 0.75, 0.78]) * (0.8 + 0.2 * np.minimum(cover, 1.0))[..., None]
        picture = picture + (white - picture) * opacity[..., None]
        soft = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), LENS)
        noisy = to_picture(soft) + rng.normal(scale=NOISE, size=(size[1], size[0], 1))
        pictures.append(np.clip(noisy, 0, 255).round().astype(np.uint8))
        air.append(cv2.GaussianBlur(opacity.astype(np.float32), (0, 0), 1.0) > 0.2)
    return FilmedAirborne(np.stack(pictures), np.stack(air), pool, camera, 1.0 / FRAME_RATE)


def _camera(scene: AirborneScene, size: tuple[int, int]) -> PinholeCamera:
    """Before the pool, at y < 0, looking at the point `aim` above its middle."""
    lens = PinholeCamera.from_fov(40.0, size)
    tilt = np.radians(scene.pitch)
    right, forward = np.array([1.0, 0.0, 0.0]), np.array([0.0, np.cos(tilt), -np.sin(tilt)])
    rotation = np.stack([right, np.cross(forward, right), forward])
    eye = np.array([0.0, -scene.distance * np.cos(tilt), scene.aim + scene.distance * np.sin(tilt)])
    return PinholeCamera(lens.focal, lens.center, size, RigidTransform(rotation, -rotation @ eye))


@dataclass(frozen=True)
class _Paint:
    """Patterns."""

    coarse: Noise
    fine: Noise

    @classmethod
    def make(cls, rng: np.random.Generator) -> _Paint:
        return cls(Noise.make(rng, 6.0, 1.5), Noise.make(rng, 1.2, 1.0))

    def at(self, points: np.ndarray) -> np.ndarray:
        """0 to 1 at points [h,w,3]."""
        flat = points.reshape(-1, 3)
        return (0.6 * self.coarse.at(flat) + 0.4 * self.fine.at(flat)).reshape(points.shape[:-1])


def _ground(scene: AirborneScene, camera: PinholeCamera, paint: _Paint) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear colors [h,w,3] without the water, where the pool is, and the points of its level [h,w,3] (m)."""
    rays, eye = camera.rays(camera.pixel_grid()), camera.position
    down = np.minimum(rays[..., 2], -1e-6)
    reach = -eye[2] / down
    level = eye + reach[..., None] * rays
    far = (scene.pool[1] + (0.3 if scene.behind == "rock" else 4.0) - eye[1]) / rays[..., 1]
    back = eye + far[..., None] * rays
    lies = (rays[..., 2] < 0) & (reach < far)
    pool = lies & ((level[..., 0] / scene.pool[0]) ** 2 + (level[..., 1] / scene.pool[1]) ** 2 < 1.0)
    stone = ((level[..., 0] / scene.pool[0]) ** 2 + (level[..., 1] / scene.pool[1]) ** 2 < 1.15) & lies
    grass = np.array([0.09, 0.13, 0.05]) * (0.6 + 0.8 * paint.at(level))[..., None]
    rim = np.array([0.30, 0.29, 0.27]) * (0.7 + 0.6 * paint.at(level))[..., None]
    mottled = paint.at(back * np.array([1.0, 1.0, 1.6]))[..., None]
    if scene.behind == "wall":
        upright = np.array([0.07, 0.07, 0.08]) * (0.8 + 0.4 * mottled)
    elif scene.behind == "trees":
        upright = np.array([0.05, 0.07, 0.04]) * (0.3 + 2.0 * mottled)
        tops = 3.5 + 2.0 * mottled[..., 0]
        upright = np.where((back[..., 2] > tops)[..., None], np.array([0.62, 0.68, 0.74]), upright)
    else:
        upright = np.array([0.16, 0.15, 0.14]) * (0.4 + 1.2 * mottled)
        brink = max(s.start[2] for s in scene.sources)
        green = np.array([0.10, 0.15, 0.06]) * (0.4 + 1.2 * mottled)
        upright = np.where((back[..., 2] > brink + 0.05)[..., None], green, upright)
    out = np.where(lies[..., None], np.where(stone[..., None], rim, grass), upright)
    return out, pool, np.where(pool[..., None], level, 0.0)


def _water(points: np.ndarray, time: float, landing: np.ndarray, paint: _Paint) -> np.ndarray:
    """Linear colors [h,w,3] of the pool: ripples that run and change, white where drops land."""
    moved = points + np.array([0.15 * time, 0.1 * time, 0.8 * time])
    ripple = paint.fine.at(moved.reshape(-1, 3)).reshape(points.shape[:-1])
    froth = np.clip(landing, 0.0, 1.0) * (0.3 + 0.7 * paint.fine.at((moved * 1.7).reshape(-1, 3)).reshape(ripple.shape))
    calm = np.array([0.05, 0.08, 0.09]) * (0.5 + ripple)[..., None]
    return calm + (np.array([0.55, 0.58, 0.60]) - calm) * froth[..., None]


@dataclass(frozen=True)
class _Drops:
    """All drops of a source: the table repeats long after the clip."""

    source: Source
    place: Float[np.ndarray, "n 3"]
    velocity: Float[np.ndarray, "n 3"]
    flight: Float[np.ndarray, " n"]
    """s until it is in the pool"""
    born: Float[np.ndarray, " n"]
    """s"""
    area: float
    """m^2 that a drop hides"""

    @classmethod
    def make(cls, rng: np.random.Generator, source: Source, radius: float, seconds: float = 8.0) -> _Drops:
        count = int(source.rate * seconds)
        # a jet pulses, a sheet does not do so all along its brink
        wide = max(source.half) > BROAD
        gaps = rng.exponential(1.0, count) * (
            1.0 + (0.0 if wide else 0.8) * np.sin(np.arange(count) * 40.0 / source.rate)
        )
        times = np.cumsum(gaps) / gaps.sum() * seconds - 4.0
        spread = np.asarray(source.spread)
        shared = np.asarray(source.velocity) + rng.normal(size=(count, 3)) * spread
        velocity = np.repeat(shared, CLUMP, axis=0) + OWN * rng.normal(size=(count * CLUMP, 3)) * spread
        half = np.array([*source.half, 0.0])
        place = np.asarray(source.start) + np.repeat(rng.uniform(-1, 1, (count, 3)) * half, CLUMP, axis=0)
        up = velocity[:, 2]
        flight = (up + np.sqrt(up**2 + 2 * GRAVITY * place[:, 2])) / GRAVITY
        return cls(source, place, velocity, flight, np.repeat(times, CLUMP), np.pi * radius**2)

    def at(self, time: float) -> Float[np.ndarray, "m 3"]:
        """Places (m) of those in the air at a time (s), 0 to 3."""
        age = time - self.born
        flies = (age > 0) & (age < self.flight)
        age = age[flies, None]
        return self.place[flies] + self.velocity[flies] * age - 0.5 * GRAVITY * age**2 * np.array([0.0, 0.0, 1.0])

    def landing(self, points: np.ndarray, pool: tuple[float, float]) -> np.ndarray:
        """How many land at points [h,w,3] of the pool, 1 or more: froth."""
        end = self.place + self.velocity * self.flight[:, None]
        low, step = -np.asarray(pool), 2 * np.asarray(pool) / 48
        cells = np.floor((end[:, :2] - low) / step).astype(int)
        cells = cells[((cells >= 0) & (cells < 48)).all(axis=1)]
        count = np.bincount(cells[:, 0] * 48 + cells[:, 1], minlength=48 * 48).reshape(48, 48).astype(np.float32)
        count = cv2.GaussianBlur(count, (0, 0), 1.5)
        at = np.clip(((points[..., :2] - low) / step), 0, 47).astype(int)
        return np.asarray(2.0 * count[at[..., 0], at[..., 1]] / max(float(count.max()), 1e-9))


def _cover(drops: list[_Drops], camera: PinholeCamera, time: float) -> np.ndarray:
    """Optical depth [h,w] of the drops at a time (s)."""
    width, height = camera.size
    total = np.zeros(width * height)
    for d in drops:
        uv, depth = camera.project(d.at(time))
        seen = (depth > 0) & (uv >= 0).all(axis=1) & (uv[:, 0] < width) & (uv[:, 1] < height)
        at = uv[seen].astype(int)
        hidden = d.area * (camera.focal[0] / depth[seen]) ** 2
        total += np.bincount(at[:, 1] * width + at[:, 0], weights=hidden, minlength=width * height)
    return cv2.GaussianBlur(total.reshape(height, width).astype(np.float32), (0, 0), 0.7)
