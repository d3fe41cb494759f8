"""Signed distances and what stays outside."""

import numpy as np

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.numerics.signed_distance import push_outside
from fluidlift.types import Grid

GRID = Grid((16, 14, 12), 0.1, (-0.3, 0.2, 0.0))


def test_points_in_a_sphere_are_pushed_out_and_others_stay():
    center = np.array([0.5, 0.9, 0.6])
    field = np.linalg.norm(GRID.nodes() - center, axis=-1) - 0.35
    points = np.random.default_rng(0).uniform(GRID.low, GRID.high, (500, 3)).astype(np.float32)
    before = sample_nodes(field, GRID, points)
    moved, inside = push_outside(points, field, GRID, margin=0.01)
    assert not inside.any()
    # float32 positions of order 1 m
    assert sample_nodes(field, GRID, moved).min() > 0.01 - 1e-5
    np.testing.assert_array_equal(moved[before > 0.01], points[before > 0.01])
