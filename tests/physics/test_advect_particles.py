"""Moves of particles: kernels against their plain twins."""

import numpy as np

from fluidlift.physics.advect_particles import displacements, displacements_plain, leaving, leaving_plain
from fluidlift.physics.boundaries import build_walls
from fluidlift.types import CellType, Grid, Terrain, TriangleMesh

RNG = np.random.default_rng(4)


def test_displacements_are_those_of_the_formula():
    velocities = RNG.normal(size=(9001, 3)).astype(np.float32)
    affine = (5 * RNG.normal(size=(9001, 3, 3))).astype(np.float32)
    moves, farthest = displacements(velocities, affine, 0.02)
    plain, plain_farthest = displacements_plain(velocities, affine, 0.02)
    np.testing.assert_allclose(moves, plain, atol=1e-6 * plain_farthest)  # single precision
    assert abs(farthest - plain_farthest) < 1e-6 * plain_farthest


def test_a_rotating_particle_stays_on_its_circle_to_third_order():
    spin = np.array([[[0, -1, 0], [1, 0, 0], [0, 0, 0]]], np.float32)
    for dt in (0.2, 0.1):
        moves, _ = displacements(np.array([[0, 1, 0]], np.float32), spin, dt)
        exact = np.array([np.cos(dt) - 1, np.sin(dt), 0])
        # x'' is exact; the next term of the Taylor series is dt^3 / 6
        assert np.abs(moves[0] - exact).max() < dt**3 / 6 * 1.01


def test_a_velocity_that_is_not_a_number_is_seen_wherever_it_stands():
    for index in (0, 4095, 4096, 8999):
        velocities = np.ones((9001, 3), np.float32)
        velocities[index, 1] = np.nan
        assert not np.isfinite(displacements(velocities, np.zeros((9001, 3, 3), np.float32), 0.1)[1])


def test_particles_leave_through_the_box_and_the_outlet_alike():
    grid = Grid((8, 6, 5), 0.1)
    types = np.zeros(grid.shape, np.uint8)
    types[5:7] = CellType.OUTFLOW
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(grid, np.ones((9, 7, 6), np.float32), np.array([1.0, 0, 0]), mesh)
    walls = build_walls(terrain, types, np.zeros((3, 2), bool))
    before = (RNG.uniform(0, 1, (5000, 3)) * [0.8, 0.6, 0.5]).astype(np.float32)
    after = (before + RNG.normal(size=before.shape) * 0.1).astype(np.float32)
    out = leaving(before, after, walls, terrain.mainstream)
    np.testing.assert_array_equal(out, leaving_plain(before, after, walls, terrain.mainstream))
    inside = grid.contains(after)
    assert out[~inside].all() and 0 < out[inside].sum() < inside.sum()
