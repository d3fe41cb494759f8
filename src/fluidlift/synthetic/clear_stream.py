"""A shallow stream whose bed is seen through rippled water, and its opaque twin: truth for what is seen of a bed.

Light is followed one ray to a pixel: mirrored or bent at the level surface with the slope of its ripples, absorbed on
its way down and up, focused on the bed by the surface's curvature (caustics), and glinting where a facet mirrors the
sun. The bed is a height field with a pattern of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.errors import require
from fluidlift.look.optics import fresnel, refract
from fluidlift.physics.wave_dispersion import WaveMedium
from fluidlift.synthetic.paint import Noise, sky, smoothstep
from fluidlift.types import PinholeCamera

INDEX = 1.333
"""of water"""
SUN = np.array([0.45, 0.35, 0.82]) / np.linalg.norm([0.45, 0.35, 0.82])
"""towards the sun: glints are seen by a camera at -y, but not all over the picture"""
GLINT = 40.0
"""linear radiance of a facet that mirrors the sun, spread over the slopes within a pixel"""
GLOSS = 0.02
"""standard deviation of those slopes"""
FOAM = np.array([0.75, 0.77, 0.78])
"""linear, of what drifts on the opaque twin"""
CAMERAS = {
    "steep": PinholeCamera.looking((0.0, -2.6, 4.5), (0.0, 0.0, 0.0), 50.0, (192, 128)),
    "oblique": PinholeCamera.looking((0.0, -5.0, 2.8), (0.0, 0.3, 0.0), 40.0, (192, 128)),
}
"""they look down by 60 and by 28 degrees"""


@dataclass(frozen=True)
class FilmedBed:
    """A clip of T frames and its truth."""

    frames: UInt8[np.ndarray, "t h w 3"]
    """sRGB"""
    water: Bool[np.ndarray, "h w"]
    """where the water is seen"""
    flow: Float[np.ndarray, "h w 2"]
    """px per frame, of the surface"""
    depth: Float[np.ndarray, "h w"]
    """camera z of the surface, or of dry ground, m"""
    still: Float[np.ndarray, "h w 3"]
    """linear light of the bed at the camera through a level surface, without what that mirrors"""


@dataclass(frozen=True)
class ClearStream:
    """The scene: a channel along x, the water's surface at z = 0."""

    colors: tuple[Noise, Noise, Noise, Noise]
    """patterns of the ground, of four sizes: gravel has edges as fine as a picture shows"""
    waves: Float[np.ndarray, "n 4"]
    """wavevector (2, rad/m), steepness (amplitude times wavenumber) and phase of each ripple"""
    foam: Noise
    depth: float = 0.4
    """m, in the middle"""
    half_width: float = 1.6
    """m, of the water"""
    current: float = 0.5
    """m/s along +x"""
    absorption: tuple[float, float, float] = (0.9, 0.5, 0.8)
    """1/m"""
    light: float = 1.0
    """linear, of dry white ground"""
    haze: float = 0.45
    """times `paint.sky`. A clear sky sends a fifth of the light on level ground, and is itself a fifth to a third as
    bright as white ground there: 0.45. 1 is a hazy one"""
    opaque: bool = False
    """the water hides its bed: it has a colour of its own, and foam drifts on it"""

    @classmethod
    def make(
        cls,
        seed: int = 0,
        *,
        depth: float = 0.4,
        slope: float = 0.04,
        current: float = 0.5,
        absorption: tuple[float, float, float] = (0.9, 0.5, 0.8),
        haze: float = 0.45,
        opaque: bool = False,
    ) -> ClearStream:
        """Ripples of 5 to 30 cm that run about with the current.

        Args:
            seed: of patterns and ripples.
            depth: m, in the middle.
            slope: standard deviation of the surface's.
            current: m/s.
            absorption: 1/m.
            haze: of the sky.
            opaque: whether the water hides its bed.
        """
        require(depth > 0 and slope >= 0, f"a depth of {depth} m and a slope of {slope}", "above 0, and 0 or more")
        rng = np.random.default_rng(seed)
        colors = (
            Noise.make(rng, 6.0, 1.4),
            Noise.make(rng, 2.4, 1.0),
            Noise.make(rng, 1.3, 0.8),
            Noise.make(rng, 0.5, 0.7),
        )
        count = 24
        k, turn = 2.0 * np.pi / rng.uniform(0.05, 0.3, count), rng.normal(0.0, 1.0, count)
        steep = np.full(count, slope * np.sqrt(2.0 / count))
        phase = rng.uniform(0, 2 * np.pi, count)
        waves = np.stack([k * np.cos(turn), k * np.sin(turn), steep, phase], axis=-1)
        return cls(
            colors,
            waves,
            Noise.make(rng, 1.6, 0.9),
            depth,
            current=current,
            absorption=absorption,
            haze=haze,
            opaque=opaque,
        )

    def height(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """m above the water: a round channel between banks of 20 degrees."""
        across = np.abs(points[..., 1]) / self.half_width
        bank = np.tan(np.radians(20.0)) * (np.abs(points[..., 1]) - self.half_width)
        return np.where(across < 1.0, -self.depth * (1.0 - across**2), bank)

    def albedo(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Linear, of the dry ground: brown to grey gravel."""
        at = np.concatenate([points, 0.3 + 0.0 * points[:, :1]], axis=1)
        shade = sum(weight * noise.at(at) for weight, noise in zip((0.2, 0.25, 0.25, 0.3), self.colors, strict=True))
        dark, pale = np.array([0.10, 0.075, 0.045]), np.array([0.46, 0.40, 0.31])
        return dark + (pale - dark) * smoothstep(np.asarray(shade), 0.35, 0.65)[:, None]

    def ripples(
        self, points: Float[np.ndarray, "n 2"], time: float
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """Slope, and curvature (1/m, of the sum of both axes), of the surface."""
        vectors, steep, phases = self.waves[:, :2], self.waves[:, 2], self.waves[:, 3]
        k = np.linalg.norm(vectors, axis=1)
        omega = WaveMedium(self.depth).frequency(k) + vectors[:, 0] * self.current
        phase = points @ vectors.T - omega * time + phases
        return -(np.sin(phase) * (steep / k)) @ vectors, -np.cos(phase) @ (steep * k)

    def bed_below(self, points: Float[np.ndarray, "n 3"], way: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """m along unit ways, downwards from the surface, to the bed."""
        run = -self.height(points[:, :2]) / np.maximum(-way[:, 2], 1e-3)
        for _ in range(12):
            at = points + run[:, None] * way
            run = run + 0.8 * (at[:, 2] - self.height(at[:, :2])) / np.maximum(-way[:, 2], 1e-3)
        return np.maximum(run, 0.0)

    def picture(self, camera: PinholeCamera, time: float) -> Float[np.ndarray, "h w 3"]:
        """Linear light that a camera sees at a time, s."""
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2))
        unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        met, wet = self._met(camera)
        out = self.light * self.albedo(met[:, :2])
        slope, bend = self.ripples(met[wet, :2], time)
        normal = np.concatenate([-slope, np.ones((len(slope), 1))], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        share = fresnel(-(unit[wet] * normal).sum(axis=1), INDEX)[:, None]
        mirror = unit[wet] + 2.0 * -(unit[wet] * normal).sum(axis=1, keepdims=True) * normal
        half = SUN - unit[wet]
        facet = half[:, :2] / np.maximum(half[:, 2:], 1e-3) + slope
        glint = GLINT * np.exp(-0.5 * (facet**2).sum(axis=1) / GLOSS**2)
        mirrored = self.light * self.haze * sky(mirror) + glint[:, None]
        out[wet] = (1.0 - share) * self._below(met[wet], unit[wet], normal, bend, time) + share * mirrored
        return out.reshape(*camera.size[::-1], 3)

    def _below(self, points, unit, normal, bend, time) -> np.ndarray:
        """Linear light that comes up through the surface, before Fresnel's share of it is lost."""
        if self.opaque:
            at = points - np.array([self.current * time, 0.0, 0.0])
            drift = smoothstep(self.foam.at(at), 0.55, 0.8)[:, None]
            body = 0.07 * np.array([0.9, 0.8, 0.6]) * (1.0 + 2.0 * normal[:, :1])
            return self.light * (body * (1.0 - drift) + FOAM * drift)
        way, _ = refract(unit, normal, 1.0 / INDEX)
        up = self.bed_below(points, way)
        bed = points + up[:, None] * way
        deep = np.maximum(-self.height(bed[:, :2]), 0.0)
        slant = np.sqrt(1.0 - (1.0 - SUN[2] ** 2) / INDEX**2)
        # a thin lens of curvature b moves light inwards by (1 - 1/n) b of its distance: as much brighter
        focus = np.clip(1.0 - (1.0 - 1.0 / INDEX) * bend * deep, 0.3, 3.0)
        left = np.exp(-(up + deep / slant)[:, None] * np.array(self.absorption))
        white = (1.0 - fresnel(SUN[2:], INDEX)[0]) / INDEX**2
        return self.light * white * self.albedo(bed[:, :2]) * left * focus[:, None]

    def _met(self, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
        """[n,3] where rays meet water or dry ground, and whether it is water."""
        eye, rays = camera.position, camera.rays(camera.pixel_grid().reshape(-1, 2))
        require(bool((rays[:, 2] < -1e-3).all()), "a camera that sees the horizon", "one that looks down")
        run = -eye[2] / rays[:, 2]
        at = eye + run[:, None] * rays
        wet = np.abs(at[:, 1]) < self.half_width
        for _ in range(30):
            at = eye + run[:, None] * rays
            over = at[:, 2] - self.height(at[:, :2])
            run = np.where(wet, run, run + 0.7 * over / -rays[:, 2])
        return eye + run[:, None] * rays, wet

    def truth(self, camera: PinholeCamera, fps: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Water [h,w], flow [h,w,2] in px per frame, depth [h,w] and still light [h,w,3], as `FilmedBed` has them."""
        shape = camera.size[::-1]
        met, wet = self._met(camera)
        before, depth = camera.project(met)
        after, _ = camera.project(met + np.array([self.current / fps, 0.0, 0.0]))
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2))
        unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        level = np.tile([0.0, 0.0, 1.0], (int(wet.sum()), 1))
        still = np.zeros((len(met), 3))
        share = fresnel(-unit[wet, 2], INDEX)[:, None]
        still[wet] = (1.0 - share) * self._below(met[wet], unit[wet], level, np.zeros(len(level)), 0.0)
        flow = np.where(wet[:, None], after - before, 0.0)
        return wet.reshape(shape), flow.reshape(*shape, 2), depth.reshape(shape), still.reshape(*shape, 3)


def film_of_bed(scene: ClearStream, camera: PinholeCamera, frames: int, *, fps: float = 25.0, seed: int = 0):
    """A `FilmedBed` of a scene, with the noise of a sensor (1 grey level).

    Args:
        scene: what is filmed.
        camera: which stands.
        frames: how many.
        fps: per second.
        seed: of the noise.
    """
    from fluidlift.numerics.srgb import srgb_from_linear

    rng = np.random.default_rng(seed)
    shots = []
    for t in range(frames):
        light = 255.0 * srgb_from_linear(np.clip(scene.picture(camera, t / fps), 0.0, 1.0))
        shots.append(np.clip(np.round(light + rng.normal(0.0, 1.0, light.shape)), 0, 255).astype(np.uint8))
    water, flow, depth, still = scene.truth(camera, fps)
    return FilmedBed(np.stack(shots), water, flow, depth, still)
