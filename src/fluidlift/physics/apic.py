"""The liquid: affine particle-in-cell with pressure projection (paper: "Presumed APIC Simulation").

One substep: fill the inlet; particles to grid; gravity; viscosity; pressure; continue the velocity into air and along
walls; grid to particles; move; correct crowding; collide; deform; remove what has left. A substep either completes
or leaves the state as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.physics import boundaries, transfer
from fluidlift.physics.boundaries import Walls
from fluidlift.physics.crowding import fill_ratio, spreading
from fluidlift.physics.forces import add_gravity
from fluidlift.physics.free_surface import (
    SPRAY_DEPTH,
    Faces,
    LiquidSurface,
    continue_velocity,
    liquid_surface,
    pressure_cells,
    solid_shares,
    surface_gaps,
)
from fluidlift.physics.numba_particles import ParticleWork
from fluidlift.physics.outlet import hold_columns, outlet_heads, surface_heights, water_levels
from fluidlift.physics.pressure import PressureSystem, build_system, project, subtract_gradient
from fluidlift.physics.reseed import inner_cells, reseed
from fluidlift.physics.rigid import RigidBodies, RigidBody
from fluidlift.physics.stepping import (
    TIDY_EVERY,
    EmitSource,
    Outcome,
    ParticleSimulator,
    SimulationSettings,
    StepReport,
)
from fluidlift.physics.surface_tension import capillary_time_step, surface_tension_jumps
from fluidlift.physics.travel import displacements, leaving
from fluidlift.physics.window import Window, moved_to, open_window, window_around
from fluidlift.seams import MoveRules
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles, SolveReport, Terrain

__all__ = ["EmitSource", "LiquidSimulator", "SimulationSettings", "StepReport"]


STRONG = 0.05
"""dt nu / h^2 above which the pressure of the step before acts before viscosity does"""


@dataclass(frozen=True)
class GridStep:
    """What a substep does on the grid."""

    velocity: FaceVelocity
    """m/s, continued into air and along walls"""
    system: PressureSystem
    holding: np.ndarray
    """see `Layout`"""
    head_rate: tuple[tuple[int, int, int], np.ndarray]
    """first cell of the window, and q / dt (m^2/s^2)"""
    report: SolveReport
    viscosity: tuple[SolveReport, ...]


@dataclass(frozen=True)
class Layout:
    """Where the liquid is in a substep."""

    surface: LiquidSurface
    holding: np.ndarray
    """u8 [nx,ny,nz]: cell types by the particles"""
    types: np.ndarray
    """u8 [nx,ny,nz]: FLUID where there is a pressure to solve for"""
    distance: Float[np.ndarray, "nx ny nz"]
    """m, negative in all FLUID cells"""
    wet: Bool[np.ndarray, "nx ny nz"]


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
        bodies: rigid bodies, at rest, animated or free; particles inside them at the start are removed.

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
        bodies: Sequence[RigidBody] = (),
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
        self._bodies: RigidBodies | None = None
        if bodies:
            self._bodies = RigidBodies(bodies, self._walls, density=parameters.density, gravity=gravity)
            self._particles = self._particles.select(~self._bodies.inside(self._particles.positions))
        self._solids = solid_shares(self._walls.signed_distance, grid)
        self._window_solids = self._solids.inside(self._window.box)
        self._head_rate: tuple[tuple[int, int, int], np.ndarray] | None = None
        """first cell of the window of the last substep, and there q / dt: the first guess of the pressure"""
        self._start_levels = self._levels_now() if (self._walls.regions == CellType.OUTFLOW).any() else None

    def state(self) -> dict[str, np.ndarray]:
        """See `ParticleSimulator.state`; also the water levels at the outlet and the pressure as a first guess."""
        own = {} if self._start_levels is None else {"start_levels": self._start_levels.copy()}
        if self._head_rate is not None:
            own |= {"head_rate": self._head_rate[1].copy(), "head_first": np.array(self._head_rate[0], np.int64)}
        if self._bodies is not None:
            own |= {f"bodies.{name}": value for name, value in self._bodies.state().items()}
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
        before = super().state()
        super().restore(state)
        if self._bodies is not None:
            try:
                prefix = "bodies."
                self._bodies.restore({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
            except InputRejected:
                super().restore(before)
                raise
        self._head_rate = None if rate is None else (tuple(int(i) for i in first), np.array(rate))
        self._start_levels = None if levels is None else np.array(levels)

    @property
    def bodies(self) -> RigidBodies | None:
        """The rigid bodies, where there are any."""
        return self._bodies

    def _max_speed(self) -> float:
        own = super()._max_speed()
        return own if self._bodies is None else max(own, self._bodies.max_speed(self.parameters.time_step))

    def _levels_now(self) -> np.ndarray:
        order = transfer.sort_by_cell(self._particles.positions, self.grid)
        levels = water_levels((np.diff(order.start) > 0).reshape(self.grid.shape), self._walls)
        surface = liquid_surface(self._particles.positions, self._volumes(), self.grid, order, self._solids)
        return surface_heights(levels, surface.distance, self.grid.spacing)

    def _volumes(self) -> np.ndarray:
        """m^3 of each particle."""
        return (self._particles.masses / self.parameters.density).astype(np.float32)

    def _substep_length(self, remaining: float) -> float:
        """See `ParticleSimulator`; also within the limit of surface tension."""
        longest = capillary_time_step(self.parameters.density, self.parameters.surface_tension, self.grid.spacing)
        step = super()._substep_length(remaining)
        return step if step <= longest else remaining / np.ceil(remaining / longest - 1e-9)

    def _look(self, positions: np.ndarray) -> Window:
        """The window around the particles and the inlet."""
        box = window_around(positions, self.grid, self._inlet.cell_range if self._inlet.active else None)
        if box != self._window.box:
            self._window = open_window(box, self._walls, self._capacity)
            self._window_solids = self._solids.inside(box)
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

    def _known(self, layout: Layout, window: Window, dt: float) -> np.ndarray | None:
        """q (m^2/s) of the columns of liquid that stand in the outlet, in cells of the window."""
        if self._start_levels is None or self.settings.prescribe_outflow:
            return None
        lowest = window.first[2]
        start = self._start_levels[window.box[:2]]
        start = np.where(start >= 0, np.maximum(start - lowest, 0.0), -1.0)
        levels = water_levels(layout.wet, window.walls)
        levels = surface_heights(levels, layout.surface.distance, self.grid.spacing)
        heads = outlet_heads(levels, start, window.walls)
        return None if heads is None else heads * max(-self.parameters.gravity[2], 0.0) * dt

    def _layout(self, window: Window, order: transfer.CellOrder) -> Layout:
        """Which cells hold liquid, and where its surface lies."""
        grid, walls = window.grid, window.walls
        occupied = (np.diff(order.start) > 0).reshape(grid.shape)
        solids = self._window_solids if self._bodies is None else solid_shares(walls.signed_distance, grid)
        surface = liquid_surface(
            self._particles.positions, self._volumes(), grid, order, solids,
            curved=self.parameters.surface_tension > 0,
        )  # fmt: skip
        holding = boundaries.liquid_cells(occupied, walls)
        own, distance = pressure_cells(holding, surface.distance, walls.openings, grid.spacing)
        # p = 0 in a sliver of open space above the bed would suck the liquid into it
        types = np.where((holding == CellType.FLUID) & walls.buried, holding, own)
        if self._bodies is not None:
            types = self._bodies.fill_films(types)
        films = (types == CellType.FLUID) & (own != CellType.FLUID)
        distance = np.where(films, np.minimum(distance, np.float32(-SPRAY_DEPTH * grid.spacing)), distance)
        wet = (types == CellType.FLUID) | (types == CellType.INFLOW) | ((types == CellType.OUTFLOW) & occupied)
        return Layout(surface, holding, types, distance, wet)

    def _grid_velocity(self, window: Window, order: transfer.CellOrder, dt: float) -> GridStep:
        """From particles to the new velocity on all faces near the liquid."""
        grid, walls, bodies = window.grid, window.walls, self._bodies
        carried, masses = self._work.transfer.particles_to_grid(self._particles, grid, order)
        layout = self._layout(window, order)
        wet_faces, outlet = self._wet_faces(layout.wet, walls), self._outlet_faces(walls)
        rate, solid = self._last_rate(window), None
        if bodies is not None:
            bodies.predict(dt, rate)
            solid = bodies.face_velocity()
        velocity = self._impose(add_gravity(carried, self.parameters.gravity, dt), window, outlet)
        known, system = self._known(layout, window, dt), self._system(layout, window, outlet)
        moving = self._wet_faces(layout.wet | (layout.holding == CellType.FLUID), walls)
        pressed = self._pressed(velocity, system, rate, known, dt)
        new, viscosity_reports = self._viscous(pressed, moving, window, dt, outlet, layout.distance, solid)
        if viscosity_reports:
            velocity = FaceVelocity(
                *(v + (n - p) for v, n, p in zip(velocity.components, new.components, pressed.components))
            )
        velocity, q, report, system = self._projected(
            velocity, system, window, dt, None if rate is None else rate * dt,
            known=known, jumps=self._jumps(layout, dt), solid_velocity=solid,
        )  # fmt: skip
        if known is not None:
            weight = max(-self.parameters.gravity[2], 0.0) * grid.spacing * dt
            velocity = hold_columns(velocity, known, walls, weight=weight)
        velocity = self._impose(velocity, window, outlet)
        skin = (layout.holding == CellType.FLUID) & (layout.types == CellType.EMPTY)
        velocity = continue_velocity(velocity, carried, masses, wet_faces, skin, walls.openings)
        if bodies is None:
            velocity = boundaries.slide_along_walls(velocity, walls)
        else:
            bodies.apply_pressure(q)
            velocity = bodies.slide(velocity)
        velocity = self._held_by_walls(velocity, walls, solid, dt)
        return GridStep(velocity, system, layout.holding, (window.first, q / dt), report, viscosity_reports)

    def _pressed(
        self, velocity: FaceVelocity, system: PressureSystem, rate: np.ndarray | None, known: np.ndarray | None,
        dt: float,
    ) -> FaceVelocity:  # fmt: skip
        """The velocity with the pressure of the step before already at work, where viscosity is strong.

        Viscosity acts on this one, and pressure is solved in full afterwards (incremental pressure correction, van Kan
        1986): with pressure only after the viscous step, a thread under tension stretches up to 1.5 times too fast.
        """
        number = self.parameters.kinematic_viscosity * dt / self.grid.spacing**2
        if rate is None or number < STRONG:
            return velocity
        return subtract_gradient(velocity, system, rate * dt, known)

    def _held_by_walls(
        self, velocity: FaceVelocity, walls: Walls, solid: FaceVelocity | None, dt: float
    ) -> FaceVelocity:
        """The velocity inside walls drawn towards that of the wall, as far as viscosity reaches within the step.

        Particles beside a wall see the velocity continued into it: free slip there would undo what the viscous step
        did at the wall.
        """
        reach = min(1.0, float(np.sqrt(self.parameters.kinematic_viscosity * dt)) / self.grid.spacing)
        taken = np.float32(self.parameters.wall_damping * reach)
        if taken < 1e-3:
            return velocity
        wall = (np.float32(0),) * 3 if solid is None else solid.components
        return FaceVelocity(
            *(np.where(o == 0, c + taken * (w - c), c) for c, w, o in zip(velocity.components, wall, walls.openings))
        )

    def _last_rate(self, window: Window) -> np.ndarray | None:
        """q / dt (m^2/s^2) of the substep before, on this window."""
        if self._head_rate is None:
            return None
        first, rate = self._head_rate
        return moved_to(rate, first, window.first, window.grid.shape)

    def _system(self, layout: Layout, window: Window, outlet: tuple[np.ndarray, ...] | None) -> PressureSystem:
        gaps = surface_gaps(layout.distance, layout.types)
        # the walls have closed the sides of the box already
        system = build_system(layout.types, window.walls.openings, window.grid, open_border=True, gaps=gaps)
        if outlet is None:
            return system
        closed = [np.where(f, np.float32(0), w) for f, w in zip(outlet, system.weights)]
        return replace(system, weight_x=closed[0], weight_y=closed[1], weight_z=closed[2])

    def _jumps(self, layout: Layout, dt: float) -> Faces | None:
        """Of q at the surface, by surface tension."""
        if self.parameters.surface_tension == 0:
            return None
        strength = self.parameters.surface_tension * dt / self.parameters.density
        return surface_tension_jumps(layout.surface, layout.types, strength)

    def _projected(
        self, velocity: FaceVelocity, system: PressureSystem, window: Window, dt: float, initial: np.ndarray | None,
        **given: Any,
    ) -> tuple[FaceVelocity, np.ndarray, SolveReport, PressureSystem]:  # fmt: skip
        """Projection in which no wall sucks: wall cells whose pressure comes out negative are solved again as air.

        A projection alone holds liquid at walls that it would leave, because nothing may fill the gap (Batty et al.
        2007, section 5); a nappe would cling to its cliff. One correction stands for the full inequality p >= 0.
        `given` goes to `pressure.project`.
        """

        def solved(system: PressureSystem, initial: np.ndarray | None) -> tuple[FaceVelocity, np.ndarray, SolveReport]:
            # coupling also tells the bodies which cells press on them: it has to follow the system
            coupling = () if self._bodies is None else self._bodies.coupling(system.unknown)
            tolerance = self.settings.pressure_tolerance
            return project(velocity, system, tolerance=tolerance, initial=initial, low_rank=coupling, **given)

        new, q, report = solved(system, initial)
        weight = float(np.linalg.norm(self.parameters.gravity)) * self.grid.spacing * dt
        if not self.settings.separate_from_walls or weight == 0.0:
            return new, q, report, system
        sucked = system.unknown & window.wall_cells & (q < -0.1 * weight)
        if not sucked.any():
            return new, q, report, system
        system = replace(system, unknown=system.unknown & ~sucked)
        return *solved(system, q), system

    def _substep(self, dt: float, number: int, *, last_attempt: bool) -> Outcome | None:
        walls, bodies = self._walls, self._bodies
        before = None if bodies is None else bodies.state()
        if not len(self._particles):
            if bodies is not None:
                bodies.predict(dt)
                bodies.advance()
            return Outcome(self._particles, 0, SolveReport(True, 0, 0.0, "empty"), (), lambda: None)
        window = self._look(self._particles.positions)
        if bodies is not None:
            window = bodies.enter(window)
        grid = window.grid
        order = transfer.sort_by_cell(self._particles.positions, grid)
        if number % TIDY_EVERY == 0:
            order = self._tidied(order, window)
        particles = self._particles
        step = self._grid_velocity(window, order, dt)
        velocities, affine = self._work.transfer.grid_to_particles(step.velocity, grid, particles.positions, order)
        self._carry_inlet(velocities, affine)
        moves, farthest = displacements(velocities, affine, dt)
        farthest /= grid.spacing
        if not farthest <= 3.0 * self.settings.courant:
            if bodies is not None:
                bodies.restore(before)
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
            # the skin of the liquid counts here, and p = 0 lies outside all cells that hold particles
            held = build_system(step.holding, window.walls.openings, grid, open_border=True)
            spread = spreading(particles.positions, ratio, window.capacity, held, grid, order)
            moves = moves if spread is None else moves + spread
        keep = (1.0 - self.parameters.wall_damping) ** (dt / self.parameters.time_step)
        rules = MoveRules(dt, self.parameters.restitution, keep, self.settings.max_stretch)
        state = self._work.mover.moved(particles, moves, velocities, affine, walls, rules)
        gone = leaving(particles.positions, state.positions, walls, self._mainstream)
        if bodies is not None:
            bodies.advance()
            gone |= bodies.push_out(state.positions, state.velocities, tangential_share=keep)
        if gone.any():
            state = transfer.select_particles(state, np.flatnonzero(~gone))

        def adopt() -> None:
            self._head_rate = step.head_rate

        return Outcome(state, int(gone.sum()), step.report, step.viscosity, adopt)

    def _carry_inlet(self, velocities: np.ndarray, affine: np.ndarray) -> None:
        """Particles in INFLOW cells move as prescribed, in place: walls beside the inlet would hold back its rim."""
        if not self._inlet.active:
            return
        positions = self._particles.positions
        inside = np.flatnonzero(self._inlet.inside(positions))
        velocities[inside] = self._inlet.velocity(positions[inside], self.time)
        affine[inside] = 0.0

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
