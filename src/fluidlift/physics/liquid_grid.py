"""The grid half of a liquid's substep: from particles to the new velocity on all faces near the liquid."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import InputRejected
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
from fluidlift.physics.no_bodies import NoBodies
from fluidlift.physics.outlet import hold_columns, outlet_heads, surface_heights, water_levels
from fluidlift.physics.pressure import PressureSystem, build_system, project, subtract_gradient
from fluidlift.physics.rigid import RigidBodies
from fluidlift.physics.surface_tension import surface_tension_jumps
from fluidlift.physics.surroundings import Surroundings
from fluidlift.seams import ParticleTransfer
from fluidlift.types import CellType, FaceVelocity, Particles, SolveReport, triple

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


class LiquidGrid:
    """What a liquid does on the grid within a substep: surface, viscosity, pressure, bodies, outlet.

    Args:
        surroundings: box, walls, inlet, parameters and settings.
        particles: at the start, outside of the bodies.
        transfer: between particles and grid.
        bodies: rigid ones, or none.
        forces: beside gravity.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        particles: Particles,
        *,
        transfer: ParticleTransfer,
        bodies: RigidBodies | NoBodies,
        forces: tuple[BodyForce, ...],
    ) -> None:
        s = self._surroundings = surroundings
        self.grid, self.parameters, self.settings = s.grid, s.parameters, s.settings
        self._walls, self._inlet = s.walls, s.inlet
        self._transfer, self._bodies, self._forces = transfer, bodies, forces
        self._region = open_region(triple(slice(0, n) for n in s.grid.shape), s.walls, s.capacity)
        self.solids = solid_shares(s.walls.signed_distance, s.grid)
        self._region_solids = self.solids.inside(self._region.box)
        self.head_rate: tuple[tuple[int, int, int], np.ndarray] | None = None
        """first cell of the region of the last substep, and there q / dt: the first guess of the pressure"""
        self._start_levels = self._levels(particles) if (s.walls.regions == CellType.OUTFLOW).any() else None

    @property
    def start_levels(self) -> np.ndarray | None:
        """Cells [nx,ny]: the water at the outlet at the start; None without an outlet."""
        return self._start_levels

    def state(self) -> dict[str, np.ndarray]:
        """The water levels at the outlet, and the pressure as a first guess."""
        own = {} if self._start_levels is None else {"start_levels": self._start_levels.copy()}
        if self.head_rate is not None:
            own |= {"head_rate": self.head_rate[1].copy(), "head_first": np.array(self.head_rate[0], np.int64)}
        return own

    def require_fit(self, state: dict[str, np.ndarray]) -> None:
        """Raise `InputRejected` for a state that is not one of this grid."""
        rate, first, levels = (state.get(name) for name in ("head_rate", "head_first", "start_levels"))
        if (levels is None) != (self._start_levels is None) or (
            levels is not None and levels.shape != self.grid.shape[:2]
        ):
            raise InputRejected("a simulation state with another outlet")
        if rate is not None:
            if first is None or rate.ndim != 3 or first.shape != (3,) or not (first >= 0).all():
                raise InputRejected("a simulation state of another grid", f"{self.grid.shape} cells")
            if (first + rate.shape > self.grid.shape).any() or not np.isfinite(rate).all():
                raise InputRejected("a simulation state of another grid", f"{self.grid.shape} cells")

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go to a state that fits."""
        rate, levels = state.get("head_rate"), state.get("start_levels")
        self.head_rate = None if rate is None else (triple(int(i) for i in state["head_first"]), np.array(rate))
        self._start_levels = None if levels is None else np.array(levels)

    def _levels(self, particles: Particles) -> np.ndarray:
        order = transfer.sort_by_cell(particles.positions, self.grid)
        levels = water_levels((np.diff(order.start) > 0).reshape(self.grid.shape), self._walls)
        surface = liquid_surface(particles.positions, self._volumes(particles), self.grid, order, self.solids)
        return surface_heights(levels, surface.distance, self.grid.spacing)

    def _volumes(self, particles: Particles) -> np.ndarray:
        """m^3 of each particle."""
        return (particles.masses / self.parameters.density).astype(np.float32)

    def look(self, positions: np.ndarray) -> ActiveRegion:
        """The region around the particles and the inlet."""
        box = region_around(positions, self.grid, self._inlet.cell_range if self._inlet.active else None)
        if box != self._region.box:
            self._region = open_region(box, self._walls, self._surroundings.capacity)
            self._region_solids = self.solids.inside(box)
        return self._region

    def _outlet_faces(self, walls: Walls) -> tuple[np.ndarray, ...] | None:
        """bool per component: faces of OUTFLOW cells, where their velocity is prescribed."""
        if not self.settings.prescribe_outflow:
            return None
        outflow = walls.regions == CellType.OUTFLOW
        return tuple(t & (o > 0) for t, o in zip(boundaries.touching_faces(outflow), walls.openings))

    def _impose(
        self, velocity: FaceVelocity, region: ActiveRegion, outlet: tuple[np.ndarray, ...] | None, time: float
    ) -> FaceVelocity:
        """Inflow, and outflow where it is prescribed."""
        velocity = self._inlet.impose(velocity, time, region.first)
        if outlet is None:
            return velocity
        speed = self.parameters.outflow_velocity * self._surroundings.mainstream
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

    def _layout(self, particles: Particles, region: ActiveRegion, order: transfer.CellOrder) -> Layout:
        """Which cells hold liquid, and where its surface lies."""
        grid, walls = region.grid, region.walls
        occupied = (np.diff(order.start) > 0).reshape(grid.shape)
        solids = solid_shares(walls.signed_distance, grid) if len(self._bodies) else self._region_solids
        surface = liquid_surface(
            particles.positions, self._volumes(particles), grid, order, solids,
            curved=self.parameters.surface_tension > 0,
        )  # fmt: skip
        holding = boundaries.liquid_cells(occupied, walls)
        own, distance = pressure_cells(holding, surface.distance, walls.openings, grid.spacing)
        # p = 0 in a sliver of open space above the bed would suck the liquid into it
        types = np.where((holding == CellType.FLUID) & walls.buried, holding, own)
        types = self._bodies.fill_films(types)
        films = (types == CellType.FLUID) & (own != CellType.FLUID)
        distance = np.where(films, np.minimum(distance, np.float32(-SPRAY_DEPTH * grid.spacing)), distance)
        wet = (types == CellType.FLUID) | (types == CellType.INFLOW) | ((types == CellType.OUTFLOW) & occupied)
        if self._inlet.comes_and_goes:  # cells that are inflow just now
            cells, inflow = self._inlet.emitter_cells(grid.shape, region.first), np.uint8(CellType.INFLOW)
            holding, types = np.where(cells, inflow, holding), np.where(cells, inflow, types)
            wet = wet | cells
        return Layout(surface, holding, types, distance, wet)

    def step(
        self, particles: Particles, region: ActiveRegion, order: transfer.CellOrder, dt: float, time: float
    ) -> GridStep:
        """From particles, which are in `order` in a region, to the new velocity on all faces near the liquid."""
        grid, walls, bodies = region.grid, region.walls, self._bodies
        carried, masses = self._transfer.particles_to_grid(particles, grid, order)
        layout = self._layout(particles, region, order)
        wet_faces, outlet = _wet_faces(layout.wet, walls), self._outlet_faces(walls)
        rate = self._last_rate(region)
        bodies.predict(dt, rate)
        solid = bodies.face_velocity()
        # a pull is held against the velocity that the step before ended with: with gravity, which the pressure is still
        # to balance, it would carry a part of the liquid's weight
        forced = carried
        for force in self._forces:
            forced = force.applied(forced, masses, region.box, dt, time)
        forced = add_gravity(forced, self.parameters.gravity, dt)
        velocity = self._impose(forced, region, outlet, time)
        known, system = self._known(layout, region, dt), self._system(layout, region, outlet)
        moving = _wet_faces(layout.wet | (layout.holding == CellType.FLUID), walls)
        pressed = self._pressed(velocity, system, rate, known, dt)
        eager = rate is not None and pressed is not velocity
        if eager and rate is not None:  # the pressure of the step before acts on bodies too
            bodies.coupling(system.unknown)
            bodies.apply_pressure(rate * dt)
            solid = bodies.face_velocity()
        new, viscosity_reports = self._surroundings.viscous(
            pressed, moving, region, dt, outlet, layout.distance, solid, bodies
        )
        if eager and rate is not None:
            bodies.apply_pressure(-rate * dt)
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
        velocity = self._impose(velocity, region, outlet, time)
        skin = (layout.holding == CellType.FLUID) & (layout.types == CellType.EMPTY)
        velocity = continue_velocity(velocity, carried, masses, wet_faces, skin, walls.openings)
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
        if self.head_rate is None:
            return None
        first, rate = self.head_rate
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
            coupling = self._bodies.coupling(system.unknown)
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


def _wet_faces(wet: np.ndarray, walls: Walls) -> Faces:
    """bool per component: open faces of wet cells."""
    x, y, z = (t & (o > 0) for t, o in zip(boundaries.touching_faces(wet), walls.openings))
    return x, y, z
