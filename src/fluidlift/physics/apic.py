"""The liquid: affine particle-in-cell with pressure projection (paper: "Presumed APIC Simulation").

One substep: fill the inlet; particles to grid; gravity; viscosity; pressure; continue the velocity into air and along
walls; grid to particles; move; correct crowding; collide; deform; remove what has left. A substep either completes
or leaves the state as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from fluidlift.errors import FluidliftError, require
from fluidlift.numerics.sampling import sample_centers
from fluidlift.numerics.signed_distance import push_outside
from fluidlift.physics import boundaries, transfer
from fluidlift.physics.crowding import cell_capacity, fill_ratio, spreading
from fluidlift.physics.deform import updated_deformation
from fluidlift.physics.forces import add_gravity
from fluidlift.physics.inlet import Inlet
from fluidlift.physics.outlet import column_heads, hold_columns
from fluidlift.physics.pressure import PressureSystem, build_system, project
from fluidlift.physics.viscosity import diffuse
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles, SolveReport, Terrain

EmitSource = Callable[[np.ndarray, float], np.ndarray]
"""(positions [n,3] m, time s) -> index of the rest Gaussian that lends each new particle its look"""


@dataclass(frozen=True)
class SimulationSettings:
    """Numerical choices, independent of the fluid."""

    particles_per_cell: int = 8
    """of the inflow; its cube root is rounded"""
    courant: float = 1.0
    """cells that the fastest particle may cross in a substep"""
    pressure_tolerance: float = 1e-5
    viscosity_tolerance: float = 1e-5
    max_substeps: int = 1000
    """per call of `advance`"""
    max_stretch: float = 4.0
    """of the deformation of a particle"""
    spread_crowds: bool = True
    """correct clumps of particles"""
    prescribe_outflow: bool = False
    """True: the outlet's faces move with `outflow_velocity` along the mainstream; False: free outflow"""


@dataclass(frozen=True)
class StepReport:
    """What a call of `advance` did."""

    duration: float
    """s"""
    substeps: int
    max_speed: float
    """m/s, of the particles at the end"""
    volume: float
    """m^3 of liquid: sum of the particles' mass / density"""
    wet_volume: float
    """m^3 of the cells that hold particles, cut by the terrain only in whole cells"""
    pressure: tuple[SolveReport, ...]
    viscosity: tuple[SolveReport, ...]
    n_particles: int
    emitted: int
    removed: int
    retries: int
    """substeps that had to be halved"""


class LiquidSimulator:
    """A body of liquid on a terrain, with an inlet and an outlet.

    The sides of the box are frictionless walls, except in INFLOW and OUTFLOW cells and on top (against gravity),
    where particles that leave are removed. The terrain's signed distance decides what is solid.

    Outlet: particles flow freely and are removed when they leave the box there, or when they leave the OUTFLOW cells
    along the mainstream. Columns of liquid that stand on the ground inside OUTFLOW cells keep their hydrostatic
    pressure (see `physics.outlet`). `parameters.outflow_velocity` is used only with `settings.prescribe_outflow`.

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
        require(terrain.grid == grid, "a terrain on another grid", "the grid of the simulation")
        require(cell_types.shape == grid.shape, f"cell types {cell_types.shape}", str(grid.shape))
        for name in ("positions", "velocities", "affine", "deformation"):
            require(bool(np.isfinite(getattr(particles, name)).all()), f"{name} that are not finite")
        self.grid, self.parameters, self.time = grid, parameters, 0.0
        self.settings = replace(settings or SimulationSettings(), particles_per_cell=particles_per_cell)
        self._rng = np.random.default_rng(seed)
        gravity = np.asarray(parameters.gravity)
        open_sides = np.zeros((3, 2), bool)
        if gravity.any():
            top = int(np.abs(gravity).argmax())
            open_sides[top, int(gravity[top] < 0)] = True
        self._walls = boundaries.build_walls(terrain, cell_types, open_sides)
        self._capacity = cell_capacity(terrain.signed_distance, grid)
        self._mainstream = np.asarray(terrain.mainstream, np.float64)
        self._inlet = Inlet(self._walls, parameters, inflow_profile, seed, particles_per_cell)
        self._outlet_faces = self._faces_between_liquid_and_outlet() if self.settings.prescribe_outflow else None
        self._head_rate: np.ndarray | None = None
        self._particles = self._prepared(particles)
        self._next_id = int(particles.ids.max()) + 1 if len(particles) else 0
        self._emit_source = emit_source or self._nearest_source(particles)
        self._advances = 0

    @property
    def particles(self) -> Particles:
        """The present state, in the order of the ids."""
        return self._particles.select(np.argsort(self._particles.ids, kind="stable"))

    def advance(self, duration: float) -> StepReport:
        """Simulate `duration` seconds in substeps of at most `parameters.time_step`.

        Raises:
            FluidliftError: the simulation blew up or needs too many substeps; the state is that of the last good one.
            ValueError: a duration that is not positive.
        """
        require(np.isfinite(duration) and duration > 0, f"duration {duration}", "positive seconds")
        self._advances += 1
        end = self.time + duration
        substeps = emitted = removed = retries = 0
        pressure: list[SolveReport] = []
        viscosity: list[SolveReport] = []
        while end - self.time > 1e-9 * duration:
            if substeps >= self.settings.max_substeps:
                raise FluidliftError(
                    f"Step {self._advances}: {substeps} substeps reached t = {self.time:.4g} s of {end:.4g} s; the "
                    f"fastest particle moves at {self._max_speed():.3g} m/s. Use a coarser grid or check the velocities."
                )
            emitted += self._fill_inlet()
            dt = self._substep_length(end - self.time)
            for attempt in range(7):
                outcome = self._substep(dt, substeps, last_attempt=attempt == 6)
                if outcome is not None:
                    break
                dt *= 0.5
                retries += 1
            state, pressure_report, viscosity_reports, gone = outcome
            self._particles = state
            self._inlet.travel(dt)
            self.time += dt
            substeps += 1
            removed += gone
            pressure.append(pressure_report)
            viscosity.extend(viscosity_reports)
        self.time = end
        return StepReport(
            duration, substeps, self._max_speed(), self.volume, self._wet_volume(), tuple(pressure), tuple(viscosity),
            len(self._particles), emitted, removed, retries,
        )  # fmt: skip

    @property
    def volume(self) -> float:
        """m^3 of liquid in the box."""
        return float(self._particles.masses.sum(dtype=np.float64)) / self.parameters.density

    def _wet_volume(self) -> float:
        cells = np.clip(self.grid.cell_of(self._particles.positions), 0, np.asarray(self.grid.shape) - 1)
        return len(np.unique(np.ravel_multi_index(cells.T, self.grid.shape))) * self.grid.spacing**3

    def _max_speed(self) -> float:
        v = self._particles.velocities
        return float(np.sqrt(np.einsum("ni,ni->n", v, v).max(initial=0.0)))

    def _substep_length(self, remaining: float) -> float:
        """Equal substeps within the Courant limit, gravity's gain of speed included."""
        longest = min(self.parameters.time_step, remaining)
        gain = float(np.linalg.norm(self.parameters.gravity))
        # (speed + gain dt) dt <= courant h
        reach, speed = self.settings.courant * self.grid.spacing, self._max_speed()
        limit = 2.0 * reach / (speed + np.sqrt(speed**2 + 4.0 * gain * reach)) if speed + gain > 0 else np.inf
        return remaining / np.ceil(remaining / min(longest, limit) - 1e-9)

    def _prepared(self, particles: Particles) -> Particles:
        """Particles inside the box and outside the solid, with the mass of the space around them."""
        grid = self.grid
        clear = boundaries.CLEARANCE * grid.spacing
        positions = np.clip(particles.positions, grid.low + clear, grid.high - clear)
        positions, inside = push_outside(positions, self._walls.signed_distance, grid, clear)
        inside |= ~grid.contains(particles.positions, -grid.spacing) | ~grid.contains(positions)
        kept = replace(particles, positions=positions).select(~inside)
        if not len(kept):
            return kept
        order = transfer.sort_by_cell(kept.positions, grid)
        ones = np.ones(len(kept), np.float32)
        crowd = sample_centers(transfer.deposit_to_cells(kept.positions, ones, grid, order), grid, kept.positions)
        capacity = np.maximum(sample_centers(self._capacity, grid, kept.positions), 0.25)
        per_cell = crowd / capacity
        volumes = grid.spacing**3 / np.maximum(per_cell, np.median(per_cell))
        as_float = {n: np.ascontiguousarray(getattr(kept, n), np.float32) for n in ("velocities", "affine")}
        return replace(
            kept,
            masses=(self.parameters.density * volumes).astype(np.float32),
            deformation=np.ascontiguousarray(kept.deformation, np.float32),
            **as_float,
        )

    def _nearest_source(self, particles: Particles) -> EmitSource:
        if not len(particles):
            return lambda positions, time: np.zeros(len(positions), np.int64)
        tree, source = cKDTree(particles.positions), particles.source.copy()
        return lambda positions, time: source[tree.query(positions)[1]]

    def _fill_inlet(self) -> int:
        """Keep the INFLOW cells full of particles that move as prescribed; the number of new ones."""
        inlet = self._inlet
        if not inlet.active:
            return 0
        places = inlet.missing(self._particles.positions, self._rng)
        if len(places):
            source = np.asarray(self._emit_source(places, self.time), np.int64)
            mass = self.parameters.density * inlet.particle_spacing**3
            new = Particles.at_rest(places, mass, source, first_id=self._next_id)
            self._next_id += len(places)
            self._particles = self._particles.joined(new)
        inside = inlet.inside(self._particles.positions)
        velocities, affine = self._particles.velocities.copy(), self._particles.affine.copy()
        velocities[inside] = inlet.velocity(self._particles.positions[inside], self.time)
        affine[inside] = 0.0
        self._particles = replace(self._particles, velocities=velocities, affine=affine)
        return len(places)

    def _faces_between_liquid_and_outlet(self) -> tuple[np.ndarray, ...]:
        out = []
        outflow = self._walls.regions == CellType.OUTFLOW
        for axis in range(3):
            pad = [(0, 0)] * 3
            pad[axis] = (1, 1)
            wide = np.moveaxis(np.pad(outflow, pad), axis, 0)
            out.append(np.moveaxis(wide[1:] | wide[:-1], 0, axis) & (self._walls.openings[axis] > 0))
        return tuple(out)

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

    def _wet_faces(self, wet: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        out = []
        for axis, opening in enumerate(self._walls.openings):
            pad = [(0, 0)] * 3
            pad[axis] = (1, 1)
            wide = np.moveaxis(np.pad(wet, pad), axis, 0)
            out.append(np.moveaxis(wide[1:] | wide[:-1], 0, axis) & (opening > 0))
        return tuple(out)

    def _viscous(self, velocity: FaceVelocity, wet: tuple, dt: float) -> tuple[FaceVelocity, tuple[SolveReport, ...]]:
        fixed = [f.copy() for f in self._inlet.faces] if self._inlet.active else [np.zeros(w.shape, bool) for w in wet]
        if self._outlet_faces is not None:
            fixed = [f | o for f, o in zip(fixed, self._outlet_faces)]
        solved = tuple(w & ~f for w, f in zip(wet, fixed))
        head_on, beside = [], []
        for axis, opening in enumerate(self._walls.openings):
            closed = opening == 0
            # a wall across the component stops it; a wall along it drags by its share
            across = closed & (np.abs(self._walls.normals[axis][..., axis]) > 0.7)
            head_on.append(fixed[axis] | across)
            beside.append(closed & ~across)
        stopped = FaceVelocity(
            *(np.where(o == 0, np.float32(0), c) for o, c in zip(self._walls.openings, velocity.components))
        )
        new, reports = diffuse(
            stopped, solved, tuple(head_on), tuple(beside), viscosity=self.parameters.kinematic_viscosity, dt=dt,
            spacing=self.grid.spacing, wall_share=self.parameters.wall_damping,
            tolerance=self.settings.viscosity_tolerance,
        )  # fmt: skip
        return (new if reports else velocity), reports

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
        velocity, viscosity_reports = self._viscous(velocity, wet_faces, dt)
        system = self._system(types)
        heads = column_heads(wet, walls) if self._outlet_faces is None else None
        known = None if heads is None else heads * max(-self.parameters.gravity[2], 0.0) * dt
        initial = None if self._head_rate is None else self._head_rate * dt
        velocity, q, report = project(
            velocity, system, tolerance=self.settings.pressure_tolerance, initial=initial, known=known
        )
        if known is not None:
            velocity = hold_columns(velocity, known, system.unknown, walls)
        velocity = self._impose(velocity)
        velocity = boundaries.slide_along_walls(boundaries.extrapolate(velocity, wet_faces), walls)
        return velocity, system, q / dt, report, viscosity_reports

    def _substep(self, dt: float, number: int, *, last_attempt: bool):
        """The state after dt, reports, and the number of particles removed; None where dt should be halved."""
        particles, grid, walls = self._particles, self.grid, self._walls
        if not len(particles):
            return particles, SolveReport(True, 0, 0.0, "empty"), (), 0
        order = transfer.sort_by_cell(particles.positions, grid)
        velocity, system, head_rate, report, viscosity_reports = self._grid_velocity(order, dt)
        velocities, affine = transfer.grid_to_particles(velocity, grid, particles.positions, order)
        # second order in time: the velocity half way, by the particle's own gradient
        moves = dt * (velocities + 0.5 * dt * np.einsum("nij,nj->ni", affine, velocities))
        farthest = float(np.abs(moves).max()) / grid.spacing
        if not np.isfinite(farthest) or not np.isfinite(affine).all() or farthest > 3.0 * self.settings.courant:
            if not last_attempt:
                return None
            raise FluidliftError(
                f"Step {self._advances}, substep {number + 1}, t = {self.time:.4g} s: the simulation blew up (a particle "
                f"would cross {farthest:.3g} cells in {dt:.3g} s; pressure residual {report.residual:.2g}). "
                "The state before it is kept. Use a smaller time_step, or check inflow velocity, terrain and viscosity."
            )
        if self.settings.spread_crowds:
            volumes = (particles.masses / self.parameters.density).astype(np.float32)
            ratio = fill_ratio(particles.positions, volumes, grid, order, self._capacity)
            spread = spreading(particles.positions, ratio, system, grid, order)
            moves = moves if spread is None else moves + spread
        positions = (particles.positions + moves).astype(np.float32)
        keep = (1.0 - self.parameters.wall_damping) ** (dt / self.parameters.time_step)
        boundaries.collide(
            positions, particles.positions, velocities, walls,
            restitution=self.parameters.restitution, tangential_share=keep,
        )  # fmt: skip
        deformation = updated_deformation(
            particles.deformation, affine, dt, max_stretch=self.settings.max_stretch
        )
        state = replace(
            particles, positions=positions, velocities=velocities, affine=affine, deformation=deformation
        )
        leaving = self._leaving(particles.positions, positions)
        self._head_rate = head_rate
        index = order.order[~leaving[order.order]]  # grouped by cell: neighbours stay close in memory
        return state.select(index), report, viscosity_reports, int(leaving.sum())

    def _leaving(self, before: Float[np.ndarray, "n 3"], after: Float[np.ndarray, "n 3"]) -> np.ndarray:
        """bool [n]: out of the box, or out of the OUTFLOW cells along the mainstream."""
        leaving = ~self.grid.contains(after)
        outflow = self._walls.regions == CellType.OUTFLOW
        if not outflow.any():
            return leaving
        last = np.asarray(self.grid.shape) - 1
        was, now = (outflow[tuple(np.clip(self.grid.cell_of(x), 0, last).T)] for x in (before, after))
        crossed = was & ~now
        leaving[crossed] |= (after - before)[crossed] @ self._mainstream > 0
        return leaving
