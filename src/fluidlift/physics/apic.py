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

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.physics import transfer
from fluidlift.physics.active_region import ActiveRegion
from fluidlift.physics.advect_particles import displacements, leaving
from fluidlift.physics.emitter import Supply
from fluidlift.physics.guidance import BodyForce
from fluidlift.physics.liquid_grid import Layout, LiquidGrid
from fluidlift.physics.numba_particles import ParticleWork
from fluidlift.physics.outlet import surplus
from fluidlift.physics.position_correction import fill_ratio, spreading
from fluidlift.physics.pressure import build_system
from fluidlift.physics.reseed import inner_cells, reseed
from fluidlift.physics.rigid import RigidBodies, RigidBody
from fluidlift.physics.stepping import (
    TIDY_EVERY,
    EmitSource,
    Outcome,
    SimulationSettings,
    StepReport,
)
from fluidlift.seams import MoveRules
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles, SolveReport, Terrain, triple

__all__ = ["EmitSource", "LiquidSimulator", "SimulationSettings", "StepReport"]


def open_sky(gravity: tuple[float, float, float]) -> np.ndarray:
    """bool [3,2] (axis, low/high): the side that gravity points away from, as open; none without gravity."""
    out, g = np.zeros((3, 2), bool), np.asarray(gravity, np.float64)
    if g.any():
        up = int(np.abs(g).argmax())
        out[up, int(g[up] < 0)] = True
    return out


class LiquidSimulator(LiquidGrid):
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
        self._forces = tuple(forces)
        self._prepare_grid(work or ParticleWork(), bodies)

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
            if first is None or rate.ndim != 3 or first.shape != (3,) or not (first >= 0).all():
                raise InputRejected("a simulation state of another grid", f"{self.grid.shape} cells")
            if (first + rate.shape > self.grid.shape).any() or not np.isfinite(rate).all():
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
        self._head_rate = None if rate is None or first is None else (triple(int(i) for i in first), np.array(rate))
        self._start_levels = None if levels is None else np.array(levels)

    @property
    def bodies(self) -> RigidBodies | None:
        """The rigid bodies, where there are any."""
        return self._bodies

    def _max_speed(self) -> float:
        own = super()._max_speed()
        return own if self._bodies is None else max(own, self._bodies.max_speed(self.parameters.time_step))

    def _substep(self, dt: float, number: int, *, last_attempt: bool) -> Outcome | None:
        walls, bodies = self._walls, self._bodies
        before = None if bodies is None else bodies.state()
        if not len(self._particles):
            if bodies is not None:
                bodies.predict(dt)
                bodies.advance()
            return Outcome(self._particles, 0, SolveReport(True, 0, 0.0, "empty"), (), lambda: None)
        region = self._look(self._particles.positions)
        if bodies is not None:
            region = bodies.enter(region)
        grid = region.grid
        order = transfer.sort_by_cell(self._particles.positions, grid)
        if number % TIDY_EVERY == 0:
            order = self._tidied(order, region)
        particles = self._particles
        step = self._grid_velocity(region, order, dt)
        velocities, affine = self._work.transfer.grid_to_particles(step.velocity, grid, particles.positions, order)
        self._carry_inlet(velocities, affine)
        moves, farthest = displacements(velocities, affine, dt)
        farthest /= grid.spacing
        if not farthest <= 3.0 * self.settings.courant:
            if bodies is not None and before is not None:
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
            ratio = fill_ratio(particles.positions, volumes, grid, order, region.capacity)
            # the skin of the liquid counts here, and p = 0 lies outside all cells that hold particles
            held = build_system(step.holding, region.walls.openings, grid, open_border=True)
            spread = spreading(particles.positions, ratio, region.capacity, held, grid, order)
            moves = moves if spread is None else moves + spread
        keep = (1.0 - self.parameters.wall_damping) ** (dt / self.parameters.time_step)
        rules = MoveRules(dt, self.parameters.restitution, keep, self.settings.max_stretch)
        state = self._work.mover.moved(particles, moves, velocities, affine, walls, rules)
        gone = leaving(particles.positions, state.positions, walls, self._mainstream)
        full = self.parameters.density * grid.spacing**3
        gone |= surplus(particles.masses, order, region.walls.regions == CellType.OUTFLOW, full)
        if bodies is not None:
            bodies.advance()
            gone |= bodies.push_out(state.positions, state.velocities, tangential_share=keep)
        if gone.any():
            state = transfer.select_particles(state, np.flatnonzero(~gone))

        def adopt() -> None:
            self._head_rate = step.head_rate

        return Outcome(state, int(gone.sum()), step.report, step.viscosity, adopt)

    def _add(
        self, places: np.ndarray, volume: float, look: np.ndarray | None = None, velocity: np.ndarray | None = None
    ) -> None:
        """See `ParticleSimulator`; nothing comes out of inlets and emitters where a body is."""
        if self._bodies is not None and len(places):
            places = places[~self._bodies.inside(places)]
        super()._add(places, volume, look, velocity)

    def _carry_inlet(self, velocities: np.ndarray, affine: np.ndarray) -> None:
        """Particles in the inlet move as prescribed, in place: walls beside it would hold back its rim."""
        self._inlet.carry(self._particles.positions, velocities, affine, self.time)

    def _layout(self, region: ActiveRegion, order: transfer.CellOrder) -> Layout:
        """With the cells of emitters as inflow."""
        layout = super()._layout(region, order)
        if not self._inlet.running:
            return layout
        cells = self._inlet.emitter_cells(region.grid.shape, region.first)
        inflow = np.uint8(CellType.INFLOW)
        return replace(
            layout,
            holding=np.where(cells, inflow, layout.holding),
            types=np.where(cells, inflow, layout.types),
            wet=layout.wet | cells,
        )

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
