"""Made waves of known slope, as a surface's film shows them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from fluidlift.look.optics import fresnel
from fluidlift.look.wave_spectrum import SurfaceWindow
from fluidlift.physics.wave_dispersion import WaveMedium

PITCH, STEP, SEEN_AT = 0.06, 0.04, 1.2
"""m, s and radians from the plumb line of made windows"""
BODY = 0.05
"""irradiance reflectance of the made water"""


@dataclass(frozen=True)
class MadeWaves:
    """A sum of waves on a current."""

    wavevectors: np.ndarray
    """[n,2], rad/m"""
    steepness: np.ndarray
    """[n], amplitude times wavenumber"""
    omega: np.ndarray
    """[n], rad/s, as it is seen"""
    phases: np.ndarray

    @classmethod
    def running(cls, wavelength, slope, current, way, medium, *, count=24, seed=0):
        """Around a direction (radians), with a slope's standard deviation."""
        rng = np.random.default_rng(seed)
        k = 2 * np.pi / (wavelength * np.exp(rng.normal(0, 0.12, count)))
        turn = way + rng.normal(0, 0.25, count)
        vectors = k[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        omega = medium.frequency(k) + vectors @ np.array(current)
        return cls(vectors, np.full(count, slope * np.sqrt(2 / count)), omega, rng.uniform(0, 2 * np.pi, count))

    @classmethod
    def standing(cls, slope, current, medium, *, count=24, seed=0):
        """Against a current that holds them."""
        rng = np.random.default_rng(seed)
        speed, turn = np.hypot(*current), rng.uniform(-0.4, 0.4, count)
        k = np.array([medium.standing(speed * np.cos(t)) for t in turn])
        way = np.arctan2(-current[1], -current[0]) + turn
        vectors = k[:, None] * np.stack([np.cos(way), np.sin(way)], axis=-1)
        return cls(
            vectors, np.full(count, slope * np.sqrt(2 / count)), np.zeros(count), rng.uniform(0, 2 * np.pi, count)
        )

    @property
    def wavelength(self) -> float:
        """m, as `FilmedWaves.wavelength`."""
        return float(2 * np.pi / np.linalg.norm(self.wavevectors, axis=1).mean())

    def slopes(self, places, time, seen=1.0):
        """[...,2] at places [...,2] (m); seen: share of each wave that is left of it."""
        k = np.linalg.norm(self.wavevectors, axis=1)
        phase = places @ self.wavevectors.T - self.omega * time + self.phases
        return -(np.sin(phase) * (self.steepness * seen / k)) @ self.wavevectors

    def towards(self, places, sight, step, frames):
        """[frames,...] slopes at places [...,2] along lines of sight [...,2], every `step` seconds."""
        k = np.linalg.norm(self.wavevectors, axis=1)
        phase = places @ self.wavevectors.T + self.phases
        height = (sight @ self.wavevectors.T) * self.steepness / k
        times = np.outer(self.omega, step * np.arange(frames))
        found = (height * np.cos(phase)) @ np.sin(times) - (height * np.sin(phase)) @ np.cos(times)
        return np.moveaxis(found, -1, 0)


def brightness(incidence, slope):
    """Linear, of water under a uniform sky of 1, with a slope towards the viewer."""
    share = fresnel(np.cos(np.clip(incidence - slope, 0.0, 0.5 * np.pi)), 1.33)
    return share + (1 - share) * BODY


DEEP = WaveMedium()


def pattern(shape, rng, width=1.5):
    made = ndimage.gaussian_filter(rng.normal(size=shape), width)
    return made / made.std()


def window(waves, current, *, frames=90, measured=None, medium=DEEP, seed=0, **shown):
    """Seen along x, and the slope's variance in it, weighed as the spectrum weighs it; shown: contrasts beside it."""
    rng, size = np.random.default_rng(seed), 56
    foam, bed, noise = (shown.get(name, usual) for name, usual in (("foam", 0.05), ("bed", 0.1), ("noise", 0.02)))
    places = np.stack(np.meshgrid(*[(np.arange(size) + 0.5) * PITCH] * 2, indexing="ij"), axis=-1)
    drifting, lying = pattern((400, 400), rng), pattern((size, size), rng)
    hann = [np.hanning(n + 2)[1:-1] for n in (frames, size)]
    taper, total, found = np.outer(hann[1], hann[1]) ** 2, 0.0, []
    for t in range(frames):
        at = np.moveaxis((places - np.array(current) * t * STEP) / PITCH + 150, -1, 0)
        seen = foam * ndimage.map_coordinates(drifting, at, order=1, mode="wrap")
        seen = seen + bed * lying + noise * rng.normal(size=(size, size))
        slope = np.zeros((size, size, 2))
        if waves is not None:
            reach = waves.wavevectors * PITCH / (2 * np.pi)
            blurred = np.sinc(reach[:, 0]) ** 2 * np.sinc(reach[:, 1])  # of a pixel, and of a place
            slope = waves.slopes(places, t * STEP)
            seen = seen + np.log(brightness(SEEN_AT, waves.slopes(places, t * STEP, blurred)[..., 0]))
        total += hann[0][t] ** 2 * float(((slope**2).sum(axis=-1) * taper).sum())
        found.append(seen)
    truth = total / float((hann[0] ** 2).sum() * taper.sum())
    flow = tuple(current if measured is None else measured)
    return SurfaceWindow(
        np.stack(found), PITCH, STEP, flow, 0.0, medium, (1.0, 0.0), SEEN_AT, 4 * PITCH
    ), truth  # fmt: skip
