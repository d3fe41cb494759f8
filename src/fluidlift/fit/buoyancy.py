"""The buoyancy of smoke, from how high its outline rises.

Over the few frames of a window of velocities, lift changes the speed of smoke by less than optical flow errs: they do
not determine it. Over the clip it decides how high the smoke gets. So the smoke is simulated as a whole, and its
buoyancy is the one with which its upper end is, in the mean over the frames, as high as that of the clip's outline.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.errors import FluidliftError
from fluidlift.fit.coarsen import coarsen_cells, coarsen_terrain, coarsen_velocity
from fluidlift.numerics.outline import upper_end
from fluidlift.physics.gas import GasSimulator
from fluidlift.physics.surroundings import SimulationSettings
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Particles, PinholeCamera, Terrain

MOST_CELLS = 64_000
"""of the grid on which the search simulates; its result is corrected by one simulation on all cells"""
PER_SIDE = 2
"""particles along each side of a cell"""
MOST_FRAMES = 96
"""that are followed: later ones say how smoke mixes rather than how it rises"""
FEWEST_FRAMES = 6
"""in which the upper end is in the picture; fewer are no course"""
LEAST_RISE = 0.1
"""of the body's height, that the outline must rise by: a plume that stands as high as it gets says nothing"""
WIDEST = 32.0
"""factor on either side of the first guess that is looked at"""
STRIDE = math.log(3.0)
"""of the logarithm, until the root is between two values"""
MOST_RUNS, LAST_RUNS = 12, 4
"""on the wide cells, and how many of them are left for the second search"""
CLOSE = 0.15
"""of a cell, mean error of the height at which the search ends"""


@dataclass(frozen=True)
class RisingSmoke:
    """Smoke at its first instant, and the outlines of all that follow."""

    terrain: Terrain
    cell_types: UInt8[np.ndarray, "nx ny nz"]
    velocity: FaceVelocity
    """of the whole box, m/s"""
    parameters: FluidParameters
    """all of them; the size of `gravity` is not used"""
    camera: PinholeCamera
    """of the outlines, in the world"""
    interval: float
    """s between frames"""
    outline: Callable[[int], Bool[np.ndarray, "h w"]]
    """of a frame, 0 the first instant"""
    frames: int

    def coarser(self) -> RisingSmoke:
        """On cells twice as wide."""
        return replace(
            self, terrain=coarsen_terrain(self.terrain), cell_types=coarsen_cells(self.cell_types),
            velocity=coarsen_velocity(self.velocity),
        )  # fmt: skip


@dataclass(frozen=True)
class Buoyancy:
    """What the outlines say."""

    value: float
    """m/s^2"""
    sigma: float
    """m/s^2: a cell of error in the height"""
    frames: int
    """that were followed"""
    runs: int
    """simulations that it took"""


def buoyancy_from_rise(
    smoke: RisingSmoke, guess: float, *, step: Callable[[int, int], None] = lambda done, total: None
) -> Buoyancy | None:
    """The buoyancy with which simulated smoke rises like the clip's; None where its outline does not say.

    Heights grow with buoyancy: the root of their mean difference is bracketed and found on the logarithm.

    Args:
        smoke: see there.
        guess: m/s^2, where the search starts.
        step: told (simulations done, at most).
    """
    fine = smoke
    while smoke.terrain.grid.cells > MOST_CELLS and min(smoke.terrain.grid.shape) >= 12:
        smoke = smoke.coarser()
    seen = course(smoke.outline, smoke.frames)
    if seen is None or not guess > 0:
        return None
    cell = smoke.camera.focal[1] * smoke.terrain.grid.spacing / _distance(smoke)
    tried: dict[float, float] = {}

    def missing(level: float) -> float:
        """Mean height in px by which the simulated end is too low, the difference of the first frame taken off."""
        if level not in tried:
            step(len(tried), MOST_RUNS + 1)
            tried[level] = _missing_height(smoke, guess * math.exp(level), seen)
        return tried[level]

    close, reach, runs = CLOSE * cell, math.log(WIDEST), 0
    found = _root(missing, 0.0, reach, close, lambda: len(tried) >= MOST_RUNS - LAST_RUNS)
    if found is not None and fine is not smoke:
        # wide cells hold a narrow stem together, or wear it out: by what they are off at the root is off around it
        off, runs = _missing_height(fine, guess * math.exp(found), seen) - tried[found], 1
        if math.isfinite(off):
            found = _root(lambda level: missing(level) + off, found, reach, close, lambda: len(tried) >= MOST_RUNS)
    if found is None:
        return None
    near = sorted(tried, key=lambda level: abs(level - found))[:2]
    rise = abs((tried[near[0]] - tried[near[1]]) / (near[0] - near[1])) if len(near) > 1 else 0.0
    value = guess * math.exp(found)
    return Buoyancy(value, value * cell / rise if rise > 0 else math.inf, len(seen), len(tried) + runs)


def _root(
    missing: Callable[[float], float], x: float, reach: float, close: float, spent: Callable[[], bool]
) -> float | None:
    """Where a falling function is 0, from x on, between -reach and reach; the nearer end where it is 0 nowhere, None
    where it cannot be told."""
    value = missing(x)
    if not math.isfinite(value):
        return None
    best, low, high = (abs(value), x), None, None
    while not spent() and abs(value) > close:
        low, high = (x, high) if value > 0 else (low, x)
        if low is None or high is None:
            ahead = x + math.copysign(STRIDE, value)
            if abs(ahead) > reach:
                break
        else:
            # the chord, but not too near to an end: it may bend
            share = missing(low) / (missing(low) - missing(high))
            ahead = low + min(max(share, 0.15), 0.85) * (high - low)
        x, value = ahead, missing(ahead)
        if not math.isfinite(value):  # it blows up: what was tried before has to do
            break
        best = min(best, (abs(value), x))
    return best[1]


def _distance(smoke: RisingSmoke) -> float:
    """Camera z of the middle of the smoke, m."""
    centers = smoke.terrain.grid.centers()[smoke.cell_types == CellType.FLUID]
    return float(np.median(smoke.camera.project(centers)[1]))


def course(outline: Callable[[int], Bool[np.ndarray, "h w"]], frames: int) -> list[float] | None:
    """Rows of an outline's upper end in the frames until it leaves the picture; None where they say nothing.

    Args:
        outline: of a frame, counted from 0.
        frames: that there are; `MOST_FRAMES` are looked at.
    """
    ends: list[float] = []
    extent = 0.0
    for k in range(min(frames, MOST_FRAMES)):
        mask = np.asarray(outline(k), bool)
        if not mask.any() or mask[:2].any():
            break
        rows = np.flatnonzero(mask.any(axis=1))
        extent = extent or float(rows[-1] - rows[0] + 1)
        ends.append(upper_end(mask.sum(axis=1).astype(float)))
    if len(ends) < FEWEST_FRAMES:
        return None
    quarter = max(len(ends) // 4, 1)
    return ends if np.mean(ends[:quarter]) - np.mean(ends[-quarter:]) >= LEAST_RISE * extent else None


def _missing_height(smoke: RisingSmoke, buoyancy: float, seen: list[float]) -> float:
    """px by which the simulated upper end is too low in the mean; not a number where the simulation breaks down."""
    simulator, differences = _simulator(smoke, buoyancy), []
    try:
        for k, end in enumerate(seen):
            if k:
                simulator.advance(smoke.interval)
            differences.append(_simulated_end(smoke, simulator.particles.positions) - end)
    except FluidliftError:
        return math.nan
    return float(np.mean(differences) - differences[0])


def _simulator(smoke: RisingSmoke, buoyancy: float) -> GasSimulator:
    grid = smoke.terrain.grid
    inside = np.argwhere((smoke.cell_types == CellType.FLUID) | (smoke.cell_types == CellType.INFLOW))
    within = (np.array(list(np.ndindex(PER_SIDE, PER_SIDE, PER_SIDE))) + 0.5) / PER_SIDE
    positions = grid.low + grid.spacing * (inside[:, None] + within).reshape(-1, 3)
    # every particle of a cell has the same look: none is drawn
    particles = Particles.at_rest(positions.astype(np.float32), 1.0, np.zeros(len(positions), np.int64))
    parameters = replace(smoke.parameters, time_step=smoke.interval, inflow_fluctuation=0.0)
    return GasSimulator(
        grid, smoke.terrain, parameters, particles, cell_types=smoke.cell_types, buoyancy=buoyancy,
        velocity=smoke.velocity, inflow_profile=smoke.velocity, particles_per_cell=PER_SIDE**3,
        settings=SimulationSettings(deform=False),
    )  # fmt: skip


def _simulated_end(smoke: RisingSmoke, positions: Float[np.ndarray, "n 3"]) -> float:
    """Row of the upper end of the smoke as its particles cover the picture; 0 where all of it has left."""
    width, height = smoke.camera.size
    uv, z = smoke.camera.project(positions)
    ahead = z > 0
    if not ahead.any():
        return 0.0
    # a particle covers its part of a cell
    side = max(smoke.camera.focal[1] * smoke.terrain.grid.spacing / PER_SIDE / float(np.median(z[ahead])), 1.0)
    at = np.floor(uv[ahead] / side).astype(np.int64)
    columns, rows = math.ceil(width / side), math.ceil(height / side)
    at = at[((at >= 0) & (at < (columns, rows))).all(axis=1)]
    covered = np.zeros((rows, columns), bool)
    covered[at[:, 1], at[:, 0]] = True
    return side * upper_end(covered.sum(axis=1).astype(float)) if covered.any() else 0.0
