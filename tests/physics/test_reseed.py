"""Splitting and merging of particles."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.physics import boundaries, transfer
from fluidlift.physics.reseed import FEWEST, MOST, WHOLE, inner_cells, reseed, thickened
from fluidlift.types import CellType, Grid, Particles, Terrain, TriangleMesh

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


def filled(counts, *, most=10_000, distance=None):
    body = swarm(counts)
    cells = np.where(np.arange(6) < 4, CellType.FLUID, CellType.EMPTY) * np.ones(GRID.shape, np.uint8)
    nodes = np.full((7, 7, 7), 1.0) if distance is None else distance
    after = thickened(body, cells.astype(np.uint8), np.float32(nodes), GRID, most=most, rng=np.random.default_rng(2))
    per_cell = np.zeros(GRID.shape, int)
    np.add.at(per_cell, tuple(GRID.cell_of(after.positions).T), 1)
    return body, after, per_cell


def test_a_body_is_as_thick_inside_as_its_cells_and_its_surface_stays_as_it_is():
    counts = np.random.default_rng(3).integers(0, 10, GRID.shape)
    counts[:, :, 4:] = 0
    body, after, per_cell = filled(counts)
    assert (per_cell[:, :, :3] >= np.minimum(WHOLE, counts[:, :, :3])).all()
    # an octant with two particles leaves the cell one place less; of random places half share one at most
    assert (per_cell[:, :, :3] >= WHOLE).mean() > 0.95 and (per_cell[:, :, :3] > 0).all()
    np.testing.assert_array_equal(per_cell[:, :, 3:], counts[:, :, 3:])
    np.testing.assert_array_equal(after.positions[: len(body)], body.positions)
    new = after.select(np.arange(len(body), len(after)))
    assert len(np.unique(after.ids)) == len(after) and new.ids.min() == body.ids.max() + 1
    away = np.linalg.norm(new.positions[:, None] - body.positions[None], axis=-1)
    nearest = away.argmin(axis=1)
    np.testing.assert_array_equal(new.source, body.source[nearest])
    np.testing.assert_array_equal(new.velocities, body.velocities[nearest])


def test_of_a_few_the_emptiest_cells_get_theirs_first_and_the_solid_none():
    counts = np.full(GRID.shape, 4)
    counts[:, :, 4:] = 0
    counts[1:3, 1:3, 1] = 0
    _, after, per_cell = filled(counts, most=8)
    assert (per_cell[1:3, 1:3, 1] == 2).all() and len(after) == counts.sum() + 8
    distance = GRID.nodes()[..., 0] - 0.3
    body, after, _ = filled(counts, distance=distance)
    new = after.positions[len(body) :]
    assert len(new) and (new[:, 0] > 0.3).all()
