"""What the liquid and the gas simulator share: time stepping, particles, inlet and outlet.

A substep either completes or leaves the state as it was.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from fluidlift.errors import FluidliftError, InputRejected, require
from fluidlift.numerics.sampling import sample_centers
from fluidlift.numerics.signed_distance import push_outside
from fluidlift.physics import boundaries, transfer
from fluidlift.physics.boundaries import cell_capacity
from fluidlift.physics.deform import deform_gaussians
from fluidlift.physics.emitter import Emission, Supply
from fluidlift.physics.inlet import Inlet
from fluidlift.physics.no_bodies import NoBodies
from fluidlift.physics.refill import Refill
from fluidlift.physics.rigid import RigidBodies
from fluidlift.physics.surroundings import SimulationSettings, Surroundings
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Gaussians, Grid, Particles, SolveReport, Terrain

TIDY_EVERY = 4
"""substeps between two tidyings: particles put in the order of their cells, thin and crowded cells reseeded"""

ARRIVED = 0.5
"""of the speed at the inlet, below which fluid is no part of a jet any more (a choice: what falls gets faster)"""


@dataclass(frozen=True)
class Emitted:
    """Particles that fill the places where one is due. A place may take none, one or several, which share its mass."""

    place: Int[np.ndarray, " m"]
    """index of the place that each belongs to"""
    offset: Float[np.ndarray, "m 3"]
    """m, from there"""
    source: Int[np.ndarray, " m"]
    """index of the rest Gaussian that lends it its look"""

    @classmethod
    def one_each(cls, source: Int[np.ndarray, " n"]) -> Emitted:
        """One particle in each place."""
        return cls(np.arange(len(source)), np.zeros((len(source), 3), np.float32), source)


EmitSource = Callable[[np.ndarray, float], Emitted]
"""(places [n,3] m, time s) -> the particles that enter there"""


@dataclass(frozen=True)
class StepReport:
    """What a call of `advance` did."""

    duration: float
    """s"""
    substeps: int
    max_speed: float
    """m/s, of the particles at the end"""
    volume: float
    """m^3 that the particles stand for: mass / density"""
    wet_volume: float
    """m^3 of the cells that hold particles, cut by the terrain only in whole cells"""
    pressure: tuple[SolveReport, ...]
    viscosity: tuple[SolveReport, ...]
    n_particles: int
    emitted: int
    removed: int
    retries: int
    """substeps that had to be halved"""


@dataclass(frozen=True)
class Outcome:
    """Of one substep, not yet adopted."""

    particles: Particles | None
    """None: they are kept elsewhere, and `adopt` knows where"""
    removed: int
    pressure: SolveReport
    viscosity: tuple[SolveReport, ...]
    adopt: Callable[[], None]
    """stores what else the simulator keeps from step to step"""


class ParticleSimulator(ABC):
    """Particles on a grid that move in substeps, between an inlet and an outlet.

    Subclasses say what one substep does. Masses: the initial particles get the mass of the space around them (their
    mean spacing where they are sparser than usual), since Gaussians sample a body unevenly; those given are replaced.

    Args: see `LiquidSimulator`. `open_sides` bool [3,2]: sides of the box (axis, low/high) without a wall.
    """

    def __init__(
        self,
        grid: Grid,
        terrain: Terrain,
        parameters: FluidParameters,
        particles: Particles,
        *,
        cell_types: np.ndarray,
        inflow_profile: FaceVelocity | None,
        seed: int,
        emit_source: EmitSource | None,
        settings: SimulationSettings,
        open_sides: np.ndarray,
        supply: Supply | None = None,
    ) -> None:
        require(terrain.grid == grid, "a terrain on another grid", "the grid of the simulation")
        require(cell_types.shape == grid.shape, f"cell types {cell_types.shape}", str(grid.shape))
        for name in ("positions", "velocities", "affine", "deformation"):
            require(bool(np.isfinite(getattr(particles, name)).all()), f"{name} that are not finite")
        self.grid, self.parameters, self.settings, self.time = grid, parameters, settings, 0.0
        self._rng = np.random.default_rng(seed)
        self._walls = boundaries.build_walls(terrain, cell_types, open_sides)
        self._capacity = cell_capacity(terrain.signed_distance, grid)
        self._mainstream = np.asarray(terrain.mainstream, np.float64)
        self._inlet = Inlet(self._walls, parameters, inflow_profile, seed, settings.particles_per_cell, supply)
        if self._inlet.moves:  # its cells are inflow where it stands
            open_air = np.where(self._walls.regions == CellType.INFLOW, np.uint8(CellType.EMPTY), self._walls.regions)
            self._walls = replace(self._walls, regions=open_air)
        self._surroundings = Surroundings(
            grid, parameters, settings, self._walls, self._capacity, self._mainstream, self._inlet
        )
        self.bodies: RigidBodies | NoBodies = NoBodies()
        """rigid bodies; nothing comes out of inlets and emitters where one is"""
        self.drains: np.ndarray | None = None
        """bool [nx,ny,nz]: cells whose particles are taken out at the end of every `advance`; None: none are"""
        self.drains_until = np.inf
        """s, after which none are"""
        self.drained = 0.0
        """m^3 that were taken out there"""
        self.deforms = settings.deform
        """whether the deformation of particles is carried along; may be turned off before the first step"""
        self.refill: Refill | None = None
        """cells that are kept from running dry, at the end of every `advance`; None: none are"""
        self.refilled = 0.0
        """m^3 that were put in there"""
        self._kept: tuple[float, np.ndarray] | None = None
        self._particles = self._prepared(particles)
        self._next_id = int(particles.ids.max()) + 1 if len(particles) else 0
        self._emit_source = emit_source or self._nearest_source(particles)
        self._advances = 0

    @abstractmethod
    def _substep(self, dt: float, number: int, *, last_attempt: bool) -> Outcome | None:
        """The state after dt; None where dt should be halved, unless it is the last attempt."""

    @property
    def particles(self) -> Particles:
        """The present state, in the order of the ids."""
        held = self._held()
        return held.select(np.argsort(held.ids, kind="stable"))

    def _held(self) -> Particles:
        """The present state, in the order in which it is kept."""
        return self._particles

    def deformed(
        self, rest: Gaussians, particles: Particles, *, max_stretch: float = 12.0, max_size: float = np.inf
    ) -> Gaussians:
        """`deform.deform_gaussians`, done where the particles are.

        Args:
            rest: the undeformed Gaussians.
            particles: as `particles` gave them, before the next `advance` where that may not be called by any thread.
            max_stretch, max_size: see there.

        Raises:
            ValueError: a source outside the rest Gaussians.
        """
        return deform_gaussians(rest, particles, max_stretch=max_stretch, max_size=max_size)

    def state(self) -> dict[str, np.ndarray]:
        """All that changes from step to step, as plain arrays: a simulator built with the same arguments goes on from
        it, after `restore`, bit for bit."""
        generator = json.dumps(self._rng.bit_generator.state).encode()
        held = self._held()
        particles = {f"particles.{f.name}": getattr(held, f.name).copy() for f in fields(Particles)}
        return particles | {
            "time": np.float64(self.time),
            "drained": np.float64(self.drained),
            "refilled": np.float64(self.refilled),
            "counts": np.array([self._advances, self._next_id], np.int64),
            "generator": np.frombuffer(generator, np.uint8),
            "inlet_shift": self._inlet.shift.copy(),
            "emitted_until": np.array([e.last for e in self._inlet.emissions], np.float64),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go back, or on, to a state of `state`.

        Raises:
            InputRejected: something is missing, of the wrong shape or not finite; nothing has changed then.
        """
        try:
            particles = Particles(**{f.name: np.array(state[f"particles.{f.name}"]) for f in fields(Particles)})
            generator = json.loads(bytes(state["generator"]))
            counts, shift, time = state["counts"], np.array(state["inlet_shift"], np.float64), float(state["time"])
            drained, refilled = float(state.get("drained", 0.0)), float(state.get("refilled", 0.0))
            emitted = np.array(state.get("emitted_until", np.zeros(0)), np.float64)
            whole = counts.shape == (2,) and counts.dtype.kind in "iu" and shift.shape == (3,)
            require(whole and bool(np.isfinite([time, drained, refilled, *shift]).all()), "counters of another kind")
            require(emitted.shape == (len(self._inlet.emissions),), "a simulation state with other emitters")
            for name in ("positions", "velocities", "affine", "deformation", "masses"):
                require(bool(np.isfinite(getattr(particles, name)).all()), f"{name} that are not finite")
            fresh = np.random.default_rng(0)
            fresh.bit_generator.state = generator
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise InputRejected(f"a simulation state that does not fit: {error}") from None
        self._particles, self._rng, self.time = particles, fresh, time
        self.drained, self.refilled = drained, refilled
        self._advances, self._next_id = int(counts[0]), int(counts[1])
        self._inlet.shift = shift
        for emission, last in zip(self._inlet.emissions, emitted):
            emission.last = float(last)
        if self._inlet.switch(time):
            self._emitters_switched()

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
                    f"Step {self._advances}: {substeps} substeps reached t = {self.time:.4g} s of {end:.4g} s; "
                    f"the fastest particle moves at {self._max_speed():.3g} m/s. Use a coarser grid "
                    "or check the velocities."
                )
            emitted += self._fill_inlet()
            dt = self._substep_length(end - self.time)
            attempt = 0
            while (outcome := self._substep(dt, substeps, last_attempt=attempt >= 6)) is None:
                dt *= 0.5
                attempt += 1
            retries += attempt
            if outcome.particles is not None:
                self._particles = outcome.particles
            outcome.adopt()
            self._inlet.travel(dt, self.time)
            self.time += dt
            substeps += 1
            removed += outcome.removed
            pressure.append(outcome.pressure)
            viscosity.extend(outcome.viscosity)
        self.time = end
        removed += self._drain() if self.time <= self.drains_until else 0
        emitted += self._fill_inlet()  # what the last substep carried away leaves no gap in the frame
        emitted += self._fill_dry()
        removed += self._draw_off()
        return StepReport(
            duration, substeps, self._max_speed(), self.volume, self._wet_volume(), tuple(pressure), tuple(viscosity),
            self._count(), emitted, removed, retries,
        )  # fmt: skip

    def keep_volume(self, cells: Bool[np.ndarray, "nx ny nz"]) -> None:
        """Draw what flows in from these cells, from now on: the volume stays as it is at the first instant.

        Where a pump throws a pool up it takes as much from it as it lifts.

        Raises:
            ValueError: cells of another grid, or none.
        """
        require(
            cells.shape == self.grid.shape and bool(cells.any()), f"cells {cells.shape}", f"some of {self.grid.shape}"
        )
        self._kept = self.volume, np.argwhere(cells)

    def _drain(self) -> int:
        """Take out what lies in cells that are drained; how many particles."""
        if self.drains is None or not self._count():
            return 0
        number, volume = self._take_out(self.drains)
        self.drained += volume
        return number

    def _draw_off(self) -> int:
        """Take out what is there beyond the volume that is kept, of as many cells; how many particles."""
        if self._kept is None:
            return 0
        volume, cells = self._kept
        many = int((self.volume - volume) / self.grid.spacing**3)
        if many < 1:
            return 0
        chosen = np.zeros(self.grid.shape, bool)
        chosen[tuple(cells[self._rng.choice(len(cells), min(many, len(cells)), replace=False)].T)] = True
        return self._take_out(chosen)[0]

    def _take_out(self, cells: Bool[np.ndarray, "nx ny nz"]) -> tuple[int, float]:
        """Take out what lies in cells: how many particles, m^3."""
        at = np.clip(self.grid.cell_of(self._particles.positions), 0, np.asarray(self.grid.shape) - 1)
        gone = cells[tuple(at.T)]
        if not gone.any():
            return 0, 0.0
        volume = float(self._particles.masses[gone].sum(dtype=np.float64)) / self.parameters.density
        self._particles = self._particles.select(~gone)
        return int(gone.sum()), volume

    def _fill_dry(self) -> int:
        """Put fluid into cells that are kept from running dry; how many particles."""
        if self.refill is None:
            return 0
        spacing = self._inlet.particle_spacing
        places = self.refill.missing(self._held().positions, spacing, self._rng)
        places = places[~self.bodies.inside(places)] if len(places) else places
        if len(places):
            made = self.refill.particles(places, self.parameters.density * spacing**3, self._next_id)
            made = replace(made, masses=(made.masses * self._liquid_share(made.velocities)).astype(np.float32))
            self._join(made)
            self._next_id += len(places)
            self.refilled += float(made.masses.sum(dtype=np.float64)) / self.parameters.density
        return len(places)

    def _count(self) -> int:
        """Number of particles."""
        return len(self._particles)

    @property
    def any_thread(self) -> bool:
        """Whether `advance` may be called by another thread than the one that made the simulator."""
        return True

    @property
    def volume(self) -> float:
        """m^3 that the particles stand for: mass / density."""
        return float(self._particles.masses.sum(dtype=np.float64)) / self.parameters.density

    def _wet_volume(self) -> float:
        cells = np.clip(self.grid.cell_of(self._particles.positions), 0, np.asarray(self.grid.shape) - 1)
        wet = np.zeros(self.grid.shape, bool)
        wet[tuple(cells.T)] = True
        return int(np.count_nonzero(wet)) * self.grid.spacing**3

    def _max_speed(self) -> float:
        """m/s, of the particles."""
        v = self._particles.velocities
        return float(np.sqrt(np.einsum("ni,ni->n", v, v).max(initial=0.0)))

    def _speed_gain(self) -> float:
        """m/s^2, largest acceleration by body forces."""
        return float(np.linalg.norm(self.parameters.gravity))

    def _reach(self) -> float:
        """m, that particles cross in a substep at most."""
        return self.settings.courant * self.grid.spacing

    def _substep_length(self, remaining: float) -> float:
        """Equal substeps within the CFL limit (`_reach`), the gain of speed by body forces included."""
        longest = min(self.parameters.time_step, remaining)
        gain = self._speed_gain()
        # (speed + gain dt) dt <= reach
        reach, speed = self._reach(), self._max_speed()
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
        volumes = volumes * self._liquid_share(kept.velocities)
        if self.settings.airy_above is not None:
            volumes = np.where(kept.positions[:, 2] > self.settings.airy_above, self.settings.airy, 1.0) * volumes
        return replace(
            kept,
            masses=(self.parameters.density * volumes).astype(np.float32),
            deformation=np.ascontiguousarray(kept.deformation, np.float32),
            **as_float,
        )

    def _liquid_share(self, velocities: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Share of what is seen that is liquid where it moves at velocities (m/s): `settings.discharge_speed`.

        What falls on from the inlet does not get slower; what is much slower has arrived somewhere.
        """
        speed = np.linalg.norm(np.asarray(velocities, np.float64), axis=1)
        falls = speed > ARRIVED * np.linalg.norm(self._inlet.bulk)
        if self.settings.discharge_speed is None or not falls.any():
            return np.ones(len(velocities))
        return np.where(falls, np.minimum(self.settings.discharge_speed / np.maximum(speed, 1e-9), 1.0), 1.0)

    def _nearest_source(self, particles: Particles) -> EmitSource:
        if not len(particles):
            return lambda places, time: Emitted.one_each(np.zeros(len(places), np.int64))
        tree, source = cKDTree(particles.positions), particles.source.copy()
        return lambda places, time: Emitted.one_each(source[tree.query(places)[1]])

    def _fill_inlet(self) -> int:
        """Keep INFLOW cells and emitters full of particles that move as prescribed; the number of new ones."""
        inlet, before = self._inlet, self._next_id
        if inlet.switch(self.time):
            self._emitters_switched()
        share = float(self._liquid_share(inlet.bulk[None])[0])
        share *= 1.0 if self.settings.airy_above is None else self.settings.airy
        self._add(self._missing(), inlet.particle_spacing**3 * share)
        for number, emission in enumerate(inlet.emissions):
            places = emission.due(self.time, self._around(emission))
            look = inlet.supply.looks[number] if inlet.supply.looks else None
            self._add(places, emission.volume, look, emission.velocity)
        if inlet.active:
            self._carry()
        return self._next_id - before

    def _around(self, emission: Emission) -> np.ndarray:
        """Positions (m) of the particles that an emitter has to look at."""
        return self._particles.positions

    def _missing(self) -> np.ndarray:
        """Places (m) of the particles that INFLOW cells lack."""
        return self._inlet.missing(self._particles.positions, self._rng)

    def _carry(self) -> None:
        """Particles in the inlet move as prescribed."""
        velocities, affine = self._particles.velocities.copy(), self._particles.affine.copy()
        self._inlet.carry(self._particles.positions, velocities, affine, self.time)
        self._particles = replace(self._particles, velocities=velocities, affine=affine)

    def _join(self, made: Particles) -> None:
        """New particles behind the others."""
        self._particles = self._particles.joined(made)

    def _add(
        self, places: np.ndarray, volume: float, look: np.ndarray | None = None, velocity: np.ndarray | None = None
    ) -> None:
        """New particles of one volume (m^3), with the rest Gaussians of `look` in turn, or as at the inlet."""
        places = places[~self.bodies.inside(places)] if len(places) else places
        if not len(places):
            return
        if look is None or not len(look):
            new = self._emit_source(places, self.time)
        else:
            new = Emitted.one_each(
                np.asarray(look, np.int64)[np.arange(self._next_id, self._next_id + len(places)) % len(look)]
            )
        positions = places[new.place] + new.offset
        astray = ~self._inlet.holds(positions) & new.offset.any(axis=1)
        kept = ~astray
        kept[np.unique(new.place, return_index=True)[1]] = True  # one of each place stays, at the place itself
        positions = np.where((astray & kept)[:, None], places[new.place], positions)[kept].astype(np.float32)
        place, source = new.place[kept], np.asarray(new.source, np.int64)[kept]
        mass = self.parameters.density * volume / np.bincount(place, minlength=len(places))[place]
        moves = None if velocity is None else np.broadcast_to(velocity, positions.shape)
        made = Particles.at_rest(positions, mass, source, moves, first_id=self._next_id)
        self._next_id += len(positions)
        self._join(made)

    def _emitters_switched(self) -> None:  # noqa: B027
        """An emitter has come on or gone off; for simulators that keep what depends on it."""
