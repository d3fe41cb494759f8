"""A river between banks, boulders and trees, filmed by a camera on a known path: truth for cameras that go somewhere.

The ground is a table of heights, the water a plane at z = 0 whose pattern is carried by its flow and changes on the
way, as white water does. Each picture is found by marching along the rays of its camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.errors import require
from fluidlift.synthetic.paint import Noise
from fluidlift.types import PinholeCamera

NEAREST, FARTHEST, STEPS = 0.4, 80.0, 150
"""m along the ray, and how many steps, each longer than the one before by the same factor (3.6 %): a post of 0.3 m is
not stepped over within 9 m"""
TABLE = 0.05
"""m between two heights of the table"""
CORNER, EXTENT = np.array([-24.0, -6.0]), np.array([48.0, 90.0])
"""m: x and y where the table begins, and how long it is"""
WALKS = ("forward", "sideways", "turning", "standing")
"""the paths of `walk`"""


@dataclass(frozen=True)
class FilmedWalk:
    """A clip of T frames and its truth."""

    frames: UInt8[np.ndarray, "t h w 3"]
    """sRGB"""
    depth: Float[np.ndarray, "t h w"]
    """m of camera z; infinite in the sky"""
    water: Bool[np.ndarray, "t h w"]
    """where the water is seen"""
    cameras: tuple[PinholeCamera, ...]
    """world z up, the water at z = 0"""


@dataclass(frozen=True)
class Riverside:
    """The scene."""

    heights: Float[np.ndarray, "ny nx"]
    """m above the water"""
    colors: tuple[Noise, Noise, Noise]
    """patterns of three sizes"""
    current: float = 1.2
    """m/s along +y, away from a camera that looks along the river"""
    life: float = 0.4
    """s in which the pattern of the water becomes another one"""

    @classmethod
    def make(cls, seed: int = 0, *, bed: float = 2.4, current: float = 1.2) -> Riverside:
        """A river about twice as wide as `bed` (m) that winds between stones and trees, a hill at its end."""
        rng = np.random.default_rng(seed)
        nx, ny = (np.round(EXTENT / TABLE).astype(int)).tolist()
        x, y = np.meshgrid(CORNER[0] + TABLE * np.arange(nx), CORNER[1] + TABLE * np.arange(ny))
        middle = 0.7 * np.sin(y / 7.0)
        rough = Noise.make(rng, 12.0, 1.2).at(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1)).reshape(x.shape)
        height = 0.45 * (np.abs(x - middle) - bed) + 0.8 * (rough - 0.5) * np.clip(np.abs(x - middle) - bed, 0.0, 1.5)
        height = np.clip(height, -0.8, None) + np.clip((y - 30.0) / 3.0, 0.0, 9.0)
        for _ in range(70):  # stones on the banks, some in the water
            at = np.array([rng.uniform(-9, 9), rng.uniform(0.5, 28)])
            size = rng.uniform(0.25, 0.8)
            away = np.hypot(x - at[0], y - at[1]) / size
            height = np.where(
                away < 1.0, np.maximum(height, height + size * np.sqrt(np.clip(1 - away**2, 0, 1))), height
            )
        for _ in range(26):  # trees, as posts
            at = np.array([rng.choice([-1, 1]) * rng.uniform(bed + 1.3, 10.0), rng.uniform(3.0, 29.0)])
            inside = np.hypot(x - at[0] - 0.7 * np.sin(at[1] / 7.0), y - at[1]) < rng.uniform(0.15, 0.3)
            height = np.where(inside, 6.0, height)
        large, middling, small = (Noise.make(rng, period, 0.9) for period in (24.0, 7.0, 2.6))
        return cls(height.astype(np.float32), (large, middling, small), current)

    def height(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Of the ground at x and y, m above the water."""
        at = ((np.asarray(points, np.float32) - CORNER) / TABLE).astype(np.float32)
        # OpenCV takes pictures of at most 32767 rows
        found = [
            cv2.remap(self.heights, part[:, :1], part[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
            for part in np.array_split(at, len(at) // 30000 + 1)
            if len(part)
        ]
        return np.concatenate([np.zeros(0, np.float32), *found])

    def picture(self, camera: PinholeCamera, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a camera sees at a time (s): u8 [h,w,3], depth (m) [h,w], and bool [h,w] where it is water."""
        width, height = camera.size
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2))
        z = self._met(camera.position, rays)
        points = camera.position + rays * np.where(np.isfinite(z), z, 0.0)[:, None]
        wet = np.isfinite(z) & (self.height(points[:, :2]) < 0.0)
        pixel = np.where(np.isfinite(z), z, FARTHEST) / camera.focal[0]
        # the pattern of the water is a slice through noise that moves up by three of its grains within its life
        flown = points - np.array([0.0, self.current * time, -3.0 * self.colors[-1].period / 40 * time / self.life])
        pattern = self._pattern(np.where(wet[:, None], flown, points), pixel)[:, None]
        earth = np.array([0.42, 0.36, 0.28]) * (0.35 + 1.3 * pattern)
        foam = np.array([0.62, 0.68, 0.70]) * (0.45 + pattern)
        color = np.where(wet[:, None], foam, earth)
        color = np.where(np.isfinite(z)[:, None], color, [0.75, 0.8, 0.85])
        frame = np.round(255 * np.clip(color, 0, 1)).astype(np.uint8)
        return frame.reshape(height, width, 3), z.reshape(height, width), wet.reshape(height, width)

    def _met(self, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Depth at which rays meet ground or water, m; infinite where they meet nothing."""
        found = np.full(len(rays), np.inf)
        going, near = np.arange(len(rays)), NEAREST

        def above(index: np.ndarray, z: np.ndarray) -> np.ndarray:
            at = eye + rays[index] * np.asarray(z)[..., None]
            return at[:, 2] - np.maximum(self.height(at[:, :2]), 0.0)

        for far in np.geomspace(NEAREST, FARTHEST, STEPS)[1:]:
            below = above(going, np.full(len(going), far)) < 0.0
            met = going[below]
            low, high = np.full(len(met), near), np.full(len(met), far)
            for _ in range(12):
                half = 0.5 * (low + high)
                inside = above(met, half) < 0.0
                low, high = np.where(inside, low, half), np.where(inside, half, high)
            found[met] = high
            going, near = going[~below], far
        return found

    def _pattern(self, points: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """0 to 1, from three sizes of grain; those finer than a pixel (its size in m) are left out."""
        total = np.zeros(len(points))
        for noise, weight in zip(self.colors, (0.3, 0.35, 0.35)):
            grain = noise.period / 40 * 2.5
            seen = np.clip(grain / np.maximum(pixel, 1e-9) / 2.0 - 0.5, 0.0, 1.0)
            total += weight * (0.5 + seen * (noise.at(points) - 0.5))
        return total


def walk(
    path: str, frames: int, *, size: tuple[int, int] = (240, 160), fov: float = 60.0, length: float = 1.2
) -> tuple[PinholeCamera, ...]:
    """Cameras on a path over the river, which sway a little as a hand does.

    Args:
        path: one of `WALKS`.
        frames: how many.
        size: of the picture, px.
        fov: degrees across the longer side.
        length: m of the path; a camera that only turns does so by 10 degrees.
    """
    require(path in WALKS, f"path '{path}'", "one of " + ", ".join(WALKS))
    cameras = []
    for s in np.linspace(-0.5, 0.5, frames):
        eye, target = np.array([0.2, 0.0, 1.7]), np.array([0.2, 7.0, 0.0])
        if path == "forward":
            eye, target = eye + [0.0, length * s, 0.0], target + [0.0, length * s, 0.0]
        elif path == "sideways":
            eye, target = eye + [length * s, 0.0, 0.0], target + [0.6 * length * s, 0.0, 0.0]
        if path == "turning":
            angle = np.radians(10.0) * s
            target = eye + [7.0 * np.sin(angle), 7.0 * np.cos(angle), -1.7]
        elif path != "standing":
            target = target + [0.06 * np.sin(9.0 * s), 0.0, 0.05 * np.cos(11.0 * s)]
        cameras.append(PinholeCamera.looking(tuple(eye), tuple(target), fov, size))
    return tuple(cameras)


def film(scene: Riverside, cameras: Sequence[PinholeCamera], *, fps: float = 25.0, seed: int = 0) -> FilmedWalk:
    """The scene through these cameras, a frame each, with the noise of a sensor (1 grey level)."""
    rng = np.random.default_rng(seed)
    shots = [scene.picture(camera, t / fps) for t, camera in enumerate(cameras)]
    frames = [
        np.clip(np.round(shot[0] + rng.normal(0.0, 1.0, shot[0].shape[:2])[..., None]), 0, 255).astype(np.uint8)
        for shot in shots
    ]
    return FilmedWalk(
        np.stack(frames), np.stack([s[1] for s in shots]), np.stack([s[2] for s in shots]), tuple(cameras)
    )  # fmt: skip
