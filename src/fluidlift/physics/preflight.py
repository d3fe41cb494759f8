"""What would fail during a simulation, said before it begins, with the numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.boundaries import build_walls
from fluidlift.physics.emitter import Emitter, emitter_distance
from fluidlift.types import CellType, Grid, Terrain

BYTES_PER_CELL = 200
"""peak memory of the liquid simulator per cell of its box: measured, see tests/physics/test_preflight.py"""

BYTES_PER_PARTICLE = 450
"""peak memory per particle: its state, the next one, a checkpoint, and what is on the way to the grid"""

LARGEST_SHARE = 0.9
"""of the memory that is free: more would make the machine swap"""

MOST_FRAMES = 100_000
"""more than an hour at 25 frames per second: rather a slip in --duration or --fps"""


def simulation_bytes(grid: Grid, particles: int) -> int:
    """Memory that a simulation needs, about."""
    return grid.cells * BYTES_PER_CELL + particles * BYTES_PER_PARTICLE


def check_memory(grid: Grid, particles: int, available: int) -> None:
    """Args: `available` bytes.

    Raises:
        InputRejected: the grid and the particles need more.
    """
    needed = simulation_bytes(grid, particles)
    if needed > LARGEST_SHARE * available:
        raise InputRejected(
            f"a grid of {' x '.join(map(str, grid.shape))} = {grid.cells:,} cells and {particles:,} particles need "
            f"about {needed / 1e9:.1f} GB, and {available / 1e9:.1f} GB are free",
            f"at most {LARGEST_SHARE * available / 1e9:.1f} GB",
            "make the asset with fewer cells (--set shape.cells=..., shape.cell_limit=...), extend it by less, "
            "or free some memory",
        )  # fmt: skip


def check_frames(frames: int, interval: float, time_step: float, max_substeps: int) -> None:
    """Args: `frames` to simulate, `interval` (s) between them, longest `time_step` (s), most substeps per frame.

    Raises:
        InputRejected: more frames than anyone wants, or frames so far apart that each is a simulation of its own.
    """
    if frames > MOST_FRAMES:
        raise InputRejected(
            f"{frames:,} frames ({frames * interval:.4g} s at {1 / interval:.4g} per second)",
            f"at most {MOST_FRAMES:,}", "check --duration and --fps",
        )  # fmt: skip
    if interval > max_substeps * time_step:
        raise InputRejected(
            f"{interval / time_step:,.0f} steps of {time_step:.3g} s from one frame to the next",
            f"at most {max_substeps:,}: frames less than {max_substeps * time_step:.3g} s apart",
            f"give an --fps of {np.ceil(1 / (max_substeps * time_step)):g} or more",
        )  # fmt: skip


def check_inlet(terrain: Terrain, cell_types: np.ndarray, velocity: np.ndarray) -> None:
    """Whether what flows in can flow on.

    Args:
        terrain: the solid.
        cell_types: u8 [nx,ny,nz].
        velocity: [3], m/s, bulk velocity at the inlet.

    Raises:
        InputRejected: INFLOW cells that all lie in the solid, or an inlet whose velocity points into walls only.
    """
    inlet = cell_types == CellType.INFLOW
    if not inlet.any():
        return
    walls = build_walls(terrain, cell_types, np.ones((3, 2), bool))
    open_inlet = inlet & ~walls.solid
    if not open_inlet.any():
        raise InputRejected(
            f"all {int(inlet.sum())} inflow cells lie inside the terrain", "an inlet with open cells",
            "make the asset again, or move the obstacle or the terrain away from the inlet",
        )  # fmt: skip
    velocity = np.asarray(velocity, np.float64)
    speed = float(np.linalg.norm(velocity))
    if speed == 0.0:
        return
    flux = _outward_flux(open_inlet, walls.openings, walls.solid, velocity, terrain.grid.spacing)
    if flux <= 0.0:
        raise InputRejected(
            f"the inlet's velocity ({', '.join(f'{v:.3g}' for v in velocity)}) m/s points into walls on all of its "
            f"{int(open_inlet.sum())} open cells", "a direction in which the inlet is open",
            "check inflow_velocity in scene.yaml",
        )  # fmt: skip


MOST_AT_ONCE = 1_000_000
"""particles that an emitter may hold: more would rather be a mesh in the wrong unit"""


def check_emitters(emitters: Sequence[Emitter], terrain: Terrain) -> None:
    """Whether every emitter has room to emit.

    Raises:
        InputRejected: one whose mesh bounds no solid, or that is huge, lies outside the box or inside the ground; the
            message names its line.
    """
    grid = terrain.grid
    for emitter in emitters:
        extent = np.ptp(np.asarray(emitter.mesh.vertices, np.float64), axis=0)
        if float(np.prod(2 * extent / grid.spacing)) > MOST_AT_ONCE:
            raise InputRejected(
                f"{emitter.line}: emitter '{emitter.name}' is {' x '.join(f'{x:.3g}' for x in extent)} m large",
                f"at most {MOST_AT_ONCE:,} particles at once, {0.5 * grid.spacing:.3g} m apart", "make it smaller",
            )  # fmt: skip
        found = emitter_distance(emitter, grid.spacing)
        inside = found.grid.nodes()[found.distance <= 0].reshape(-1, 3)
        box = " to ".join(str(tuple(round(float(x), 2) for x in corner)) for corner in (grid.low, grid.high))
        name, middle = f"{emitter.line}: emitter '{emitter.name}'", np.round(inside.mean(axis=0), 3).tolist()
        within = inside[grid.contains(inside)]
        if not len(within):
            raise InputRejected(
                f"{name} around {middle} lies outside the simulated box", f"a place within {box} m",
                "change its position",
            )  # fmt: skip
        if not (sample_nodes(terrain.signed_distance, grid, within) > 0).any():
            raise InputRejected(
                f"{name} around {middle} lies inside the ground", "a place in the open", "lift its position"
            )


def _outward_flux(inlet: np.ndarray, openings: tuple, solid: np.ndarray, velocity: np.ndarray, spacing: float) -> float:
    """m^3/s through the open faces from inlet cells to other open cells, where the velocity points that way."""
    total = 0.0
    for axis in range(3):
        here = np.moveaxis(inlet, axis, 0)
        free = np.moveaxis(~inlet & ~solid, axis, 0)
        opening = np.moveaxis(openings[axis], axis, 0)[1:-1]
        up, down = here[:-1] & free[1:], here[1:] & free[:-1]
        share = float((opening * up).sum()) if velocity[axis] > 0 else float((opening * down).sum())
        total += share * abs(velocity[axis])
    return total * spacing**2
