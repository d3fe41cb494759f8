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


def thrown(drift, speed=1.0, half=0.1, kind_share=0.95):
    """A sheet that falls from z = 1 at `speed` and is thrown sideways: points on its ballistic ways, at rest in the
    pictures."""
    time, lane = np.meshgrid(np.linspace(0.0, 0.35, 60), np.linspace(-half, half, 15), indexing="ij")
    z = 1.0 - speed * time - 0.5 * 9.81 * kind_share * time**2
    points = np.stack([lane + drift * time, 0 * z, z], axis=-1).reshape(-1, 3)
    surface = SurfaceMotion(points, np.zeros_like(points), np.ones(len(points), bool))
    return surface, np.tile([0.0, 0.0, -1.0], (len(points), 1))


@pytest.mark.parametrize("drift", [-0.8, 0.0, 0.5])
def test_a_sheet_that_is_thrown_sideways_leans_as_it_is_seen_to(drift):
    surface, down = thrown(drift)
    moved, _ = with_free_fall(surface, down, kind="pour")
    # what it had fallen before it was seen is taken to be 15 % of its drop (v0 = 1.6 m/s for 1): time runs up to a
    # fifth faster at the top
    assert np.median(moved.velocities[:, 0]) == pytest.approx(drift, abs=0.05 + 0.2 * abs(drift))


def test_a_thread_beside_a_fall_does_not_make_it_lean():
    surface, _ = thrown(0.0)
    aside = surface.points[surface.points[:, 2] < 0.4][::4] - [1.5, 0.0, 0.0]
    points = np.concatenate([surface.points, aside])
    both = SurfaceMotion(points, np.zeros_like(points), np.ones(len(points), bool))
    moved, _ = with_free_fall(both, np.tile([0.0, 0.0, -1.0], (len(points), 1)), kind="fall")
    assert np.abs(moved.velocities[: len(surface.points), 0]).max() < 0.1  # m/s; the fall has 2


def test_a_fall_that_fans_out_drifts_to_both_sides():
    time, lane = np.meshgrid(np.linspace(0.0, 0.35, 60), np.linspace(-1.0, 1.0, 15), indexing="ij")
    z = 1.0 - 1.6 * time - 0.5 * 9.81 * 0.95 * time**2
    points = np.stack([0.1 * lane + 0.4 * lane * time, 0 * z, z], axis=-1).reshape(-1, 3)
    still = SurfaceMotion(points, np.zeros_like(points), np.ones(len(points), bool))
    moved, _ = with_free_fall(still, np.tile([0.0, 0.0, -1.0], (len(points), 1)), kind="pour")
    expected = (0.4 * lane).reshape(-1)
    assert np.corrcoef(moved.velocities[:, 0], expected)[0, 1] > 0.95


def test_where_flow_fails_on_most_of_a_sheet_its_drift_is_that_of_the_outline_everywhere():
    surface, down = thrown(0.5)
    # the upper third, which is slow, was measured, straight down
    upper = surface.points[:, 2] > np.quantile(surface.points[:, 2], 2 / 3)
    known = SurfaceMotion(surface.points, np.where(upper[:, None], [0.0, 0.0, -2.0], 0.0), surface.observed)
    moved, share = with_free_fall(known, down, kind="pour")
    assert 0.5 < share < 0.8
    np.testing.assert_allclose(moved.velocities[upper, 2], -2.0)  # its speed down is kept
    assert np.median(moved.velocities[upper, 0]) == pytest.approx(0.5, abs=0.15)  # as above
