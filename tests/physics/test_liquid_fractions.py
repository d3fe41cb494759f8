"""How much of a control volume is liquid."""

import numpy as np
import pytest

from fluidlift.physics.liquid_fractions import cell_shares, control_share, cut_share, octant_shares
from fluidlift.types import Grid


def test_share_of_a_cube_cut_by_a_plane_is_that_of_many_points():
    rng = np.random.default_rng(3)
    axis = (np.arange(48) + 0.5) / 48 - 0.5
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    slopes = [rng.normal(size=3) for _ in range(20)] + [
        np.array(g, float) for g in ((1, 0, 0), (0, -1, 1e-5), (0, 0, 0))
    ]
    for g in slopes:
        for value in np.append(rng.uniform(-0.9, 0.9, 4), 0.0) * max(np.abs(g).sum() / 2, 1.0):
            counted = np.mean(value + points @ g < 0)
            # a plane along an axis lies between two layers of points at best
            assert abs(cut_share(value, *g) - counted) < 0.5 / 48 + 1e-3 or not np.any(g)


def test_control_volumes_hold_the_volume_of_a_ball():
    grid = Grid((20, 20, 20), 1.0)
    radius = 6.3
    distance = np.linalg.norm(grid.centers() - (10.1, 9.7, 10.3), axis=-1) - radius
    octants = octant_shares(distance, np.zeros(grid.shape, bool))
    # linear between samples a quarter of a cell off, a curved distance is too large by 3/32 of its Laplacian, 2 / R
    seen = radius - 3 / 32 * 2 / radius
    assert octants.sum() / 8 == pytest.approx(4 / 3 * np.pi * seen**3, rel=2e-3)


def test_a_sheet_thinner_than_a_cell_keeps_its_thickness():
    z = np.arange(9) - 4.0
    distance = np.broadcast_to(np.abs(z) - 0.4, (5, 5, 9)).copy()
    octants = octant_shares(distance, np.zeros(distance.shape, bool))
    # piecewise linear between the samples, as the distance itself: exact
    np.testing.assert_allclose(octants[2, 2].sum() / 8, 0.8, atol=1e-3)


def test_volumes_around_faces_and_edges_tile_the_same_liquid():
    rng = np.random.default_rng(1)
    distance = np.linalg.norm(np.indices((9, 9, 9)) - np.array([4.1, 3.8, 4.3])[:, None, None, None], axis=0) - 2.4
    excluded = np.zeros(distance.shape, bool)
    octants = octant_shares(distance, excluded)
    cells = cell_shares(octants, excluded)
    viscosity = rng.uniform(0.5, 2.0, distance.shape)
    for across in np.ndindex(2, 2, 2):
        shares = [
            control_share(octants, cells, 1 / viscosity, *at, *across)[0] for at in np.ndindex(8, 8, 8) if min(at)
        ]
        assert sum(shares) == pytest.approx(octants.sum() / 8, rel=1e-5)  # float32


def test_viscosity_between_two_liquids_is_their_harmonic_mean_and_solid_does_not_count():
    octants = np.ones((3, 3, 3, 8), np.float32)
    viscosity = np.ones((3, 3, 3))
    viscosity[1:] = 4.0
    excluded = np.zeros((3, 3, 3), bool)
    excluded[:, 0] = True
    octants[excluded] = 0.0
    cells = cell_shares(octants, excluded)
    assert control_share(octants, cells, 1 / viscosity, 1, 1, 1, 1, 0, 0) == pytest.approx((1.0, 1.6))
    assert control_share(octants, cells, 1 / viscosity, 1, 1, 1, 1, 1, 0) == pytest.approx((1.0, 1.6))
    assert control_share(octants, cells, 1 / viscosity, 1, 1, 1, 0, 1, 0) == pytest.approx((1.0, 4.0))
