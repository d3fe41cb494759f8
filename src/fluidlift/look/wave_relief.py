"""Waves played on the surface of a simulated liquid: its small-scale relief, as height and slope at any place and time.

A sum of waves a cos(k . (x - U tau) - sigma(k) t + phase) with the dispersion relation of `physics.wave_dispersion`,
on the mean current U of the place. Where U differs from place to place, what it carries is sheared; so, like patches of
a texture (`look.texture_patches`), waves are carried for a while only, tau from -`life` / 2 to `life` / 2, by two
layers that come and go in turn, with new phases each time. Their weights are cosine and sine: the variance stays.
Waves that stand have no such layers: they stay where they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.look.surface_map import sampled
from fluidlift.look.wave_spectrum import FilmedWaves
from fluidlift.numerics.sharing import shared
from fluidlift.physics.wave_dispersion import STEEPEST, WaveMedium

COUNT = 32
"""waves of a sum, for each of those that run and that stand: with half as many, groups of waves are seen to repeat"""
LIVES = (1.0, 6.0)
"""s that a layer lasts, at least and at most: shorter ones blur the frequencies, by 1 / life"""
SHEARED = 1.0
"""by which a current may have sheared a layer from its middle to its end, as patches of a texture: beyond, crests lie
along the stream"""
GROWS = 2.0
"""power of the current by which waves grow with it: a wave that stands is as long as its current squared, and its
steepness is its obstacle's"""
MOST_GROWN = 4.0
"""times the filmed height, at most"""
SLOW = 0.05
"""m/s that count to any current, so that still water next to still water has grown by nothing"""


class SurfaceRelief(NamedTuple):
    """Of places on a surface."""

    height: Float[np.ndarray, " n"]
    """m above the surface without waves"""
    slope: Float[np.ndarray, "n 2"]
    """along x and y"""
    rate: Float[np.ndarray, " n"]
    """m/s, of the height; that layers come and go counts for nothing"""


@dataclass(frozen=True)
class WaveRelief:
    """Waves on a current that is steady."""

    wavevectors: Float[np.ndarray, "n 2"]
    """rad/m"""
    steepness: Float[np.ndarray, " n"]
    """amplitude times wavenumber, of each"""
    standing: Bool[np.ndarray, " n"]
    medium: WaveMedium
    low: Float[np.ndarray, "2"]
    """m, corner of the map"""
    pitch: float
    """m, of its columns"""
    current: Float[np.ndarray, "nx ny 2"]
    """m/s"""
    growth: Float[np.ndarray, "nx ny"]
    """times the steepness"""
    life: float
    """s, of a layer"""
    seed: int
    filmed: FilmedWaves
    """that they are like"""

    @classmethod
    def of(
        cls,
        waves: FilmedWaves,
        medium: WaveMedium,
        place: tuple[np.ndarray, float],
        current: Float[np.ndarray, "nx ny 2"],
        growth: Float[np.ndarray, "nx ny"],
        *,
        amount: float = 1.0,
        seed: int = 0,
    ) -> WaveRelief:
        """Waves like those of a film.

        Args:
            waves: of the film.
            medium: what they run on.
            place: corner and pitch of the map, m.
            current: of the simulation, m/s.
            growth: by how much they are higher than filmed.
            amount: the same everywhere.
            seed: of phases and wavenumbers.
        """
        require(current.shape == (*growth.shape, 2), f"currents {current.shape}", f"{(*growth.shape, 2)}")
        rng = np.random.default_rng(seed)
        parts = [_drawn(waves, stands, rng) for stands in (False, True)]
        vectors, variance = (np.concatenate([p[i] for p in parts]) for i in range(2))
        standing = np.repeat([False, True], [len(p[0]) for p in parts])
        steepest = 0.5 * STEEPEST**2 / max(float(variance.sum()), 1e-12)
        higher = np.minimum(amount * growth, np.sqrt(steepest))
        return cls(
            vectors, np.sqrt(2.0 * variance), standing, medium, np.asarray(place[0], float), float(place[1]),
            np.asarray(current, float), higher, _life(current, place[1]), seed, waves,
        )  # fmt: skip

    def at(
        self, places: Float[np.ndarray, "n 2"], time: float, *, blur: Float[np.ndarray, " n"] | float = 0.0
    ) -> SurfaceRelief:
        """At some places (x, y in m).

        Args:
            places: on the plan.
            time: s.
            blur: m, standard deviation by which each place is blurred: pixels and triangles hold no shorter waves.
        """
        places = np.asarray(places, np.float64)
        index = (places - self.low) / self.pitch - 0.5
        grown, wide = sampled(self.growth, index), np.broadcast_to(np.asarray(blur, np.float64), len(places))
        at = np.column_stack([places, sampled(self.current, index), wide])
        k = np.linalg.norm(self.wavevectors, axis=1)
        waves = np.column_stack([self.wavevectors, self.steepness / k, self.medium.frequency(k)])
        out = np.zeros((len(places), 4))
        for layer in self._layers(time):
            which = self.standing if layer.standing else ~self.standing
            if which.any():
                numbers = np.array([layer.weight, layer.tau, time, float(not layer.standing)])
                add_waves(at, np.ascontiguousarray(waves[which]), layer.phases[which], numbers, out)
        out *= grown[:, None]
        return SurfaceRelief(out[:, 0], out[:, 1:3], out[:, 3])

    def _layers(self, time: float) -> list[_Layer]:
        """Those that are there at a time."""
        n, found = len(self.steepness), []
        for layer in range(2):
            age = time / self.life + 0.5 * layer
            tau = (age - np.floor(age) - 0.5) * self.life
            found.append(
                _Layer(False, float(np.cos(np.pi * tau / self.life)), tau, self._phases(n, layer, int(np.floor(age))))
            )
        return [*found, _Layer(True, 1.0, 0.0, self._phases(n, 2, 0))]

    def _phases(self, n: int, layer: int, generation: int) -> np.ndarray:
        # a time before the first one has a generation below 0
        rng = np.random.default_rng([self.seed, layer, generation % 2**32])
        return rng.uniform(0.0, 2.0 * np.pi, n)


class _Layer(NamedTuple):
    standing: bool
    weight: float
    tau: float
    """s for which the current has carried it"""
    phases: np.ndarray


def _drawn(waves: FilmedWaves, stands: bool, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """`COUNT` wavenumbers [n,2] from those of a film, and the variance of slope of each: all the same."""
    of = waves.standing == stands
    total = float(waves.variance[of].sum())
    if total <= 0:
        return np.zeros((0, 2)), np.zeros(0)
    vectors, share = waves.wavevectors[of], np.cumsum(waves.variance[of]) / total
    # one from each equal share: as the film's, however few there are
    picked = np.searchsorted(share, (np.arange(COUNT) + rng.uniform(0.0, 1.0, COUNT)) / COUNT)
    jitter = rng.uniform(-0.5, 0.5, (COUNT, 2)) * waves.bins
    found = vectors[np.minimum(picked, len(vectors) - 1)] + jitter
    return found, np.full(COUNT, total / COUNT)


def _life(current: np.ndarray, pitch: float) -> float:
    """s that a layer lasts on a current."""
    if min(current.shape[:2]) < 2:
        return LIVES[1]
    shear = np.stack([np.gradient(current[..., a], pitch) for a in range(2)])
    usual = float(np.sqrt((shear**2).sum(axis=(0, 1)).mean()))
    return float(np.clip(2.0 * SHEARED / max(usual, 1e-9), *LIVES))


def grown_with(now: Float[np.ndarray, "nx ny 2"], filmed: Float[np.ndarray, "nx ny 2"]) -> Float[np.ndarray, "nx ny"]:
    """By how much waves are higher on a current (m/s) than on the filmed one of the same place."""
    ratio = (np.linalg.norm(now, axis=-1) + SLOW) / (np.linalg.norm(filmed, axis=-1) + SLOW)
    return np.minimum(ratio**GROWS, MOST_GROWN)


@shared(lambda at, waves, phases, layer, out: (0, len(at)))
def add_waves(begin, end, at, waves, phases, layer, out):
    """Height (m), slopes and rate (m/s) of some waves, added at places.

    at: x, y (m), the current there (m/s) and the blur (m) of each; waves: wavenumbers along x and y (rad/m), amplitude
    (m) and sigma (rad/s) of each; layer: weight, tau (s), time (s), and 1 where they run, 0 where they stand.
    """
    weight, tau, time, runs = layer[0], layer[1], layer[2], layer[3]
    for i in range(begin, end):
        u, v, blur = at[i, 2], at[i, 3], at[i, 4]
        x, y = at[i, 0] - runs * u * tau, at[i, 1] - runs * v * tau
        for w in range(len(waves)):
            kx, ky = waves[w, 0], waves[w, 1]
            own = runs * waves[w, 3]
            wide = 0.5 * (kx * kx + ky * ky) * blur * blur
            if wide > 8.0:  # 0.03 % is left
                continue
            a = weight * waves[w, 2] * np.exp(-wide)
            phase = kx * x + ky * y - own * time + phases[w]
            s = a * np.sin(phase)
            out[i, 0] += a * np.cos(phase)
            out[i, 1] -= kx * s
            out[i, 2] -= ky * s
            out[i, 3] += (own + runs * (kx * u + ky * v)) * s
