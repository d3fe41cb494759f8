"""Standard scenes of free-surface flow, ready for the liquid simulator: the set-ups that experiments and theory know.

The lengths of a scene are given relative to one of them, its `size`. Liquid between a floor and a surface is filled to
the exact height: its layers of particles are spaced to fit. In all builders `gravity` is in m/s^2, `viscosity` is the
kinematic one in m^2/s, and `seed` that of the jitter of the particles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import UInt8

from fluidlift.errors import require
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.rigid import RigidBody
from fluidlift.synthetic.filling import PER_AXIS, between, inside, terrain_of, within
from fluidlift.types import GRAVITY, CellType, FluidParameters, Grid, Particles, Terrain

WATER, HONEY = 1e-6, 7e-3
"""kinematic viscosity, m^2/s"""


@dataclass(frozen=True)
class Tank:
    """A liquid at its start, and all that the simulator needs."""

    name: str
    grid: Grid
    terrain: Terrain
    parameters: FluidParameters
    particles: Particles
    cell_types: UInt8[np.ndarray, "nx ny nz"]
    size: float
    """m, the length that all others are multiples of; each builder says which"""
    fill: float
    """m^3 of liquid at the start, exact"""
    bodies: tuple[RigidBody, ...] = ()

    def simulator(self, **options: Any) -> LiquidSimulator:
        """A simulator at time 0; `options` are keywords of `LiquidSimulator` (settings, seed, bodies, ...)."""
        if self.bodies:
            options.setdefault("bodies", list(self.bodies))
        return LiquidSimulator(
            self.grid, self.terrain, self.parameters, self.particles, cell_types=self.cell_types, **options
        )

    def with_bodies(self, *bodies: RigidBody) -> Tank:
        """The tank with bodies in it. They take the place of the liquid, whose level is not raised."""
        taken = np.zeros(len(self.particles), bool)
        for body in bodies:
            taken |= within(body, self.particles.positions, 0.5 * self.grid.spacing)
        fill = self.fill * (1.0 - taken.sum() / max(len(taken), 1))
        return replace(self, bodies=self.bodies + bodies, particles=self.particles.select(~taken), fill=fill)


def tank_of(
    name: str,
    grid: Grid,
    positions: np.ndarray,
    fill: float,
    *,
    size: float,
    terrain: Terrain | None = None,
    cell_types: np.ndarray | None = None,
    **parameters: Any,
) -> Tank:
    """A tank of particles at the inflow's velocity or at rest; the longest step is half the fall time of a cell."""
    gravity = parameters.pop("gravity", (0.0, 0.0, -GRAVITY))
    pull = max(float(np.linalg.norm(gravity)), 1e-12)
    parameters.setdefault("time_step", 0.5 * float(np.sqrt(grid.spacing / pull)))
    fluid = FluidParameters(gravity=gravity, **parameters)
    velocities = np.tile(np.array(fluid.inflow_velocity, np.float32), (len(positions), 1))
    particles = Particles.at_rest(positions, fluid.density * fill / max(len(positions), 1), velocities=velocities)
    types = np.zeros(grid.shape, np.uint8) if cell_types is None else cell_types
    return Tank(name, grid, terrain or terrain_of(grid), fluid, particles, types, size, fill)


def _counts(*lengths: float, spacing: float) -> tuple[int, ...]:
    """Cells along lengths; the last may be cut in part."""
    return tuple(max(1, int(np.ceil(length / spacing - 1e-6))) for length in lengths)


def dam_break(
    *,
    cells: int = 12,
    base: float = 0.05715,
    aspect: float = 2.0,
    length: float = 5.0,
    width_cells: int = 4,
    gravity: float = GRAVITY,
    seed: int = 0,
) -> Tank:
    """A column of water in the corner of a dry tank, released at once (Martin and Moyce 1952; theirs had 2 1/4 inch).

    Args:
        cells: across the base of the column.
        base: width of the column along x, m (`size`).
        aspect: height over width of the column (their n^2).
        length: of the tank, in bases.
        width_cells: cells across the tank.
    """
    require(cells >= 2 and length > 1 and aspect > 0, "a dam of no size")
    h = base / cells
    nx, nz = _counts(length * base, 1.25 * aspect * base, spacing=h)
    grid = Grid((nx, width_cells, nz), h)
    positions, fill = between(grid, 0.0, aspect * base, x=(0.0, base), seed=seed)
    return tank_of("dam break", grid, positions, fill, size=base, kinematic_viscosity=WATER, gravity=(0, 0, -gravity))


def standing_wave(
    *,
    cells: int = 32,
    length: float = 1.0,
    depth: float = 0.5,
    amplitude: float = 0.03,
    mode: int = 1,
    width_cells: int = 4,
    gravity: float = GRAVITY,
    viscosity: float = WATER,
    seed: int = 0,
) -> Tank:
    """A tank whose surface starts at rest as z = depth + amplitude cos(mode pi x / length): it sloshes.

    Args:
        cells: along the tank.
        length: of the tank, m (`size`).
        depth: mean depth over length.
        amplitude: over length.
        mode: half waves in the tank; 0 is still water.
        width_cells: cells across the tank.
    """
    require(0 <= amplitude < depth, f"an amplitude of {amplitude} in a depth of {depth}", "less than the depth")
    h = length / cells
    # headroom: run-up at the wall can be twice as high as the wave
    nx, nz = _counts(length, (depth + 2.5 * amplitude) * length + 2 * h, spacing=h)
    grid = Grid((nx, width_cells, nz), h)

    def surface(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return length * (depth + (amplitude * np.cos(mode * np.pi * x / length) if mode else np.zeros_like(x)))

    positions, fill = between(grid, 0.0, surface, seed=seed)
    return tank_of(
        "standing wave", grid, positions, fill, size=length, kinematic_viscosity=viscosity, gravity=(0, 0, -gravity)
    )


def river(
    *,
    cells: int = 64,
    length: float = 4.0,
    slope: float = 0.05,
    depth: float = 0.10,
    speed: float = 1.2,
    boulders: bool = True,
    seed: int = 0,
) -> Tank:
    """A rocky reach that falls along +x between banks: water flows in at a set speed and out freely.

    Args:
        cells: along the reach.
        length: of the reach, m (`size`).
        slope: fall over length of the bed.
        depth: of the water at the start in the middle of the channel, over length / 2.
        speed: of the inflow, m/s.
        boulders: with rocks in the stream; else a straight channel.
    """
    h, half = length / cells, 0.2 * length
    fall, foot = slope * length, 0.02 * length
    ny, nz = _counts(2 * half, fall + foot + 0.14 * length, spacing=h)
    grid = Grid((cells, ny, nz), h, (0.0, -0.5 * ny * h, 0.0))
    stones = ((0.3, 0.02, 0.034), (0.47, -0.1, 0.026), (0.55, 0.085, 0.045), (0.72, -0.03, 0.03), (0.16, -0.12, 0.03))

    def bed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        off = np.abs(y) / half
        bank = 0.10 * length * np.clip((off - 0.62) / 0.38, 0.0, 1.0) ** 1.5
        ripple = 0.004 * length * np.sin(9 * np.pi * x / length) * np.cos(3 * np.pi * y / half) if boulders else 0.0
        return foot + fall - slope * x + bank + ripple

    def solid(points: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(points, -1, 0)
        # the bed rises at most by 1.3: its height over that slope is a distance
        out = (z - bed(x, y)) / np.hypot(1.0, 0.35)
        for sx, sy, radius in stones if boulders else ():
            center = np.array([sx * length, sy * length, 0.0])
            center[2] = foot + fall - slope * center[0] + 0.35 * radius * length
            out = np.minimum(out, np.linalg.norm((points - center) * [1.0, 1.0, 1.15], axis=-1) - radius * length)
        return out

    level = 0.5 * depth * length
    terrain = terrain_of(grid, solid, (1.0, 0.0, -slope))
    positions, _ = between(grid, bed, lambda x, y: foot + fall - slope * x + level, seed=seed)
    positions = positions[solid(positions) > 0.25 * h / PER_AXIS]
    fill = len(positions) * (h / PER_AXIS) ** 3
    centers = grid.centers()
    wet = centers[..., 2] < foot + fall - slope * centers[..., 0] + level
    types = np.zeros(grid.shape, np.uint8)
    types[:2][wet[:2]] = CellType.INFLOW
    types[-2:] = CellType.OUTFLOW
    return tank_of(
        "river", grid, positions, fill, size=length, terrain=terrain, cell_types=types, kinematic_viscosity=WATER,
        inflow_velocity=(speed, 0.0, -speed * slope),
    )  # fmt: skip


def honey_slope(*, cells: int = 64, length: float = 0.32, angle: float = 20.0, seed: int = 0) -> Tank:
    """A lump of honey let go on a sticky board that falls along +x.

    Args:
        cells: along the board.
        length: of the box, m (`size`).
        angle: of the board, degrees.
    """
    h, tilt = length / cells, np.radians(angle)
    drop = length * np.tan(tilt)
    ny, nz = _counts(0.6 * length, drop + 0.22 * length, spacing=h)
    grid = Grid((cells, ny, nz), h, (0.0, -0.5 * ny * h, 0.0))

    def board(x: np.ndarray) -> np.ndarray:
        return 0.03 * length + drop - np.tan(tilt) * x

    def solid(points: np.ndarray) -> np.ndarray:
        return (points[..., 2] - board(points[..., 0])) * np.cos(tilt)

    center = np.array([0.2 * length, 0.0, board(np.array(0.2 * length)) + 0.02 * length])
    radius = 0.13 * length

    def lump(points: np.ndarray) -> np.ndarray:
        return np.maximum(np.linalg.norm(points - center, axis=-1) - radius, -solid(points) + 0.1 * h)

    positions = inside(grid, lump, seed=seed)
    fill = len(positions) * (h / PER_AXIS) ** 3
    return tank_of(
        "honey on a slope", grid, positions, fill, size=length,
        terrain=terrain_of(grid, solid, (np.cos(tilt), 0.0, -np.sin(tilt))), density=1400.0,
        kinematic_viscosity=HONEY, wall_damping=1.0,
    )  # fmt: skip


def thread(
    *,
    cells: int = 40,
    width: float = 0.06,
    height: float = 0.09,
    radius: float = 0.003,
    speed: float = 0.15,
    viscosity: float = 2e-2,
) -> Tank:
    """A thin thread that falls on a plate: honey coils or folds there, water spreads (Taylor 1969; Ribe 2004).

    Args:
        cells: across the box.
        width: of the box, m (`size`).
        height: of fall above the plate, m.
        radius: of the nozzle, m.
        speed: at the nozzle, m/s.
    """
    h = width / cells
    plate = 2.5 * h
    (nz,) = _counts(plate + height, spacing=h)
    grid = Grid((cells, cells, nz), h, (-width / 2, -width / 2, 0.0))
    centers = grid.centers()
    nozzle = (np.hypot(centers[..., 0], centers[..., 1]) < radius) & (centers[..., 2] > grid.high[2] - 2 * h)
    require(bool(nozzle.any()), f"a nozzle of {radius} m on cells of {h:.3g} m", "cells no larger than the nozzle")
    types = np.zeros(grid.shape, np.uint8)
    types[nozzle] = CellType.INFLOW
    terrain = terrain_of(grid, lambda points: points[..., 2] - plate, (0.0, 0.0, -1.0))
    return tank_of(
        "thread", grid, np.zeros((0, 3)), 0.0, size=width, terrain=terrain, cell_types=types, density=1400.0,
        kinematic_viscosity=viscosity, inflow_velocity=(0.0, 0.0, -speed), wall_damping=1.0,
    )  # fmt: skip


def pool(
    *, cells: int = 24, width: float = 0.6, depth: float = 0.5, headroom: float = 0.4, viscosity: float = WATER,
    seed: int = 0,
) -> Tank:  # fmt: skip
    """Still water in a square box, to put bodies in (`Tank.with_bodies`).

    Args:
        cells: across the pool.
        width: of the pool, m (`size`).
        depth: of the water, over the width.
        headroom: height of the box above the water, over the width.
    """
    h = width / cells
    (nz,) = _counts((depth + headroom) * width, spacing=h)
    grid = Grid((cells, cells, nz), h, (-width / 2, -width / 2, 0.0))
    positions, fill = between(grid, 0.0, depth * width, seed=seed)
    return tank_of("pool", grid, positions, fill, size=width, kinematic_viscosity=viscosity)


def drop(
    *,
    cells: int = 40,
    width: float = 0.06,
    radius: float = 0.1,
    depth: float = 0.15,
    speed: float = 1.5,
    gravity: float = GRAVITY,
    viscosity: float = WATER,
    seed: int = 0,
) -> Tank:
    """A ball of liquid above a shallow pool; without gravity and pool, a drop that floats.

    Args:
        cells: across the box.
        width: of the box, m (`size`).
        radius: of the drop, over the width.
        depth: of the pool, over the width; 0: none.
        speed: of the drop downwards, m/s.
        gravity: 0 is allowed.
    """
    h = width / cells
    grid = Grid((cells, cells, cells), h, (-width / 2, -width / 2, 0.0))
    center = np.array([0.0, 0.0, width * (0.5 if depth == 0 else depth + 2.0 * radius)])
    ball = inside(grid, lambda points: np.linalg.norm(points - center, axis=-1) - radius * width, seed=seed)
    still, volume = between(grid, 0.0, depth * width, seed=seed + 1) if depth > 0 else (np.zeros((0, 3)), 0.0)
    fill = volume + 4.0 / 3.0 * np.pi * (radius * width) ** 3
    pull = gravity if gravity > 0 else GRAVITY
    tank = tank_of(
        "drop", grid, np.concatenate([ball, still]), fill, size=width, gravity=(0, 0, -gravity),
        kinematic_viscosity=viscosity, time_step=0.5 * float(np.sqrt(h / pull)),
    )  # fmt: skip
    tank.particles.velocities[: len(ball)] = (0.0, 0.0, -speed)
    return tank
