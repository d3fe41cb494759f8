"""Wave gauges: where the surface of the liquid in a tank is, and how much it encloses.

The number of particles says nothing of the volume they fill: they may crowd or thin out. These gauges smooth the
particles to a density and take the surface where it has fallen to one half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.synthetic.surface import body_of, finer, open_share
from fluidlift.synthetic.tanks import Tank
from fluidlift.types import Grid, Particles


@dataclass(frozen=True)
class Gauge:
    """Measures the liquid of one tank on cells half as wide as the simulation's."""

    grid: Grid
    """of the simulation"""
    fine: Grid
    opening: Float[np.ndarray, "fx fy fz"]
    """share of each fine cell that is not solid"""
    density: float
    """kg/m^3"""

    @classmethod
    def of(cls, tank: Tank) -> Gauge:
        """The gauge of a tank."""
        fine = finer(tank.grid)
        solid = sample_nodes(tank.terrain.signed_distance, tank.grid, fine.centers().reshape(-1, 3))
        return cls(tank.grid, fine, open_share(solid.reshape(fine.shape), fine.spacing), tank.parameters.density)

    def wet(self, particles: Particles) -> Float[np.ndarray, "fx fy fz"]:
        """Share of each fine cell that the liquid fills."""
        if not len(particles):
            return np.zeros(self.fine.shape)
        volumes = particles.masses.astype(np.float64) / self.density
        signed = body_of(particles.positions, volumes, self.grid, self.opening).signed_cells(self.fine)
        return np.clip(0.5 - signed, 0.0, 1.0) * self.opening

    def depth(self, particles: Particles) -> Float[np.ndarray, "fx fy"]:
        """m of liquid in each column of fine cells."""
        return self.wet(particles).sum(axis=2) * self.fine.spacing

    def volume(self, particles: Particles) -> float:
        """m^3 that the surface encloses."""
        return float(self.wet(particles).sum()) * self.fine.spacing**3

    def amplitude(self, particles: Particles, mode: int) -> float:
        """m: of the standing wave cos(mode pi x / length) along the tank."""
        n = self.fine.shape[0]
        wave = np.cos(mode * np.pi * (np.arange(n) + 0.5) / n)
        return float(2.0 * (self.depth(particles).mean(axis=1) * wave).mean())
