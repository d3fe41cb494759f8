"""The liquid: affine particle-in-cell with pressure projection (paper: "Presumed APIC Simulation").

One substep: fill the inlet; particles to grid; gravity; viscosity; pressure; continue the velocity into air and along
walls; grid to particles; move; correct crowding; collide; deform; remove what has left. A substep either completes
or leaves the state as it was.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.physics import boundaries, transfer
from fluidlift.physics.crowding import fill_ratio, spreading
from fluidlift.physics.deform import updated_deformation
from fluidlift.physics.forces import add_gravity
from fluidlift.physics.outlet import hold_columns, outlet_heads, water_levels
from fluidlift.physics.pressure import PressureSystem, build_system, project
from fluidlift.physics.reseed import inner_cells, reseed
from fluidlift.physics.stepping import (
    TIDY_EVERY,
    EmitSource,
    Outcome,
    ParticleSimulator,
    SimulationSettings,
    StepReport,
)
from fluidlift.physics.travel import displacements, leaving
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles, SolveReport, Terrain

__all__ = ["EmitSource", "LiquidSimulator", "SimulationSettings", "StepReport"]


class LiquidSimulator(ParticleSimulator):
    """A body of liquid on a terrain, with an inlet and an outlet.

    The sides of the box are frictionless walls, except in INFLOW and OUTFLOW cells and on top (against gravity),
    where particles that leave are removed. The terrain's signed distance decides what is solid.

    Outlet: particles flow freely and are removed when they leave the box there, or when they leave the OUTFLOW cells
    along the mainstream. Columns of liquid that stand on the ground inside OUTFLOW cells have the hydrostatic pressure
    of the water level they start with (see `physics.outlet`). `parameters.outflow_velocity` is used only with
    `settings.prescribe_outflow`.

    Masses: the initial particles get the mass of the space around them (their mean spacing where they are sparser
    than usual), since Gaussians sample a body unevenly; the masses given are replaced.

    Args:
        grid: the same as the terrain's.
        terrain: solid and mainstream.
        parameters: of the fluid.
        particles: initial state with velocities; ids are kept, new ones continue after the largest.
        cell_types: u8 [nx,ny,nz]; INFLOW and OUTFLOW cells count, the rest follows from terrain and particles.
        inflow_profile: shape of the velocity at the inlet; None: uniform. It is scaled and shifted so that its mean
            over the INFLOW cells is `parameters.inflow_velocity`.
        seed: of the emission jitter and the inflow fluctuation.
        particles_per_cell: of the inflow.
        emit_source: looks of new particles; None: that of the nearest initial particle.
        settings: numerical choices; its `particles_per_cell` is overridden by the argument.

    Raises:
        ValueError: arguments of wrong shape, or numbers that are not finite.
    """

    def __init__(
        self,
        grid: Grid,
        terrain: Terrain,
        parameters: FluidParameters,
        particles: Particles,
        *,
        cell_types: np.ndarray,
        inflow_profile: FaceVelocity | None = None,
        seed: int = 0,
        particles_per_cell: int = 8,
        emit_source: EmitSource | None = None,
        settings: SimulationSettings | None = None,
    ) -> None:
        gravity = np.asarray(parameters.gravity)
        open_sides = np.zeros((3, 2), bool)
        if gravity.any():
            top = int(np.abs(gravity).argmax())
            open_sides[top, int(gravity[top] < 0)] = True
        super().__init__(
            grid, terrain, parameters, particles, cell_types=cell_types, inflow_profile=inflow_profile, seed=seed,
            emit_source=emit_source, open_sides=open_sides,
            settings=replace(settings or SimulationSettings(), particles_per_cell=particles_per_cell),
        )  # fmt: skip
        self._wall_cells = boundaries.beside_closed_faces(self._walls)
        self._outlet_faces = self._faces_between_liquid_and_outlet() if self.settings.prescribe_outflow else None
        self._head_rate: np.ndarray | None = None
        self._start_levels = self._levels_now() if (self._walls.regions == CellType.OUTFLOW).any() else None

    def state(self) -> dict[str, np.ndarray]:
        """See `ParticleSimulator.state`; also the water levels at the outlet and the pressure as a first guess."""
        own = {"head_rate": self._head_rate, "start_levels": self._start_levels}
        return super().state() | {k: v.copy() for k, v in own.items() if v is not None}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See `ParticleSimulator.restore`."""
        rate, levels = state.get("head_rate"), state.get("start_levels")
        if rate is not None and (rate.shape != self.grid.shape or not np.isfinite(rate).all()):
            raise InputRejected("a simulation state of another grid", f"{self.grid.shape} cells")
        if (levels is None) != (self._start_levels is None) or (
            levels is not None and levels.shape != self.grid.shape[:2]
        ):
            raise InputRejected("a simulation state with another outlet")
        super().restore(state)
        self._head_rate = None if rate is None else np.array(rate)
        self._start_levels = None if levels is None else np.array(levels)

    def _faces_between_liquid_and_outlet(self) -> tuple[np.ndarray, ...]:
        out = []
        outflow = self._walls.regions == CellType.OUTFLOW
        for axis in range(3):
            pad = [(0, 0)] * 3
            pad[axis] = (1, 1)
            wide = np.moveaxis(np.pad(outflow, pad), axis, 0)
            out.append(np.moveaxis(wide[1:] | wide[:-1], 0, axis) & (self._walls.openings[axis] > 0))
        return tuple(out)

    def _levels_now(self) -> np.ndarray:
        occupied = np.diff(transfer.sort_by_cell(self._particles.positions, self.grid).start) > 0
        return water_levels(occupied.reshape(self.grid.shape), self._walls)

    def _impose(self, velocity: FaceVelocity) -> FaceVelocity:
        """Inflow, and outflow where it is prescribed."""
        velocity = self._inlet.impose(velocity, self.time)
        if self._outlet_faces is None:
            return velocity
        speed = self.parameters.outflow_velocity * self._mainstream
        return FaceVelocity(
            *(np.where(f, np.float32(s), c) for f, s, c in zip(self._outlet_faces, speed, velocity.components))
        )

    def _system(self, types: np.ndarray) -> PressureSystem:
        # the walls have closed the sides of the box already
        system = build_system(types, self._walls.openings, self.grid, open_border=True)
        if self._outlet_faces is None:
            return system
        closed = [np.where(f, np.float32(0), w) for f, w in zip(self._outlet_faces, system.weights)]
        return replace(system, weight_x=closed[0], weight_y=closed[1], weight_z=closed[2])

    def _grid_velocity(
        self, order: transfer.CellOrder, dt: float
    ) -> tuple[FaceVelocity, PressureSystem, np.ndarray, SolveReport, tuple[SolveReport, ...]]:
        """The new velocity on all faces near the liquid, the pressure system, q / dt, and the reports of the solves."""
        particles, grid, walls = self._particles, self.grid, self._walls
        velocity, _ = transfer.particles_to_grid(particles, grid, order)
        occupied = (np.diff(order.start) > 0).reshape(grid.shape)
        types = boundaries.liquid_cells(occupied, walls)
        wet = (types == CellType.FLUID) | (types == CellType.INFLOW) | ((types == CellType.OUTFLOW) & occupied)
        wet_faces = self._wet_faces(wet)
        velocity = self._impose(add_gravity(velocity, self.parameters.gravity, dt))
        velocity, viscosity_reports = self._viscous(velocity, wet_faces, dt, self._outlet_faces)
        system = self._system(types)
        heads = None
        if self._outlet_faces is None and self._start_levels is not None:
            heads = outlet_heads(water_levels(wet, walls), self._start_levels, walls)
        known = None if heads is None else heads * max(-self.parameters.gravity[2], 0.0) * dt
        initial = None if self._head_rate is None else self._head_rate * dt
        velocity, q, report, system = self._projected(velocity, system, dt, initial, known)
        if known is not None:
            velocity = hold_columns(velocity, known, walls)
        velocity = self._impose(velocity)
        velocity = boundaries.slide_along_walls(boundaries.extrapolate(velocity, wet_faces), walls)
        return velocity, system, q / dt, report, viscosity_reports

    def _projected(
        self, velocity: FaceVelocity, system: PressureSystem, dt: float, initial: np.ndarray | None, known
    ) -> tuple[FaceVelocity, np.ndarray, SolveReport, PressureSystem]:
        """Projection in which no wall sucks: wall cells whose pressure comes out negative are solved again as air.

        A projection alone holds liquid at walls that it would leave, because nothing may fill the gap (Batty et al.
        2007, section 5); a nappe would cling to its cliff. One correction stands for the full inequality p >= 0.
        """
        tolerance = self.settings.pressure_tolerance
        new, q, report = project(velocity, system, tolerance=tolerance, initial=initial, known=known)
        weight = float(np.linalg.norm(self.parameters.gravity)) * self.grid.spacing * dt
        if not self.settings.separate_from_walls or weight == 0.0:
            return new, q, report, system
        sucked = system.unknown & self._wall_cells & (q < -0.1 * weight)
        if not sucked.any():
            return new, q, report, system
        system = replace(system, unknown=system.unknown & ~sucked)
        new, q, report = project(velocity, system, tolerance=tolerance, initial=q, known=known)
        return new, q, report, system

    def _substep(self, dt: float, number: int, *, last_attempt: bool) -> Outcome | None:
        grid, walls = self.grid, self._walls
        if not len(self._particles):
            return Outcome(self._particles, 0, SolveReport(True, 0, 0.0, "empty"), (), lambda: None)
        order = transfer.sort_by_cell(self._particles.positions, grid)
        if number % TIDY_EVERY == 0:
            order = self._tidied(order)
        particles = self._particles
        velocity, system, head_rate, report, viscosity_reports = self._grid_velocity(order, dt)
        velocities, affine = transfer.grid_to_particles(velocity, grid, particles.positions, order)
        moves, farthest = displacements(velocities, affine, dt)
        farthest /= grid.spacing
        if not farthest <= 3.0 * self.settings.courant:
            if not last_attempt:
                return None
            raise FluidliftError(
                f"Step {self._advances}, substep {number + 1}, t = {self.time:.4g} s: the simulation blew up (a "
                f"particle would cross {farthest:.3g} cells in {dt:.3g} s; pressure residual {report.residual:.2g}). "
                "The state before it is kept. Use a smaller time_step, or check inflow velocity, terrain and viscosity."
            )
        if self.settings.spread_crowds:
            volumes = (particles.masses / self.parameters.density).astype(np.float32)
            ratio = fill_ratio(particles.positions, volumes, grid, order, self._capacity)
            spread = spreading(particles.positions, ratio, self._capacity, system, grid, order)
            moves = moves if spread is None else moves + spread
        positions = (particles.positions + moves).astype(np.float32)
        keep = (1.0 - self.parameters.wall_damping) ** (dt / self.parameters.time_step)
        boundaries.collide(
            positions, particles.positions, velocities, particles.velocities, walls, dt=dt,
            restitution=self.parameters.restitution, tangential_share=keep,
        )  # fmt: skip
        deformation = updated_deformation(particles.deformation, affine, dt, max_stretch=self.settings.max_stretch)
        state = replace(particles, positions=positions, velocities=velocities, affine=affine, deformation=deformation)
        gone = leaving(particles.positions, positions, walls, self._mainstream)
        if gone.any():
            state = state.select(~gone)

        def adopt() -> None:
            self._head_rate = head_rate

        return Outcome(state, int(gone.sum()), report, viscosity_reports, adopt)

    def _tidied(self, order: transfer.CellOrder) -> transfer.CellOrder:
        """Reseed, and put the particles in the order of their cells, so that neighbours are close in memory."""
        particles = self._particles
        if self.settings.reseed:
            inner = inner_cells((np.diff(order.start) > 0).reshape(self.grid.shape), self._walls.solid)
            done = reseed(
                particles, order, inner, self._walls, density=self.parameters.density, first_id=self._next_id,
                rng=self._rng,
            )  # fmt: skip
            particles = done.particles
            self._next_id += done.split
            if done.split or done.merged:
                order = transfer.sort_by_cell(particles.positions, self.grid)
        self._particles = particles.select(order.order)
        return transfer.CellOrder(np.arange(len(particles)), order.start)
