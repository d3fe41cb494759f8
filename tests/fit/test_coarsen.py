"""Halved resolution keeps what a fit lives on."""

import numpy as np
import pytest

from fluidlift.fit.coarsen import coarse_grid, coarsen_cells, coarsen_terrain, coarsen_velocity
from fluidlift.physics.pressure import divergence
from fluidlift.types import CellType, FaceVelocity, Grid, Terrain, TriangleMesh


def test_divergence_of_a_block_is_the_mean_of_its_cells():
    grid = Grid((6, 4, 8), 0.1)
    rng = np.random.default_rng(0)
    velocity = FaceVelocity(*(rng.standard_normal(grid.face_shape(a)) for a in range(3)))
    fine = divergence(velocity, grid)
    blocks = fine.reshape(3, 2, 2, 2, 4, 2).mean(axis=(1, 3, 5))
    # Gauss: inner faces cancel
    np.testing.assert_allclose(divergence(coarsen_velocity(velocity), coarse_grid(grid)), blocks, atol=1e-12)


@pytest.mark.parametrize("shape", [(6, 4, 8), (5, 3, 7)])
def test_shapes_agree_and_a_uniform_flow_stays(shape):
    grid = Grid(shape, 0.1)
    coarse = coarse_grid(grid)
    velocity = FaceVelocity(*(np.full(grid.face_shape(a), 1.0 + a) for a in range(3)))
    out = coarsen_velocity(velocity)
    assert out.shape == coarse.shape
    for axis, component in enumerate(out.components):
        np.testing.assert_allclose(component, 1.0 + axis, rtol=1e-15)
    assert coarsen_cells(np.ones(shape, np.uint8)).shape == coarse.shape
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    heights = grid.nodes()[..., 2] - 0.15
    terrain = coarsen_terrain(Terrain(grid, heights, np.array([1.0, 0.0, 0.0]), mesh))
    inside = tuple(slice(0, (n + 1) // 2) for n in shape)
    np.testing.assert_allclose(terrain.signed_distance[inside], coarse.nodes()[inside][..., 2] - 0.15, atol=1e-12)


def test_boundaries_survive_and_majorities_win():
    types = np.full((4, 4, 4), CellType.FLUID, np.uint8)
    types[0] = CellType.INFLOW
    types[:, :, 0:2] = CellType.SOLID
    types[2:, 2:, 3] = CellType.EMPTY
    coarse = coarsen_cells(types)
    assert coarse[0, 0, 1] == CellType.INFLOW
    assert (coarse[:, :, 0] == CellType.SOLID).all()
    assert coarse[1, 0, 1] == CellType.FLUID
    assert coarse[1, 1, 1] == CellType.FLUID
