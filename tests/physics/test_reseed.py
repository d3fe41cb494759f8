"""Splitting and merging of particles."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.physics import boundaries, transfer
from fluidlift.physics.reseed import FEWEST, MOST, inner_cells, reseed
from fluidlift.types import Grid, Particles, Terrain, TriangleMesh

GRID = Grid((6, 6, 6), 0.1)


def walls(distance=None):
    nodes = np.full((7, 7, 7), 1.0) if distance is None else distance
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(GRID, np.float32(nodes), np.array([1.0, 0, 0]), mesh)
    return boundaries.build_walls(terrain, np.zeros(GRID.shape, np.uint8), np.zeros((3, 2), bool))


def swarm(counts, seed=0):
    """Random particles, `counts` per cell, moving and shearing."""
    rng = np.random.default_rng(seed)
    cells = np.repeat(np.argwhere(np.ones(GRID.shape, bool)), counts.ravel(), axis=0)
    positions = (cells + rng.uniform(0.3, 0.7, cells.shape)) * GRID.spacing
    body = Particles.at_rest(positions, 1.0, np.arange(len(cells)), rng.normal(size=cells.shape), first_id=10)
    masses = rng.uniform(0.5, 1.5, len(cells)) * 1000 * GRID.spacing**3 / 8
    return replace(body, affine=rng.normal(size=(len(cells), 3, 3)).astype(np.float32), masses=np.float32(masses))


def run(body, where, **options):
    order = transfer.sort_by_cell(body.positions, GRID)
    inner = inner_cells((np.diff(order.start) > 0).reshape(GRID.shape), where.solid)
    return reseed(body, order, inner, where, density=1000.0, first_id=5000, rng=np.random.default_rng(1), **options)


def momenta(body):
    m = body.masses.astype(float)[:, None]
    return m.sum(), (m * body.velocities).sum(axis=0)


def test_thin_inner_cells_are_filled_and_nothing_at_the_surface_is_touched():
    counts = np.full(GRID.shape, 8)
    counts[:, :, 4:] = 0
    counts[2, 2, 1] = counts[3, 2, 3] = 1  # the second lies at the surface
    body = swarm(counts)
    result = run(body, walls())
    assert (result.split, result.merged) == (1, 0)
    assert len(result.particles) == len(body) + 1 and result.particles.ids.max() == 5000
    changed = (result.particles.positions[: len(body)] != body.positions).any(axis=1)
    assert changed.sum() == 1 and tuple(GRID.cell_of(body.positions[changed])[0]) == (2, 2, 1)
    assert result.particles.source[-1] == body.source[changed][0]


def test_splitting_keeps_mass_momentum_and_the_affine_field():
    counts = np.full(GRID.shape, 8)
    counts[1:5, 1:5, 1:5] = 1
    body = swarm(counts)
    result = run(body, walls()).particles
    assert len(result) == len(body) + 64
    (mass, momentum), (new_mass, new_momentum) = momenta(body), momenta(result)
    # single precision of the stored numbers, summed over some thousand particles
    np.testing.assert_allclose(new_mass, mass, rtol=1e-6)
    np.testing.assert_allclose(new_momentum, momentum, atol=1e-5 * mass)
    halves = result.positions[: len(body)] != body.positions
    parent = np.flatnonzero(halves.any(axis=1))
    apart = result.positions[parent] - body.positions[parent]
    gained = np.einsum("nij,nj->ni", body.affine[parent], apart)
    np.testing.assert_allclose(result.velocities[parent] - body.velocities[parent], gained, atol=1e-5)


def test_crowded_inner_cells_merge_their_lightest_and_keep_mass_and_momentum():
    counts = np.full(GRID.shape, 8)
    counts[3, 3, 3] = MOST + 5
    body = swarm(counts)
    result = run(body, walls())
    assert (result.split, result.merged) == (0, 3)
    crowded = (GRID.cell_of(body.positions) == [3, 3, 3]).all(axis=1)
    gone = ~np.isin(body.ids, result.particles.ids)
    assert gone.sum() == 3 and crowded[gone].all()
    assert body.masses[gone].max() <= np.sort(body.masses[crowded])[5]
    before, after = momenta(body), momenta(result.particles)
    np.testing.assert_allclose(after[0], before[0], rtol=1e-6)
    np.testing.assert_allclose(after[1], before[1], atol=1e-5 * before[0])


@pytest.mark.parametrize("rounds", [12])
def test_splitting_ends_before_particles_turn_to_dust(rounds):
    counts = np.full(GRID.shape, 8)
    counts[2:4, 2:4, 2:4] = 1
    body = swarm(counts)
    smallest = []
    for number in range(rounds):
        order = transfer.sort_by_cell(body.positions, GRID)
        inner = inner_cells((np.diff(order.start) > 0).reshape(GRID.shape), walls().solid)
        body = reseed(
            body,
            order,
            inner,
            walls(),
            density=1000.0,
            first_id=10000 * (number + 1),
            rng=np.random.default_rng(number),
        ).particles
        smallest.append(float(body.masses.min()))
    assert len(np.unique(body.ids)) == len(body)
    # a parent has at least a quarter of the nominal mass, so a half has at least an eighth
    assert min(smallest) >= 0.125 * 1000 * GRID.spacing**3 / 8
    filled = np.diff(transfer.sort_by_cell(body.positions, GRID).start).reshape(GRID.shape)[2:4, 2:4, 2:4]
    assert filled.min() >= FEWEST


def test_no_half_is_placed_in_the_solid():
    distance = GRID.nodes()[..., 2] - 0.115
    counts = np.full(GRID.shape, 8)
    counts[:, :, 0] = 0
    counts[:, :, 1] = 1
    body = swarm(counts)
    body = body.select(body.positions[:, 2] > 0.13)
    result = run(body, walls(distance))
    assert result.split > 0
    assert (result.particles.positions[:, 2] > 0.115).all()
