"""Made waves of known slope, as a surface's film shows them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluidlift.look.optics import fresnel
from fluidlift.physics.wave_dispersion import WaveMedium

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
