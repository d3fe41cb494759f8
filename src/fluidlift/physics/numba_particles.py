"""The particle half of a step on the CPU: what `seams.ParticleTransfer` and `seams.ParticleMover` ask for, in Numba."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from fluidlift.physics import transfer
from fluidlift.physics.boundaries import collide
from fluidlift.physics.deform import updated_deformation
from fluidlift.physics.device_liquid import DeviceLiquid
from fluidlift.seams import GroupedByCell, MoveRules, ParticleMover, ParticleTransfer, WallShape
from fluidlift.types import FaceVelocity, Grid, Particles


class NumbaTransfer(ParticleTransfer):
    """`physics.transfer`."""

    def particles_to_grid(
        self, particles: Particles, grid: Grid, order: GroupedByCell | None = None
    ) -> tuple[FaceVelocity, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """See `ParticleTransfer`."""
        return transfer.particles_to_grid(particles, grid, order)

    def grid_to_particles(
        self,
        velocity: FaceVelocity,
        grid: Grid,
        positions: Float[np.ndarray, "n 3"],
        order: GroupedByCell | None = None,
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
        """See `ParticleTransfer`."""
        return transfer.grid_to_particles(velocity, grid, positions, order)


class NumbaMover(ParticleMover):
    """`physics.boundaries.collide` and `physics.deform.updated_deformation`."""

    def moved(
        self,
        particles: Particles,
        moves: Float[np.ndarray, "n 3"],
        velocities: Float[np.ndarray, "n 3"],
        affine: Float[np.ndarray, "n 3 3"],
        walls: WallShape,
        rules: MoveRules,
    ) -> Particles:
        """See `ParticleMover`."""
        positions = (particles.positions + moves).astype(np.float32)
        new_velocities = np.array(velocities, np.float32)
        collide(
            positions, particles.positions, new_velocities, particles.velocities, walls, dt=rules.dt,
            restitution=rules.restitution, tangential_share=rules.tangential_share,
        )  # fmt: skip
        deformation = particles.deformation
        if rules.deform:
            deformation = updated_deformation(deformation, affine, rules.dt, max_stretch=rules.max_stretch)
        return replace(
            particles, positions=positions, velocities=new_velocities, affine=affine, deformation=deformation
        )


@dataclass(frozen=True)
class ParticleWork:
    """Who does the particle half of a step, or all of it."""

    transfer: ParticleTransfer = field(default_factory=NumbaTransfer)
    mover: ParticleMover = field(default_factory=NumbaMover)
    liquid: DeviceLiquid | None = None
    """who does the whole substep of a liquid, where it can (`device_liquid.left_to_the_host`); None: the host"""
