"""The free surface over the plan: height, motion, and what is not part of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.look.surface_map import SurfaceMap, sampled

CELL = 0.1
STEP = 0.5 * CELL
"""between particles: eight per cell"""


def pool(height=lambda x, y: 0.6 + 0 * x, seed: int = 0) -> np.ndarray:
    """Particles of a pool of 3 m x 2 m whose surface stands at a height (m)."""
    x, y, z = np.meshgrid(*(np.arange(0.5 * STEP, size, STEP) for size in (3.0, 2.0, 1.2)), indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    points = points[points[:, 2] < height(points[:, 0], points[:, 1])]
    return points + np.random.default_rng(seed).uniform(-0.1, 0.1, points.shape) * STEP


def middle(surface: SurfaceMap) -> np.ndarray:
    """Wet columns half a metre from the rim."""
    places = surface.columns()
    return places[(np.abs(places - [1.5, 1.0]) < [1.0, 0.5]).all(axis=1)]


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_the_surface_is_where_the_highest_particles_are(slope):
    points = pool(lambda x, y: 0.5 + slope * x)
    surface = SurfaceMap.of(points, np.zeros_like(points), CELL)
    at = middle(surface)
    # the last layer of particles lies up to one spacing below the water's surface
    off = 0.5 + slope * at[:, 0] - surface.at(surface.height, at)
    assert off.min() > -0.1 * STEP and off.max() < 1.1 * STEP


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_its_slope_is_that_of_the_water(slope):
    points = pool(lambda x, y: 0.5 + slope * (x - y))
    surface = SurfaceMap.of(points, np.zeros_like(points), CELL)
    found = surface.slope(middle(surface))
    # heights are known to a layer of particles: over three columns, to a third of a layer per column
    np.testing.assert_allclose(np.median(found, axis=0), [slope, -slope], atol=0.03)
    assert np.abs(found - [slope, -slope]).max() < 0.2


def test_a_drop_in_the_air_and_a_jet_do_not_lift_the_surface():
    points = pool()
    still = SurfaceMap.of(points, np.zeros_like(points), CELL)
    jet = np.stack([np.full(8, 1.52), np.full(8, 1.02), np.linspace(0.75, 1.1, 8)], axis=-1)
    drop = np.array([[1.0, 1.0, 1.0]])
    splashed = np.concatenate([points, jet, drop])
    surface = SurfaceMap.of(splashed, np.zeros_like(splashed), CELL)
    at = middle(still)
    lifted = surface.at(surface.height, at) - still.at(still.height, at)
    assert np.abs(lifted).max() < 0.5 * STEP


def test_it_moves_as_what_is_near_it_and_not_as_the_depth():
    points = pool()
    velocities = np.where(points[:, 2:] > 0.4, [1.0, 2.0, 0.0], [-5.0, 0.0, 0.0])
    surface = SurfaceMap.of(points, velocities, CELL)
    np.testing.assert_allclose(
        surface.at(surface.velocity, middle(surface)), [[1.0, 2.0, 0.0]] * len(middle(surface)), atol=1e-9
    )


def test_half_of_the_surroundings_of_a_shore_is_liquid_and_a_wide_gap_is_dry():
    points = pool()
    points = points[np.abs(points[:, 0] - 1.5) > 0.3]
    surface = SurfaceMap.of(points, np.zeros_like(points), CELL)
    assert surface.presence(np.array([[1.5, 1.0]]))[0] < 0.01 and surface.presence(np.array([[0.6, 1.0]]))[0] > 0.99
    assert abs(surface.presence(np.array([[1.2, 1.0]]))[0] - 0.5) < 0.3  # columns are half a cell wide


def test_no_particles_and_velocities_of_others_are_refused():
    with pytest.raises(ValueError, match="no particles"):
        SurfaceMap.of(np.zeros((0, 3)), np.zeros((0, 3)), CELL)
    with pytest.raises(ValueError, match="2 velocities"):
        SurfaceMap.of(np.zeros((3, 3)), np.zeros((2, 3)), CELL)


def test_where_all_is_spray_the_surface_is_its_mean_and_not_the_maps_zero():
    cell = 0.2
    x, y = np.meshgrid(np.arange(0.05, 6.0, 0.1), np.arange(0.05, 6.0, 0.1), indexing="ij")
    z = np.full(x.shape, 5.0)
    apart = (np.hypot(x - 4.5, y - 4.5) < 0.6) | (np.hypot(x - 4.5, y - 4.5) > 2.2)
    spray = np.hypot(x - 4.5, y - 4.5) < 0.6
    z[spray] = np.where((np.indices(z.shape).sum(axis=0) % 2)[spray], 2.0, 8.0)  # 3 m off their mean, a cell is 0.2
    positions = np.stack([x[apart], y[apart], z[apart]], axis=-1)
    surface = SurfaceMap.of(positions, np.zeros_like(positions), cell)
    assert surface.wet.sum() > 1000
    assert surface.height[surface.wet].min() > 1.9 and surface.height.max() < 8.1
    assert surface.at(surface.height, np.array([[4.5, 4.5]]))[0] == pytest.approx(5.0, abs=0.5)


def test_a_picture_is_looked_up_as_scipy_does_it_to_the_last_bit():
    rng = np.random.default_rng(0)
    picture = rng.uniform(0, 1, (40, 31, 3)).astype(np.float32)
    index = np.concatenate([rng.uniform(-5, 45, (4000, 2)), rng.integers(-1, 41, (200, 2))])
    for sort in (np.float32, np.float64):
        found = sampled(picture.astype(sort), index)
        wanted = [
            ndimage.map_coordinates(picture[..., k].astype(sort), index.T, order=1, mode="nearest") for k in range(3)
        ]
        assert found.dtype == sort
        last = 0 if sort == np.float32 else 1e-15  # SciPy adds in another order, which single precision rounds away
        np.testing.assert_allclose(found, np.stack(wanted, axis=-1), rtol=0, atol=last)
        np.testing.assert_allclose(sampled(picture[..., 1].astype(sort), index), wanted[1], rtol=0, atol=last)
    broken = sampled(picture, np.array([[np.nan, 3.0], [2.0, np.inf]]))
    np.testing.assert_array_equal(broken, [picture[0, 3], picture[2, -1]])


@pytest.mark.parametrize(
    ("kind", "channels"), [(np.float64, ()), (np.float64, (2,)), (np.float32, ()), (np.float32, (3,)), (np.int64, ())]
)
def test_a_map_is_looked_up_at_places_as_at_their_indices_to_the_last_bit(kind, channels):
    rng, points = np.random.default_rng(6), pool()
    surface = replace(SurfaceMap.of(points, 0.0 * points, CELL), pitch=0.037)
    field = (9.0 * rng.normal(size=(*surface.wet.shape, *channels))).astype(kind)
    places = rng.uniform(-2.0, 4.0, (500, 3))[:, :2]
    index = (places - surface.low) / surface.pitch - 0.5
    np.testing.assert_array_equal(surface.at(field, places), sampled(field, index))
