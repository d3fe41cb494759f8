"""The liquid simulator: affine particle-in-cell (APIC) and pressure projection (paper: "Presumed APIC Simulation").

One substep, as long as the CFL number allows: fill the inlet; P2G; gravity; viscosity; pressure projection;
extrapolate the velocity into air and along walls; G2P; advect (RK2); correct positions; collide; deform; remove what
has left. A substep either completes
or leaves the state as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from fluidlift.errors import FluidliftError, InputRejected, require
from fluidlift.physics import transfer
from fluidlift.physics.active_region import ActiveRegion
from fluidlift.physics.advect_particles import displacements, leaving
from fluidlift.physics.device_liquid import DeviceSetup, left_to_the_host
from fluidlift.physics.emitter import Emission, Supply
from fluidlift.physics.guidance import BodyForce
from fluidlift.physics.liquid_grid import LiquidGrid
from fluidlift.physics.numba_particles import NumbaMover, NumbaTransfer, ParticleWork
from fluidlift.physics.outlet import surplus
from fluidlift.physics.position_correction import fill_ratio, spreading
from fluidlift.physics.pressure import build_system
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
from fluidlift.physics.surface_tension import capillary_time_step
from fluidlift.seams import CarriedSplats, LiquidStepper, MoveRules
from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidParameters,
    Gaussians,
    Grid,
    Particles,
    SolveReport,
    Terrain,
)

__all__ = ["EmitSource", "LiquidSimulator", "SimulationSettings", "StepReport"]


NOWHERE = np.zeros((0, 3), np.float32)
"""places of particles where there is none"""


def open_sky(gravity: tuple[float, float, float]) -> np.ndarray:
    """bool [3,2] (axis, low/high): the side that gravity points away from, as open; none without gravity."""
    out, g = np.zeros((3, 2), bool), np.asarray(gravity, np.float64)
    if g.any():
        up = int(np.abs(g).argmax())
        out[up, int(g[up] < 0)] = True
    return out


class LiquidSimulator(ParticleSimulator):
    """A body of liquid on a terrain, with an inlet and an outlet.

    The sides of the box are frictionless walls, except in INFLOW and OUTFLOW cells and where `open_sides` says so:
    particles that leave there are removed. The terrain's signed distance decides what is solid.

    Outlet: particles flow freely and are removed when they leave the box there, or when they leave the OUTFLOW cells
    along the mainstream, or crowd there (`outlet.surplus`). Columns of liquid that stand on the ground inside OUTFLOW
    cells have the hydrostatic pressure of the water level they start with (see `physics.outlet`).
    `parameters.outflow_velocity` is used only with `settings.prescribe_outflow`.

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
        supply: how the inflow changes over time, and emitters; None: a steady inlet alone.
        open_sides: bool [3,2] (axis, low/high) of the box without a wall; None: `open_sky`.
        forces: beside gravity.

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
        supply: Supply | None = None,
        open_sides: np.ndarray | None = None,
        forces: Sequence[BodyForce] = (),
    ) -> None:
        super().__init__(
            grid, terrain, parameters, particles, cell_types=cell_types, inflow_profile=inflow_profile, seed=seed,
            emit_source=emit_source, supply=supply,
            open_sides=open_sky(parameters.gravity) if open_sides is None else np.asarray(open_sides, bool),
            settings=replace(settings or SimulationSettings(), particles_per_cell=particles_per_cell),
        )  # fmt: skip
        self._forces, self._work = tuple(forces), work or ParticleWork()
        if bodies:
            gravity = np.asarray(parameters.gravity)
            self.bodies = RigidBodies(bodies, self._walls, density=parameters.density, gravity=gravity)
            self._particles = self._particles.select(~self.bodies.inside(self._particles.positions))
        self._liquid = LiquidGrid(
            self._surroundings, self._particles, transfer=self._work.transfer, bodies=self.bodies, forces=self._forces
        )
        self.on_host_because = ""
        """why the grid is left to the host though `work` could do the whole substep; "" where it does, or could not"""
        self._stepper: LiquidStepper | None = None
        """keeps the particles, in place of `_particles`"""
        if self._work.liquid is not None:
            self.on_host_because = left_to_the_host(self._surroundings, self._forces, len(self.bodies))
            if not self.on_host_because:
                solids, levels = self._liquid.solids, self._liquid.start_levels
                self._stepper = self._work.liquid.begin(DeviceSetup(self._surroundings, solids, self._forces, levels))
                self._stepper.upload(self._particles)

    def state(self) -> dict[str, np.ndarray]:
        """See `ParticleSimulator.state`; also that of the grid and of the bodies."""
        bodies = {f"bodies.{name}": value for name, value in self.bodies.state().items()}
        if self._stepper is not None:
            self._liquid.head_rate = self._stepper.head_rate
        return super().state() | self._liquid.state() | bodies

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See `ParticleSimulator.restore`."""
        self._liquid.require_fit(state)
        before = super().state()
        super().restore(state)
        try:
            prefix = "bodies."
            self.bodies.restore({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
        except InputRejected:
            super().restore(before)
            raise
        self._liquid.restore(state)
        if self._stepper is not None:
            self._stepper.upload(self._particles)
            self._stepper.restore_head_rate(self._liquid.head_rate)

    @property
    def any_thread(self) -> bool:
        """See `ParticleSimulator`; a GPU belongs to the thread that began with it."""
        host = isinstance(self._work.transfer, NumbaTransfer) and isinstance(self._work.mover, NumbaMover)
        return host and self._stepper is None

    @property
    def particles(self) -> Particles:
        """See `ParticleSimulator`."""
        return super().particles if self._stepper is None else self._stepper.download(by_id=True)

    def splats(self, rest: Gaussians, *, max_stretch: float = 12.0, max_size: float = np.inf) -> CarriedSplats | None:
        """The Gaussians that the particles carry now, in the order in which they are kept, where they lie; None: on the
        host.

        Args: see `deformed`.

        Raises:
            ValueError: a source outside the rest Gaussians.
        """
        if self._stepper is None:
            return None
        return self._stepper.splats(rest, max_stretch=max_stretch, max_size=max_size)

    def deformed(
        self, rest: Gaussians, particles: Particles, *, max_stretch: float = 12.0, max_size: float = np.inf
    ) -> Gaussians:
        """See `ParticleSimulator`."""
        if self._stepper is None:
            return super().deformed(rest, particles, max_stretch=max_stretch, max_size=max_size)
        carried = self._stepper.splats(rest, max_stretch=max_stretch, max_size=max_size, by_id=True)
        quats, scales = carried.quats.numpy(), carried.scales.numpy()
        same = len(quats) == len(particles)
        require(same, f"{len(particles)} particles", f"the {len(quats)} of the present state")
        return Gaussians(
            particles.positions, quats, scales, rest.opacities[particles.source], rest.sh[particles.source]
        )

    @property
    def volume(self) -> float:
        """See `ParticleSimulator`."""
        return super().volume if self._stepper is None else self._stepper.mass() / self.parameters.density

    def _held(self) -> Particles:
        return self._particles if self._stepper is None else self._stepper.download()

    def _count(self) -> int:
        return super()._count() if self._stepper is None else self._stepper.count

    def _wet_volume(self) -> float:
        return super()._wet_volume() if self._stepper is None else self._stepper.wet_cells() * self.grid.spacing**3

    def _around(self, emission: Emission) -> np.ndarray:
        if self._stepper is None:
            return super()._around(emission)
        begins = emission.is_new and emission.emitter.on(self.time)
        return self._stepper.download().positions if begins and self._stepper.count else NOWHERE

    def _missing(self) -> np.ndarray:
        if self._stepper is None:
            return super()._missing()
        return self._inlet.jittered(self._stepper.lacking(), self._rng) if self._inlet.has_cells else NOWHERE

    def _carry(self) -> None:
        if self._stepper is None:
            super()._carry()
        else:
            self._stepper.carry(self.time)

    def _join(self, made: Particles) -> None:
        if self._stepper is None:
            super()._join(made)
        else:
            self._stepper.append(made)

    def _take_out(self, cells: np.ndarray) -> tuple[int, float]:
        if self._stepper is None:
            return super()._take_out(cells)
        number, mass = self._stepper.take_out(cells)
        return number, mass / self.parameters.density

    def _speed_gain(self) -> float:
        return super()._speed_gain() + sum(force.largest for force in self._forces)

    def _substep_length(self, remaining: float) -> float:
        """See `ParticleSimulator`; also within the limit of surface tension."""
        longest = capillary_time_step(self.parameters.density, self.parameters.surface_tension, self.grid.spacing)
        step = super()._substep_length(remaining)
        return step if step <= longest else remaining / np.ceil(remaining / longest - 1e-9)

    def _max_speed(self) -> float:
        if self._stepper is not None:
            return self._stepper.max_speed()
        return max(super()._max_speed(), self.bodies.max_speed(self.parameters.time_step))

    def _substep(self, dt: float, number: int, *, last_attempt: bool) -> Outcome | None:
        if self._stepper is not None:
            return self._stepped(self._stepper, dt, number, last_attempt=last_attempt)
        walls, bodies = self._walls, self.bodies
        before = bodies.state()
        if not len(self._particles):
            bodies.predict(dt)
            bodies.advance()
            return Outcome(self._particles, 0, SolveReport(True, 0, 0.0, "empty"), (), lambda: None)
        region = bodies.enter(self._liquid.look(self._particles.positions))
        grid = region.grid
        order = transfer.sort_by_cell(self._particles.positions, grid)
        if number % TIDY_EVERY == 0:
            order = self._tidied(order, region)
        particles = self._particles
        step = self._liquid.step(particles, region, order, dt, self.time)
        velocities, affine = self._work.transfer.grid_to_particles(step.velocity, grid, particles.positions, order)
        if self.settings.airy_above is not None:
            drops = particles.positions[:, 2] > self.settings.airy_above
            velocities[drops], affine[drops] = ballistic(particles.velocities[drops], self.parameters.gravity, dt), 0.0
        # particles in the inlet move as prescribed: walls beside it would hold back its rim
        self._inlet.carry(particles.positions, velocities, affine, self.time)
        moves, farthest = displacements(velocities, affine, dt)
        if not self._near_enough(farthest):
            bodies.restore(before)
            if not last_attempt:
                return None
            raise self._blown_up(farthest, step.report, dt, number)
        if self.settings.spread_crowds:
            volumes = (particles.masses / self.parameters.density).astype(np.float32)
            ratio = fill_ratio(particles.positions, volumes, grid, order, region.capacity)
            # the skin of the liquid counts here, and p = 0 lies outside all cells that hold particles
            held = build_system(step.holding, region.walls.openings, grid, open_border=True)
            spread = spreading(particles.positions, ratio, region.capacity, held, grid, order)
            moves = moves if spread is None else moves + spread
        keep = (1.0 - self.parameters.wall_damping) ** (dt / self.parameters.time_step)
        rules = MoveRules(dt, self.parameters.restitution, keep, self.settings.max_stretch, self.deforms)
        state = self._work.mover.moved(particles, moves, velocities, affine, walls, rules)
        gone = leaving(particles.positions, state.positions, walls, self._mainstream)
        full = self.parameters.density * grid.spacing**3
        gone |= surplus(particles.masses, order, region.walls.regions == CellType.OUTFLOW, full)
        bodies.advance()
        gone |= bodies.push_out(state.positions, state.velocities, tangential_share=keep)
        if gone.any():
            state = transfer.select_particles(state, np.flatnonzero(~gone))

        def adopt() -> None:
            self._liquid.head_rate = step.head_rate

        return Outcome(state, int(gone.sum()), step.report, step.viscosity, adopt)

    def _near_enough(self, farthest: float) -> bool:
        """Whether a displacement (m) is one that a substep may have."""
        return farthest / self.grid.spacing <= 3.0 * self.settings.courant

    def _blown_up(self, farthest: float, report: SolveReport, dt: float, number: int) -> FluidliftError:
        return FluidliftError(
            f"Step {self._advances}, substep {number + 1}, t = {self.time:.4g} s: the simulation blew up (a "
            f"particle would cross {farthest / self.grid.spacing:.3g} cells in {dt:.3g} s; pressure residual "
            f"{report.residual:.2g}). The state before it is kept. Use a smaller time_step, or check inflow "
            "velocity, terrain and viscosity."
        )

    def _stepped(self, stepper: LiquidStepper, dt: float, number: int, *, last_attempt: bool) -> Outcome | None:
        """A substep where the particles are."""
        if not stepper.count:
            return Outcome(None, 0, SolveReport(True, 0, 0.0, "empty"), (), lambda: None)
        tidy = number % TIDY_EVERY == 0 and self.settings.reseed
        draw = (lambda n: self._rng.normal(size=(n, 3))) if tidy else None
        self._next_id += stepper.prepare(self._next_id, draw)
        done = stepper.step(dt, self.time)
        if not self._near_enough(done.farthest):
            if not last_attempt:
                return None
            raise self._blown_up(done.farthest, done.pressure, dt, number)
        return Outcome(None, done.leaving, done.pressure, done.viscosity, stepper.adopt)

    def _tidied(self, order: transfer.CellOrder, region: ActiveRegion) -> transfer.CellOrder:
        """Reseed, and put the particles in the order of their cells, so that neighbours are close in memory."""
        particles = self._particles
        if self.settings.reseed:
            inner = inner_cells((np.diff(order.start) > 0).reshape(region.grid.shape), region.walls.solid)
            done = reseed(
                particles, order, inner, self._walls, density=self.parameters.density, first_id=self._next_id,
                rng=self._rng,
            )  # fmt: skip
            particles = done.particles
            self._next_id += done.split
            if done.split or done.merged:
                order = transfer.sort_by_cell(particles.positions, region.grid)
        self._particles = transfer.select_particles(particles, order.order)
        return transfer.CellOrder(np.arange(len(particles)), order.start)


def ballistic(velocities: Float[np.ndarray, "n 3"], gravity: Sequence[float], dt: float) -> Float[np.ndarray, "n 3"]:
    """Velocities (m/s) of drops that fly on for `dt` (s): in the air no pressure acts on them.

    A cell of the grid has one velocity. Drops that rise in the middle of a fountain and fall around it would brake
    each other in the cells that they share, and its column would shrink to a cone. What air takes from
    them is left out: it holds a drop of 5 mm at 9 m/s (Gunn and Kinzer 1949), to which it would have to fall 4 m.
    """
    return velocities + np.float32(dt) * np.asarray(gravity, np.float32)
