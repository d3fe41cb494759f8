"""What falls too fast for optical flow falls as energy says; what was measured believably stays."""

import numpy as np
import pytest

from fluidlift.motion.free_fall import downhill_of, with_free_fall
from fluidlift.types import Grid, SurfaceMotion


def column(speed):
    z = np.linspace(0.0, 1.0, 50)
    points = np.stack([0 * z, 0 * z, z], axis=1)
    velocities = np.stack([0 * z, 0 * z, -speed(z)], axis=1)
    return SurfaceMotion(points, velocities, np.ones(50, bool)), np.tile([0.0, 0.0, -1.0], (50, 1))


def test_a_jet_that_flow_sees_standing_falls_with_gravity():
    surface, down = column(lambda z: 0 * z)
    moved, share = with_free_fall(surface, down, kind="pour")
    v = -moved.velocities[:, 2]
    # v^2 over the drop is a straight line of slope 2 g times the energy share of a jet, 0.95
    slope = np.polyfit(surface.points[5:-5, 2], v[5:-5] ** 2, 1)[0]
    assert share == 1.0
    assert slope == pytest.approx(-2 * 9.81 * 0.95, rel=1e-6)
    assert not moved.observed.any()


def test_a_measured_fall_stays_as_it_was_measured():
    surface, down = column(lambda z: np.sqrt(2 * 9.81 * (1.15 - z)))
    moved, share = with_free_fall(surface, down, kind="pour")
    assert share == 0.0
    np.testing.assert_array_equal(moved.velocities, surface.velocities)


def test_level_water_does_not_fall():
    surface, _ = column(lambda z: 0 * z)
    moved, share = with_free_fall(surface, np.tile([1.0, 0.0, 0.0], (50, 1)), kind="fall")
    assert share == 0.0
    assert np.abs(moved.velocities).max() == 0.0


def test_downhill_follows_the_surface_or_points_down_and_stands_in_a_vessel() -> None:
    grid = Grid((8, 4, 4), 0.5)
    height = np.repeat(4.0 - 0.5 * np.arange(8)[:, None], 4, axis=1)  # one down for one along x
    down = downhill_of(np.array([[2.0, 1.0, 2.0]]), grid, height)
    assert down[0] == pytest.approx([np.sqrt(0.5), 0.0, -np.sqrt(0.5)])
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.1]])
    np.testing.assert_array_equal(downhill_of(points, grid, None, 0.3), [[0, 0, -1], [1, 0, 0]])
