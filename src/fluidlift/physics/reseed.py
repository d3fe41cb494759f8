"""Particle reseeding by splitting and merging: inner cells get neither empty of particles nor stuffed with them.

A particle splits into two halves, placed symmetrically about it with the velocity of its own affine field there; two
particles of one cell merge into their centre of mass. Both keep mass and linear momentum (the halves have m/2 each and
move with v + C d and v - C d). Only cells whose six neighbours hold liquid or are solid are touched, so that nothing
appears or vanishes at the visible surface. The older half keeps its id; the new one gets a fresh id and the look of its
parent; of two that merge the heavier one keeps its id and deformation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool
from numba import njit

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.boundaries import CLEARANCE, Walls
from fluidlift.physics.transfer import CellOrder, select_particles
from fluidlift.types import Particles

FEWEST = 2
"""particles in an inner cell below which its heaviest one splits"""
MOST = 16
"""above which its two lightest ones merge, pair by pair. Of eight per cell on the average, chance alone leaves one
cell in 400 with fewer than FEWEST and one in 300 with more than MOST: few are touched, about as many split as merge"""
LIGHTEST_PARENT = 0.25
"""of the mass of an eighth of a cell: lighter particles do not split"""
SPLIT_DISTANCE = 0.25
"""cells from the parent's place to each half"""


@dataclass(frozen=True)
class Reseeded:
    """The particles after reseeding."""

    particles: Particles
    split: int
    merged: int


def inner_cells(wet: Bool[np.ndarray, "nx ny nz"], solid: Bool[np.ndarray, "nx ny nz"]) -> Bool[np.ndarray, "nx ny nz"]:
    """Wet cells without a neighbour of air; the sides of the box count as solid."""
    closed = np.pad(wet | solid, 1, constant_values=True)
    inner = wet.copy()
    for axis in range(3):
        for shift in (slice(0, -2), slice(2, None)):
            index = [slice(1, -1)] * 3
            index[axis] = shift
            inner &= closed[tuple(index)]
    return inner


@njit(cache=True)
def sort_by_mass(index, masses):
    """In place; equal ones stay in their order. A cell holds few: Numba's own sort takes seconds to compile."""
    for n in range(1, len(index)):
        own, m = index[n], n
        while m > 0 and masses[index[m - 1]] > masses[own]:
            index[m] = index[m - 1]
            m -= 1
        index[m] = own


@njit(cache=True)
def _choose(order, start, inner, masses, lightest, fewest, most, parents, first, second):
    """Indices of the particles to split, and pairs (heavier, lighter) to merge; returns how many of each."""
    n_split, n_merge = 0, 0
    for c in range(len(inner)):
        count = start[c + 1] - start[c]
        if not inner[c] or count == 0:
            continue
        if count < fewest:
            best = order[start[c]]
            for m in range(start[c] + 1, start[c + 1]):
                if masses[order[m]] > masses[best]:
                    best = order[m]
            if masses[best] >= lightest:
                parents[n_split] = best
                n_split += 1
        elif count > most:
            by_mass = order[start[c] : start[c + 1]].copy()
            sort_by_mass(by_mass, masses)
            for pair in range((count - most + 1) // 2):
                second[n_merge] = by_mass[2 * pair]
                first[n_merge] = by_mass[2 * pair + 1]
                n_merge += 1
    return n_split, n_merge


def reseed(
    particles: Particles,
    order: CellOrder,
    inner: Bool[np.ndarray, "nx ny nz"],
    walls: Walls,
    *,
    density: float,
    first_id: int,
    rng: np.random.Generator,
) -> Reseeded:
    """Split where an inner cell holds fewer than `FEWEST` particles, merge where it holds more than `MOST`.

    Args:
        particles: kg and m.
        order: from `transfer.sort_by_cell`.
        inner: from `inner_cells`.
        walls: nothing is placed in the solid.
        density: kg/m^3.
        first_id: of the first new particle.
        rng: of the directions in which halves part.
    """
    if not len(particles):
        return Reseeded(particles, 0, 0)
    h = walls.grid.spacing
    nominal = density * h**3 / 8.0
    parents, heavy, light = (np.empty(len(particles), np.int64) for _ in range(3))
    n_split, n_merge = _choose(
        order.order, order.start, inner.ravel(), particles.masses, LIGHTEST_PARENT * nominal, FEWEST, MOST, parents,
        heavy, light,
    )  # fmt: skip
    if n_split == 0 and n_merge == 0:
        return Reseeded(particles, 0, 0)
    out, gone = _merged(particles, heavy[:n_merge], light[:n_merge])
    out, children = _split(out, parents[:n_split], walls, first_id, rng)
    if len(gone):
        kept = np.ones(len(particles), bool)
        kept[gone] = False
        out = select_particles(out, np.flatnonzero(kept))
    return Reseeded(out.joined(children) if len(children) else out, len(children), len(gone))


def _merged(particles: Particles, heavy: np.ndarray, light: np.ndarray) -> tuple[Particles, np.ndarray]:
    if not len(heavy):
        return particles, light
    arrays = {name: getattr(particles, name).copy() for name in ("positions", "velocities", "affine", "masses")}
    a, b = (particles.masses[index].astype(np.float64) for index in (heavy, light))
    for name in ("positions", "velocities", "affine"):
        value = arrays[name]
        shape = (-1,) + (1,) * (value.ndim - 1)
        share = (b / (a + b)).reshape(shape)
        value[heavy] = (1.0 - share) * value[heavy] + share * value[light]
    arrays["masses"][heavy] = a + b
    return replace(particles, **arrays), light


def _split(
    particles: Particles, parents: np.ndarray, walls: Walls, first_id: int, rng: np.random.Generator
) -> tuple[Particles, Particles]:
    grid = walls.grid
    directions = rng.normal(size=(len(parents), 3))
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    shift = SPLIT_DISTANCE * grid.spacing * directions
    center = particles.positions[parents].astype(np.float64)
    clear = CLEARANCE * grid.spacing
    fits = np.ones(len(parents), bool)
    for place in (center + shift, center - shift):
        fits &= grid.contains(place, clear) & (sample_nodes(walls.signed_distance, grid, place) > clear)
    parents, shift, center = parents[fits], shift[fits], center[fits]
    gained = np.einsum("nij,nj->ni", particles.affine[parents].astype(np.float64), shift)
    masses, positions, velocities = (getattr(particles, n).copy() for n in ("masses", "positions", "velocities"))
    masses[parents] *= np.float32(0.5)
    old = velocities[parents].astype(np.float64)
    positions[parents], velocities[parents] = center + shift, old + gained
    halved = replace(particles, masses=masses, positions=positions, velocities=velocities)
    children = replace(
        halved.select(parents),
        positions=(center - shift).astype(np.float32),
        velocities=(old - gained).astype(np.float32),
        ids=np.arange(first_id, first_id + len(parents), dtype=np.int64),
    )
    return halved, children
