"""The grid half of a liquid's substep: from particles to the new velocity on all faces near the liquid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.physics import boundaries, transfer
from fluidlift.physics.active_region import ActiveRegion, moved_to, open_region, region_around
from fluidlift.physics.boundaries import Walls
from fluidlift.physics.face_clearance import face_clearance
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
from fluidlift.physics.guidance import BodyForce
from fluidlift.physics.numba_particles import ParticleWork
from fluidlift.physics.outlet import hold_columns, outlet_heads, surface_heights, water_levels
from fluidlift.physics.pressure import PressureSystem, build_system, project, subtract_gradient
from fluidlift.physics.rigid import RigidBodies, RigidBody
from fluidlift.physics.stepping import ParticleSimulator
from fluidlift.physics.surface_tension import capillary_time_step, surface_tension_jumps
from fluidlift.types import CellType, FaceVelocity, SolveReport

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
    """first cell of the region, and q / dt (m^2/s^2)"""
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


class LiquidGrid(ParticleSimulator):
    """What `apic.LiquidSimulator` does on the grid: surface, viscosity, pressure, bodies, outlet."""

    _forces: tuple[BodyForce, ...]

    def _prepare_grid(self, work: ParticleWork, bodies: Sequence[RigidBody]) -> None:
        """Everything below needs this once, after the particles are there."""
        self._work = work
        self._bodies: RigidBodies | None = None
        if bodies:
            gravity = np.asarray(self.parameters.gravity)
            self._bodies = RigidBodies(bodies, self._walls, density=self.parameters.density, gravity=gravity)
            self._particles = self._particles.select(~self._bodies.inside(self._particles.positions))
        self._solids = solid_shares(self._walls.signed_distance, self.grid)
        self._region_solids = self._solids.inside(self._region.box)
        self._head_rate: tuple[tuple[int, int, int], np.ndarray] | None = None
        """first cell of the region of the last substep, and there q / dt: the first guess of the pressure"""
        self._start_levels = self._levels_now() if (self._walls.regions == CellType.OUTFLOW).any() else None

    def _levels_now(self) -> np.ndarray:
        order = transfer.sort_by_cell(self._particles.positions, self.grid)
        levels = water_levels((np.diff(order.start) > 0).reshape(self.grid.shape), self._walls)
        surface = liquid_surface(self._particles.positions, self._volumes(), self.grid, order, self._solids)
        return surface_heights(levels, surface.distance, self.grid.spacing)

    def _volumes(self) -> np.ndarray:
        """m^3 of each particle."""
        return (self._particles.masses / self.parameters.density).astype(np.float32)

    def _speed_gain(self) -> float:
        """See `ParticleSimulator`."""
        return super()._speed_gain() + sum(force.largest for force in self._forces)

    def _substep_length(self, remaining: float) -> float:
        """See `ParticleSimulator`; also within the limit of surface tension."""
        longest = capillary_time_step(self.parameters.density, self.parameters.surface_tension, self.grid.spacing)
        step = super()._substep_length(remaining)
        return step if step <= longest else remaining / np.ceil(remaining / longest - 1e-9)

    def _look(self, positions: np.ndarray) -> ActiveRegion:
        """The region around the particles and the inlet."""
        box = region_around(positions, self.grid, self._inlet.cell_range if self._inlet.active else None)
        if box != self._region.box:
            self._region = open_region(box, self._walls, self._capacity)
            self._region_solids = self._solids.inside(box)
        return self._region

    def _outlet_faces(self, walls: Walls) -> tuple[np.ndarray, ...] | None:
        """bool per component: faces of OUTFLOW cells, where their velocity is prescribed."""
        if not self.settings.prescribe_outflow:
            return None
        outflow = walls.regions == CellType.OUTFLOW
        return tuple(t & (o > 0) for t, o in zip(boundaries.touching_faces(outflow), walls.openings))

    def _impose(
        self, velocity: FaceVelocity, region: ActiveRegion, outlet: tuple[np.ndarray, ...] | None
    ) -> FaceVelocity:
        """Inflow, and outflow where it is prescribed."""
        velocity = self._inlet.impose(velocity, self.time, region.first)
        if outlet is None:
            return velocity
        speed = self.parameters.outflow_velocity * self._mainstream
        return FaceVelocity(*(np.where(f, np.float32(s), c) for f, s, c in zip(outlet, speed, velocity.components)))

    def _known(self, layout: Layout, region: ActiveRegion, dt: float) -> np.ndarray | None:
        """q (m^2/s) of the columns of liquid that stand in the outlet, in cells of the region."""
        if self._start_levels is None or self.settings.prescribe_outflow:
            return None
        lowest = region.first[2]
        start = self._start_levels[region.box[:2]]
        start = np.where(start >= 0, np.maximum(start - lowest, 0.0), -1.0)
        levels = water_levels(layout.wet, region.walls)
        levels = surface_heights(levels, layout.surface.distance, self.grid.spacing)
        heads = outlet_heads(levels, start, region.walls)
        return None if heads is None else heads * max(-self.parameters.gravity[2], 0.0) * dt

    def _layout(self, region: ActiveRegion, order: transfer.CellOrder) -> Layout:
        """Which cells hold liquid, and where its surface lies."""
        grid, walls = region.grid, region.walls
        occupied = (np.diff(order.start) > 0).reshape(grid.shape)
        solids = self._region_solids if self._bodies is None else solid_shares(walls.signed_distance, grid)
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

    def _grid_velocity(self, region: ActiveRegion, order: transfer.CellOrder, dt: float) -> GridStep:
        """From particles to the new velocity on all faces near the liquid."""
        grid, walls, bodies = region.grid, region.walls, self._bodies
        carried, masses = self._work.transfer.particles_to_grid(self._particles, grid, order)
        layout = self._layout(region, order)
        wet_faces, outlet = self._wet_faces(layout.wet, walls), self._outlet_faces(walls)
        rate, solid = self._last_rate(region), None
        if bodies is not None:
            bodies.predict(dt, rate)
            solid = bodies.face_velocity()
        forced = add_gravity(carried, self.parameters.gravity, dt)
        for force in self._forces:
            forced = force.applied(forced, masses, region.box, dt)
        velocity = self._impose(forced, region, outlet)
        known, system = self._known(layout, region, dt), self._system(layout, region, outlet)
        moving = self._wet_faces(layout.wet | (layout.holding == CellType.FLUID), walls)
        pressed = self._pressed(velocity, system, rate, known, dt)
        before = None if rate is None or pressed is velocity else rate * dt
        if bodies is not None and before is not None:  # the pressure of the step before acts on bodies too
            bodies.coupling(system.unknown)
            bodies.apply_pressure(before)
            solid = bodies.face_velocity()
        new, viscosity_reports = self._viscous(pressed, moving, region, dt, outlet, layout.distance, solid, bodies)
        if bodies is not None:
            if before is not None:
                bodies.apply_pressure(-before)
            solid = bodies.face_velocity()
        if viscosity_reports:
            velocity = self._dragged(velocity, pressed, new, walls, dt)
        velocity, q, report, system = self._projected(
            velocity, system, region, dt, None if rate is None else rate * dt,
            known=known, jumps=self._jumps(layout, dt), solid_velocity=solid,
        )  # fmt: skip
        if known is not None:
            weight = max(-self.parameters.gravity[2], 0.0) * grid.spacing * dt
            velocity = hold_columns(velocity, known, walls, weight=weight)
        velocity = self._impose(velocity, region, outlet)
        skin = (layout.holding == CellType.FLUID) & (layout.types == CellType.EMPTY)
        velocity = continue_velocity(velocity, carried, masses, wet_faces, skin, walls.openings)
        if bodies is None:
            velocity = boundaries.slide_along_walls(velocity, walls)
        else:
            bodies.apply_pressure(q)
            velocity = bodies.slide(velocity)
        velocity = self._held_by_walls(velocity, walls, solid, dt)
        return GridStep(velocity, system, layout.holding, (region.first, q / dt), report, viscosity_reports)

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

    def _dragged(
        self, velocity: FaceVelocity, pressed: FaceVelocity, new: FaceVelocity, walls: Walls, dt: float
    ) -> FaceVelocity:
        """The velocity with what viscosity changed of the `pressed` one.

        Faces whose centre lies in a solid that drags take the viscous velocity alone: no liquid moves there, and
        handing the old pressure's gradient back would let pressure pile up in the pockets behind them, step by step.
        """
        both = [v + (n - p) for v, n, p in zip(velocity.components, new.components, pressed.components)]
        if self.parameters.wall_damping == 0:
            return FaceVelocity(*both)
        out = []
        for a, clearance in enumerate(face_clearance(walls.signed_distance)):
            buried = (clearance <= 0) & (walls.openings[a] > 0)
            out.append(np.where(buried, new.components[a] + np.float32(dt * self.parameters.gravity[a]), both[a]))
        return FaceVelocity(*out)

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

    def _last_rate(self, region: ActiveRegion) -> np.ndarray | None:
        """q / dt (m^2/s^2) of the substep before, on this region."""
        if self._head_rate is None:
            return None
        first, rate = self._head_rate
        return moved_to(rate, first, region.first, region.grid.shape)

    def _system(self, layout: Layout, region: ActiveRegion, outlet: tuple[np.ndarray, ...] | None) -> PressureSystem:
        gaps = surface_gaps(layout.distance, layout.types)
        # the walls have closed the sides of the box already
        system = build_system(layout.types, region.walls.openings, region.grid, open_border=True, gaps=gaps)
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
        self, velocity: FaceVelocity, system: PressureSystem, region: ActiveRegion, dt: float,
        initial: np.ndarray | None, **given: Any,
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
        sucked = system.unknown & region.wall_cells & (q < -0.1 * weight)
        if not sucked.any():
            return new, q, report, system
        system = replace(system, unknown=system.unknown & ~sucked)
        return *solved(system, q), system
