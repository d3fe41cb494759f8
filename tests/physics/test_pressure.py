"""Projection onto divergence-free velocities."""

import numpy as np
import pytest

from fluidlift.physics.pressure import build_system, divergence, face_fractions, project
from fluidlift.types import CellType, FaceVelocity, Grid, Terrain, TriangleMesh

GRID = Grid((12, 10, 8), 0.1)


def random_velocity(seed=0, grid=GRID):
    rng = np.random.default_rng(seed)
    return FaceVelocity(*(rng.normal(size=grid.face_shape(a)).astype(np.float32) for a in range(3)))


def sphere_terrain(grid=GRID):
    distance = np.linalg.norm(grid.nodes() - np.array([0.6, 0.5, 0.2]), axis=-1) - 0.23
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    return Terrain(grid, distance.astype(np.float32), np.array([1.0, 0, 0]), mesh)


def layered_types():
    types = np.full(GRID.shape, CellType.EMPTY, np.uint8)
    types[:, :, :5] = CellType.FLUID
    types[0, :, :5] = CellType.INFLOW
    types[-1, :, :5] = CellType.OUTFLOW
    types[:, :, 0] = CellType.SOLID
    return types


@pytest.mark.parametrize("terrain", [None, sphere_terrain()], ids=["by type", "cut cells"])
def test_projection_removes_the_divergence_of_fluid_cells(terrain):
    system = build_system(layered_types(), terrain, GRID)
    velocity = random_velocity()
    new, q, report = project(velocity, system, tolerance=1e-6)
    assert report.converged and q.dtype == np.float32
    before, after = (np.abs(divergence(v, GRID, system)).max() for v in (velocity, new))
    # the tolerance bounds the 2-norm; the maximum stays below the norm of some 480 cells, about 22 times the rms
    assert after < 3e-5 * before


def test_prescribed_inflow_is_kept_and_passes_through():
    types = np.full(GRID.shape, CellType.FLUID, np.uint8)
    types[0], types[-1] = CellType.INFLOW, CellType.OUTFLOW
    velocity = FaceVelocity.zeros(GRID)
    velocity.u[:2] = 0.7
    new, _, report = project(velocity, build_system(types, None, GRID), tolerance=1e-7)
    assert report.converged
    # incompressible plug flow in a pipe; float32 velocities
    np.testing.assert_allclose(new.u[1:-1], 0.7, atol=1e-5)


def test_walls_are_not_crossed():
    types = layered_types()
    new, _, _ = project(random_velocity(), build_system(types, None, GRID))
    assert np.abs(new.w[:, :, 1]).max() == 0.0 and np.abs(new.v[:, 0, 1:5][1:-1]).max() == 0.0


def test_projecting_twice_changes_nothing():
    system = build_system(layered_types(), sphere_terrain(), GRID)
    once, _, _ = project(random_velocity(), system, tolerance=1e-7)
    twice, _, _ = project(once, system, tolerance=1e-3)
    for a, b in zip(once.components, twice.components):
        assert np.abs(a - b).max() < 1e-5  # float32 rounding of unit velocities plus the tolerance


def test_fractions_of_a_tilted_plane_match_the_cut_areas():
    grid = Grid((3, 3, 3), 1.0)
    fractions = face_fractions(grid.nodes()[..., 2] - 1.25)
    # solid below z = 1.25: vertical faces are closed in layer 0, three quarters open in layer 1, open in layer 2
    for axis in (0, 1):
        np.testing.assert_allclose(np.moveaxis(fractions[axis], 2, 0)[0], 0.0)
        np.testing.assert_allclose(
            np.moveaxis(fractions[axis], 2, 0)[1], 0.75, atol=1.1e-3
        )  # the surface is raised by 0.001
        np.testing.assert_allclose(np.moveaxis(fractions[axis], 2, 0)[2], 1.0)


def test_fractions_of_open_and_buried_faces_are_exact():
    ones = np.ones((3, 4, 5))
    assert all((f == 1).all() for f in face_fractions(ones))
    assert all((f == 0).all() for f in face_fractions(-ones))


def test_faces_in_a_flat_surface_are_closed():
    grid = Grid((3, 3, 3), 1.0)
    w = face_fractions(grid.nodes()[..., 2] - 1.0)[2]
    assert (w[:, :, 1] == 0).all() and (w[:, :, 2] == 1).all()
