"""The gas simulator: smoke in air on a MAC grid, with MacCormack advection; tracers move by RK2.

The air is incompressible and solved on the grid: advection (MacCormack after Selle et al. 2008, limited to the values
it interpolates), buoyancy where there is smoke, viscosity, pressure. The sides of the box are open (p = 0) except the
ground. Particles are passive tracers of the smoke, moved with second-order Runge-Kutta steps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fluidlift.errors import FluidliftError, InputRejected, require
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics import boundaries, transfer
from fluidlift.physics.active_region import open_region
from fluidlift.physics.advect_particles import leaving
from fluidlift.physics.deform import updated_deformation
from fluidlift.physics.emitter import Supply
from fluidlift.physics.forces import add_buoyancy
from fluidlift.physics.maccormack import advect_maccormack
from fluidlift.physics.position_correction import fill_ratio
from fluidlift.physics.pressure import build_system, project
from fluidlift.physics.stepping import EmitSource, Outcome, ParticleSimulator, SimulationSettings
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles, SolveReport, Terrain, triple

SMOKE = 0.5
"""cells (of `courant`) that smoke crosses in a substep: steps are of first order. A captured plume's density after a
second, blurred over 1.5 cells, is 6 % off that of steps a fifth as long, with 1 cell 11 %"""
FARTHEST = 2.5
"""cells that air may cross in a substep. The back-trace is stable at any length; beyond 3 cells (of `courant`) a
substep is taken for a blow-up and done again at half its length, so this leaves room for what a substep adds"""
SLOWER = 99.9
"""per cent of the smoke by which substeps are chosen: particles that slip through a slit beside a wall are some in ten
thousand, several times as fast as all others (6.1 m/s, where 99.9 % have 3.1, over a grill), and passive"""
THINNED = (1.5, 2.0)
"""of `GasSimulator.most`: from where on what leaves the inlet is thinned out, and up to where to `FEWEST` of it. At
twice as many a simulation ends (`simulate.max_particles`)"""
FEWEST = 0.1
"""share of what leaves the inlet that is kept at least: with less a cell holds no particle most of the time"""


class GasSimulator(ParticleSimulator):
    """Smoke in air.

    Args:
        grid: the same as the terrain's.
        terrain: solid ground and obstacles.
        parameters: of the gas; gravity only gives the direction (up is against it).
        particles: smoke tracers at the start.
        cell_types: u8 [nx,ny,nz]; INFLOW cells emit smoke with the prescribed velocity, OUTFLOW cells hold p = 0.
        buoyancy: acceleration of undiluted smoke against gravity, m/s^2.
        velocity: of the air at the start; None: that of the particles around them, at rest elsewhere.
        inflow_profile, seed, particles_per_cell, emit_source, settings, supply: as for `LiquidSimulator`.

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
        buoyancy: float,
        velocity: FaceVelocity | None = None,
        inflow_profile: FaceVelocity | None = None,
        seed: int = 0,
        particles_per_cell: int = 8,
        emit_source: EmitSource | None = None,
        settings: SimulationSettings | None = None,
        supply: Supply | None = None,
    ) -> None:
        require(np.isfinite(buoyancy), f"buoyancy {buoyancy}", "a finite number of m/s^2")
        open_sides = np.ones((3, 2), bool)
        open_sides[2, 0] = False  # the ground stays below, wherever gravity is turned to
        super().__init__(
            grid, terrain, parameters, particles, cell_types=cell_types, inflow_profile=inflow_profile, seed=seed,
            emit_source=emit_source, open_sides=open_sides, supply=supply,
            settings=replace(settings or SimulationSettings(), particles_per_cell=particles_per_cell),
        )  # fmt: skip
        self.buoyancy = float(buoyancy)
        self.most: int | None = None
        """particles; beyond `THINNED` times as many, what leaves the inlet is thinned out; None: never"""
        self._first_new = self._next_id
        self._region = open_region(triple(slice(0, n) for n in grid.shape), self._walls, self._capacity)
        self._emitters_switched()
        self._open_faces = triple(o > 0 for o in self._walls.openings)
        # how much of a face's surroundings a wall takes, for the damping
        self._wall_share = tuple(
            np.clip(1.0 - sample_nodes(self._walls.signed_distance, grid, grid.faces(a).reshape(-1, 3)) / grid.spacing,
                    0.0, 1.0).reshape(grid.face_shape(a))
            for a in range(3)
        )  # fmt: skip
        if velocity is None:
            velocity, _ = transfer.particles_to_grid(self._particles, grid)
        require(velocity.shape == grid.shape, f"velocity on {velocity.shape} cells", str(grid.shape))
        start = FaceVelocity(*(np.ascontiguousarray(c, np.float32) for c in velocity.components))
        require(all(np.isfinite(c).all() for c in start.components), "an initial velocity that is not finite")
        self._head_rate: np.ndarray | None = None
        projected, _, _ = project(self._inlet.impose(start, 0.0), self._system)
        self._velocity = self._continued(projected)

    def _emitters_switched(self) -> None:
        types = np.where(self._walls.regions == CellType.EMPTY, CellType.FLUID, self._walls.regions)
        types[self._inlet.emitter_cells(self.grid.shape) & ~self._walls.solid] = CellType.INFLOW
        self._system = build_system(types, self._walls.openings, self.grid, open_border=True).prepared()

    @property
    def velocity(self) -> FaceVelocity:
        """Of the air, m/s."""
        return self._velocity

    def state(self) -> dict[str, np.ndarray]:
        """See `ParticleSimulator.state`; also the air's velocity and the pressure as a first guess."""
        air = {f"air_{name}": c.copy() for name, c in zip("uvw", self._velocity.components)}
        rate = {} if self._head_rate is None else {"head_rate": self._head_rate.copy()}
        return super().state() | air | rate

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See `ParticleSimulator.restore`."""
        air = [state.get(f"air_{name}") for name in "uvw"]
        rate = state.get("head_rate")
        shapes = [self.grid.face_shape(axis) for axis in range(3)]
        fits = all(c is not None and c.shape == shape for c, shape in zip(air, shapes))
        if not fits or (rate is not None and rate.shape != self.grid.shape):
            raise InputRejected("a simulation state of another grid", f"{self.grid.shape} cells")
        if not all(np.isfinite(c).all() for c in [*air, *([] if rate is None else [rate])]):
            raise InputRejected("a simulation state with numbers that are not finite")
        super().restore(state)
        self._velocity = FaceVelocity(*(np.array(c, np.float32) for c in air))
        self._head_rate = None if rate is None else np.array(rate)

    def _reach(self) -> float:
        return SMOKE * super()._reach()

    def _substep_length(self, remaining: float) -> float:
        """Substeps in which smoke crosses `SMOKE` cells at most, and air beside it `FARTHEST`."""
        longest, fastest = super()._substep_length(remaining), self._fastest_air(self._velocity)
        reach = FARTHEST * self.settings.courant * self.grid.spacing
        return remaining / np.ceil(remaining * max(1.0 / longest, fastest / reach) - 1e-9)

    def _speed_gain(self) -> float:
        return abs(self.buoyancy)

    def _max_speed(self) -> float:
        """m/s, that `SLOWER` per cent of the smoke do not exceed."""
        v = self._particles.velocities
        return float(np.percentile(np.sqrt(np.einsum("ni,ni->n", v, v)), SLOWER)) if len(v) else 0.0

    def _fastest_air(self, velocity: FaceVelocity) -> float:
        """m/s, of a component of the air, where it fills its face; what passes through a slit counts as much less as
        that is narrower, and what is continued into walls not at all."""
        return max(float(np.abs(o * c).max()) for o, c in zip(self._walls.openings, velocity.components))

    def _continued(self, velocity: FaceVelocity) -> FaceVelocity:
        """Into the solid, along its surface."""
        return boundaries.slide_along_walls(boundaries.extrapolate(velocity, self._open_faces), self._walls)

    def _next_velocity(
        self, order: transfer.CellOrder, dt: float
    ) -> tuple[FaceVelocity, np.ndarray, SolveReport, tuple[SolveReport, ...]]:
        grid, parameters = self.grid, self.parameters
        volumes = (self._particles.masses / parameters.density).astype(np.float32)
        smoke = np.clip(fill_ratio(self._particles.positions, volumes, grid, order, self._capacity), 0.0, 1.0)
        velocity = advect_maccormack(self._velocity, grid, dt)
        velocity = add_buoyancy(velocity, smoke, strength=self.buoyancy, gravity=parameters.gravity, dt=dt)
        taken = 1.0 - (1.0 - parameters.wall_damping) ** (dt / parameters.time_step)
        if taken > 0:
            velocity = FaceVelocity(
                *((c * (1.0 - taken * s)).astype(np.float32) for c, s in zip(velocity.components, self._wall_share))
            )
        velocity = self._inlet.impose(velocity, self.time)
        velocity, viscosity_reports = self._surroundings.viscous(velocity, self._open_faces, self._region, dt)
        initial = None if self._head_rate is None else self._head_rate * dt
        velocity, q, report = project(
            velocity, self._system, tolerance=self.settings.pressure_tolerance, initial=initial
        )
        return self._continued(self._inlet.impose(velocity, self.time)), q / dt, report, viscosity_reports

    def _thinned_out(self, before: Particles, after: Particles) -> tuple[Particles, np.ndarray]:
        """Russian roulette (Kahn 1955) over what leaves the inlet in a substep: the particles with the masses of those
        that stand for others from now on, and which of them are these others.

        A wide source would fill the box with more particles than anybody waits for. Of n particles a share s is kept,
        each for 1/s as much smoke: in the mean buoyancy and what is seen stay as they are.
        """
        gone = np.zeros(len(after), bool)
        if self.most is None or not self._inlet.has_cells:
            return after, gone
        start, end = (share * self.most for share in THINNED)
        kept = float(np.clip((end - len(after)) / (end - start), FEWEST, 1.0))
        if kept == 1.0:
            return after, gone
        new = np.flatnonzero(before.ids >= self._first_new)
        # beside the inlet they still keep places from being filled
        leaves = new[self._inlet.beside(before.positions[new])]
        leaves = leaves[~self._inlet.beside(after.positions[leaves])]
        stays = self._rng.random(len(leaves)) < kept
        gone[leaves[~stays]] = True
        masses = after.masses.copy()
        masses[leaves[stays]] /= np.float32(kept)
        return replace(after, masses=masses), gone

    def _substep(self, dt: float, number: int, *, last_attempt: bool) -> Outcome | None:
        particles, grid = self._particles, self.grid
        order = transfer.sort_by_cell(particles.positions, grid)
        velocity, head_rate, report, viscosity_reports = self._next_velocity(order, dt)
        fastest = self._fastest_air(velocity)
        if not np.isfinite(fastest) or fastest * dt > 3.0 * self.settings.courant * grid.spacing:
            if not last_attempt:
                return None
            raise FluidliftError(
                f"Step {self._advances}, substep {number + 1}, t = {self.time:.4g} s: the simulation blew up (air at "
                f"{fastest:.3g} m/s; pressure residual {report.residual:.2g}). The state before it is kept. Use a "
                "smaller time_step, or check inflow velocity and buoyancy."
            )
        first, _ = transfer.grid_to_particles(velocity, grid, particles.positions, order)
        middle = (particles.positions + 0.5 * dt * first).astype(np.float32)
        velocities, affine = transfer.grid_to_particles(velocity, grid, middle, order)
        positions = (particles.positions + dt * velocities).astype(np.float32)
        boundaries.collide(
            positions, particles.positions, velocities, particles.velocities, self._walls, dt=dt,
            restitution=0.0, tangential_share=1.0,
        )  # fmt: skip
        deformation = particles.deformation
        if self.deforms:
            deformation = updated_deformation(deformation, affine, dt, max_stretch=self.settings.max_stretch)
        state = replace(particles, positions=positions, velocities=velocities, affine=affine, deformation=deformation)
        gone = leaving(particles.positions, positions, self._walls, self._mainstream)
        state, thinned = self._thinned_out(particles, state)
        index = order.order[~(gone | thinned)[order.order]]

        def adopt() -> None:
            self._velocity, self._head_rate = velocity, head_rate

        return Outcome(transfer.select_particles(state, index), int(gone.sum()), report, viscosity_reports, adopt)
