"""Small scenes for the simulators."""

from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.types import Grid, Particles, Terrain, TriangleMesh


def make_terrain(grid, distance=None, mainstream=(1.0, 0.0, 0.0)):
    """Without a distance: nothing solid."""
    if distance is None:
        distance = np.full(tuple(n + 1 for n in grid.shape), 100.0)
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    return Terrain(grid, np.float32(distance), np.array(mainstream), mesh)


def make_body(grid, inside, *, terrain=None, velocity=(0.0, 0.0, 0.0), per_side=2, jitter=0.25, seed=0):
    """Particles on a jittered lattice, `per_side`^3 per cell, where inside(points) is true and nothing is solid."""
    s = grid.spacing / per_side
    axes = [grid.low[a] + (np.arange(grid.shape[a] * per_side) + 0.5) * s for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points = points[inside(points)]
    points = points + np.random.default_rng(seed).uniform(-jitter, jitter, points.shape) * s
    if terrain is not None:
        points = points[sample_nodes(terrain.signed_distance, grid, points) > 0.2 * s]
    return Particles.at_rest(points, 1.0, velocities=np.tile(np.float32(velocity), (len(points), 1)))


def empty_cells(grid: Grid):
    return np.zeros(grid.shape, np.uint8)


@pytest.fixture
def scene():
    """make_terrain, make_body, empty_cells."""
    return SimpleNamespace(terrain=make_terrain, body=make_body, cells=empty_cells)
