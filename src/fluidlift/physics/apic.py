"""The liquid: affine particle-in-cell with pressure projection (paper: "Presumed APIC Simulation").

One substep: fill the inlet; particles to grid; gravity; viscosity; pressure; continue the velocity into air and along
walls; grid to particles; move; correct crowding; collide; deform; remove what has left. A substep either completes
or leaves the state as it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.physics import boundaries, transfer
from fluidlift.physics.boundaries import Walls
from fluidlift.physics.crowding import fill_ratio, spreading
from fluidlift.physics.forces import add_gravity
from fluidlift.physics.numba_particles import ParticleWork
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
from fluidlift.physics.window import Window, moved_to, open_window, window_around
from fluidlift.seams import MoveRules
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles, SolveReport, Terrain

__all__ = ["EmitSource", "LiquidSimulator", "SimulationSettings", "StepReport"]


@dataclass(frozen=True)
class GridStep:
    """What a substep does on the grid."""

    velocity: FaceVelocity
    """m/s, continued into air and along walls"""
    system: PressureSystem
    head_rate: tuple[tuple[int, int, int], np.ndarray]
    """first cell of the window, and q / dt (m^2/s^2)"""
    report: SolveReport
    viscosity: tuple[SolveReport, ...]


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
        work: who does the particle half of a step; None: the CPU.

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
        work: ParticleWork | None = None,
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
        self._work = work or ParticleWork()
        self._head_rate: tuple[tuple[int, int, int], np.ndarray] | None = None
        """first cell of the window of the last substep, and there q / dt: the first guess of the pressure"""
        self._start_levels = self._levels_now() if (self._walls.regions == CellType.OUTFLOW).any() else None

    def state(self) -> dict[str, np.ndarray]:
        """See `ParticleSimulator.state`; also the water levels at the outlet and the pressure as a first guess."""
        own = {} if self._start_levels is None else {"start_levels": self._start_levels.copy()}
        if self._head_rate is not None:
            own |= {"head_rate": self._head_rate[1].copy(), "head_first": np.array(self._head_rate[0], np.int64)}
        return super().state() | own

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See `ParticleSimulator.restore`."""
        rate, first, levels = (state.get(name) for name in ("head_rate", "head_first", "start_levels"))
        if (levels is None) != (self._start_levels is None) or (
            levels is not None and levels.shape != self.grid.shape[:2]
        ):
            raise InputRejected("a simulation state with another outlet")
        if rate is not None:
            fits = rate.ndim == 3 and first is not None and first.shape == (3,) and (first >= 0).all()
            if not fits or (first + rate.shape > self.grid.shape).any() or not np.isfinite(rate).all():
                raise InputRejected("a simulation state of another grid", f"{self.grid.shape} cells")
        super().restore(state)
        self._head_rate = None if rate is None else (tuple(int(i) for i in first), np.array(rate))
        self._start_levels = None if levels is None else np.array(levels)

    def _levels_now(self) -> np.ndarray:
        occupied = np.diff(transfer.sort_by_cell(self._particles.positions, self.grid).start) > 0
        return water_levels(occupied.reshape(self.grid.shape), self._walls)

    def _look(self, positions: np.ndarray) -> Window:
        """The window around the particles and the inlet."""
        box = window_around(positions, self.grid, self._inlet.cell_range if self._inlet.active else None)
        if box != self._window.box:
            self._window = open_window(box, self._walls, self._capacity)
        return self._window

    def _outlet_faces(self, walls: Walls) -> tuple[np.ndarray, ...] | None:
        """bool per component: faces of OUTFLOW cells, where their velocity is prescribed."""
        if not self.settings.prescribe_outflow:
            return None
        outflow = walls.regions == CellType.OUTFLOW
        return tuple(t & (o > 0) for t, o in zip(boundaries.touching_faces(outflow), walls.openings))

    def _impose(self, velocity: FaceVelocity, window: Window, outlet: tuple[np.ndarray, ...] | None) -> FaceVelocity:
        """Inflow, and outflow where it is prescribed."""
        velocity = self._inlet.impose(velocity, self.time, window.first)
        if outlet is None:
            return velocity
        speed = self.parameters.outflow_velocity * self._mainstream
        return FaceVelocity(*(np.where(f, np.float32(s), c) for f, s, c in zip(outlet, speed, velocity.components)))

    def _known(self, wet: np.ndarray, window: Window, dt: float) -> np.ndarray | None:
        """q (m^2/s) of the columns of liquid that stand in the outlet, in cells of the window."""
        if self._start_levels is None or self.settings.prescribe_outflow:
            return None
        lowest = window.first[2]
        start = self._start_levels[window.box[:2]]
        start = np.where(start >= 0, np.maximum(start - lowest, 0), -1)
        heads = outlet_heads(water_levels(wet, window.walls), start, window.walls)
        return None if heads is None else heads * max(-self.parameters.gravity[2], 0.0) * dt

    def _grid_velocity(self, window: Window, order: transfer.CellOrder, dt: float) -> GridStep:
        """From particles to the new velocity on all faces near the liquid."""
        grid, walls = window.grid, window.walls
        velocity, _ = self._work.transfer.particles_to_grid(self._particles, grid, order)
        occupied = (np.diff(order.start) > 0).reshape(grid.shape)
        types = boundaries.liquid_cells(occupied, walls)
        wet = (types == CellType.FLUID) | (types == CellType.INFLOW) | ((types == CellType.OUTFLOW) & occupied)
        wet_faces, outlet = self._wet_faces(wet, walls), self._outlet_faces(walls)
        velocity = self._impose(add_gravity(velocity, self.parameters.gravity, dt), window, outlet)
        velocity, viscosity_reports = self._viscous(velocity, wet_faces, window, dt, outlet)
        # the walls have closed the sides of the box already
        system = build_system(types, walls.openings, grid, open_border=True)
        if outlet is not None:
            closed = [np.where(f, np.float32(0), w) for f, w in zip(outlet, system.weights)]
            system = replace(system, weight_x=closed[0], weight_y=closed[1], weight_z=closed[2])
        known = self._known(wet, window, dt)
        velocity, q, report, system = self._projected(velocity, system, window, dt, known)
        if known is not None:
            velocity = hold_columns(velocity, known, walls)
        velocity = self._impose(velocity, window, outlet)
        velocity = boundaries.slide_along_walls(boundaries.extrapolate(velocity, wet_faces), walls)
        return GridStep(velocity, system, (window.first, q / dt), report, viscosity_reports)

    def _projected(
        self, velocity: FaceVelocity, system: PressureSystem, window: Window, dt: float, known: np.ndarray | None
    ) -> tuple[FaceVelocity, np.ndarray, SolveReport, PressureSystem]:
        """Projection in which no wall sucks: wall cells whose pressure comes out negative are solved again as air.

        A projection alone holds liquid at walls that it would leave, because nothing may fill the gap (Batty et al.
        2007, section 5); a nappe would cling to its cliff. One correction stands for the full inequality p >= 0.
        """
        tolerance, initial = self.settings.pressure_tolerance, None
        if self._head_rate is not None:
            first, rate = self._head_rate
            initial = moved_to(rate, first, window.first, window.grid.shape) * dt
        new, q, report = project(velocity, system, tolerance=tolerance, initial=initial, known=known)
        weight = float(np.linalg.norm(self.parameters.gravity)) * self.grid.spacing * dt
        if not self.settings.separate_from_walls or weight == 0.0:
            return new, q, report, system
        sucked = system.unknown & window.wall_cells & (q < -0.1 * weight)
        if not sucked.any():
            return new, q, report, system
        system = replace(system, unknown=system.unknown & ~sucked)
        new, q, report = project(velocity, system, tolerance=tolerance, initial=q, known=known)
        return new, q, report, system

    def _substep(self, dt: float, number: int, *, last_attempt: bool) -> Outcome | None:
        walls = self._walls
        if not len(self._particles):
            return Outcome(self._particles, 0, SolveReport(True, 0, 0.0, "empty"), (), lambda: None)
        window = self._look(self._particles.positions)
        grid = window.grid
        order = transfer.sort_by_cell(self._particles.positions, grid)
        if number % TIDY_EVERY == 0:
            order = self._tidied(order, window)
        particles = self._particles
        step = self._grid_velocity(window, order, dt)
        velocities, affine = self._work.transfer.grid_to_particles(step.velocity, grid, particles.positions, order)
        moves, farthest = displacements(velocities, affine, dt)
        farthest /= grid.spacing
        if not farthest <= 3.0 * self.settings.courant:
            if not last_attempt:
                return None
            raise FluidliftError(
                f"Step {self._advances}, substep {number + 1}, t = {self.time:.4g} s: the simulation blew up (a "
                f"particle would cross {farthest:.3g} cells in {dt:.3g} s; pressure residual "
                f"{step.report.residual:.2g}). The state before it is kept. Use a smaller time_step, or check inflow "
                "velocity, terrain and viscosity."
            )
        if self.settings.spread_crowds:
            volumes = (particles.masses / self.parameters.density).astype(np.float32)
            ratio = fill_ratio(particles.positions, volumes, grid, order, window.capacity)
            spread = spreading(particles.positions, ratio, window.capacity, step.system, grid, order)
            moves = moves if spread is None else moves + spread
        keep = (1.0 - self.parameters.wall_damping) ** (dt / self.parameters.time_step)
        rules = MoveRules(dt, self.parameters.restitution, keep, self.settings.max_stretch)
        state = self._work.mover.moved(particles, moves, velocities, affine, walls, rules)
        gone = leaving(particles.positions, state.positions, walls, self._mainstream)
        if gone.any():
            state = transfer.select_particles(state, np.flatnonzero(~gone))

        def adopt() -> None:
            self._head_rate = step.head_rate

        return Outcome(state, int(gone.sum()), step.report, step.viscosity, adopt)

    def _tidied(self, order: transfer.CellOrder, window: Window) -> transfer.CellOrder:
        """Reseed, and put the particles in the order of their cells, so that neighbours are close in memory."""
        particles = self._particles
        if self.settings.reseed:
            inner = inner_cells((np.diff(order.start) > 0).reshape(window.grid.shape), window.walls.solid)
            done = reseed(
                particles, order, inner, self._walls, density=self.parameters.density, first_id=self._next_id,
                rng=self._rng,
            )  # fmt: skip
            particles = done.particles
            self._next_id += done.split
            if done.split or done.merged:
                order = transfer.sort_by_cell(particles.positions, window.grid)
        self._particles = transfer.select_particles(particles, order.order)
        return transfer.CellOrder(np.arange(len(particles)), order.start)
