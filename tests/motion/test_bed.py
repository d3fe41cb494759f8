"""The wall function against what laminar layers do."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.motion.bed import (
    SURFACE_COEFFICIENT,
    bed_velocity,
    film_profile,
    film_share,
    layer_thickness,
    log_profile,
    speed_share,
    wall_profile,
)

KINDS = ("stream", "fall", "pour", "plume")


def test_the_profile_sticks_to_the_wall_and_joins_the_free_flow_without_shear() -> None:
    assert wall_profile(0.0, 0.1) == 0.0
    assert wall_profile(0.1, 0.1) == 1.0 and wall_profile(5.0, 0.1) == 1.0
    y = np.linspace(0, 0.1, 201)
    f = wall_profile(y, 0.1)
    assert (np.diff(f) > 0).all()
    slope = np.gradient(f, y)
    assert slope[-1] < 0.1 / 0.1 * 0.2  # no shear at the edge: below a tenth of the 15/m at the wall
    assert abs(slope[0] - 1.5 / 0.1) < 0.01 * 15


def test_the_profile_is_near_the_exact_laminar_layer() -> None:
    # Blasius: u/U at eta = y sqrt(U / (nu x)) (Schlichting, table 7.1); the cubic has d = 4.64 sqrt(nu x / U)
    eta = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    exact = np.array([0.0, 0.32979, 0.62977, 0.84605, 0.95552, 0.99155])
    assert np.abs(wall_profile(eta, 4.64) - exact).max() < 0.05  # the integral solution is good to some 4 %
    # wall shear: 0.323 by the cubic, 0.332 exactly
    assert abs(1.5 / 4.64 - 0.332) < 0.01


def test_layers_scale_with_the_cell_and_stay_within_the_fluid() -> None:
    for kind in KINDS:
        assert layer_thickness(kind, 0.02) == pytest.approx(2 * layer_thickness(kind, 0.01))
        assert speed_share(0.03, kind=kind, spacing=0.1, depth=0.03) == pytest.approx(1.0)
    assert layer_thickness("pour", 0.01) > layer_thickness("stream", 0.01) > layer_thickness("plume", 0.01)
    with pytest.raises(InputRejected, match="lava"):
        layer_thickness("lava", 0.01)


def test_smoke_is_not_damped_and_a_river_keeps_about_seven_tenths() -> None:
    surface = np.array([[1.0, 0.0, 0.0]])
    along = np.array([1.0, 0.0, 0.0])
    assert bed_velocity(surface, along, kind="plume", spacing=0.05)[0, 0] == 1.0
    # 1/7 power law of turbulent flow at half a cell of ten: (0.05)^(1/7) = 0.65; of five: 0.72
    assert 0.6 < bed_velocity(surface, along, kind="stream", spacing=0.05)[0, 0] < 0.75


def test_the_bed_takes_the_mainstream_in_its_tangent_plane_with_the_surface_speed() -> None:
    surface = np.array([[0.0, 2.0, 0.0], [0.0, 2.0, 0.0], [0.0, 2.0, 0.0]])
    normal = np.array([[0.0, 0.0, 1.0], [-0.6, 0.0, 0.8], [1.0, 0.0, 0.0]])
    v = bed_velocity(surface, np.array([1.0, 0.0, 0.0]), normal, kind="stream", spacing=0.1)
    share = wall_profile(0.05, layer_thickness("stream", 0.1))
    assert np.allclose(v[0], [2 * share, 0, 0])
    assert np.allclose(v[1], 2 * share * np.array([0.8, 0.0, 0.6]))
    assert np.allclose(v[2], 0.0)  # the mainstream runs into the wall
    assert np.abs((v * normal).sum(axis=-1)).max() < 1e-12


def viscous_film(cells: int) -> np.ndarray:
    """Speed at the cell centres of a film of unit depth and surface speed, solved by finite differences on 2000 layers.

    nu u'' = -g, no slip at the bed, no shear at the surface.
    """
    n = 2000
    h = 1.0 / n
    a = (np.diag(np.full(n, -2.0)) + np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)) / h**2
    a[0, 0] = -3.0 / h**2  # u = 0 half a layer below
    a[-1, -1] = -1.0 / h**2
    u = np.linalg.solve(a, -np.ones(n))
    y = (np.arange(n) + 0.5) * h
    return np.interp((np.arange(cells) + 0.5) / cells, y, u / u[-1])


@pytest.mark.parametrize("cells", [2, 3, 5, 8, 16])
def test_a_viscous_film_has_its_speed_at_every_cell_on_every_grid(cells: int) -> None:
    exact = viscous_film(cells)
    y = (np.arange(cells) + 0.5) / cells
    film = speed_share(y, kind="pour", spacing=1.0 / cells, depth=1.0, wall="film")
    assert np.abs(film - exact).max() < 1e-3  # second order on 2000 layers
    # the paper's cubic with the layer of a whole depth: eta (1 - eta)^2 / 2 below, 2/27 at most, whatever the grid
    assert 0 <= (film - wall_profile(y, 1.0)).min() and (exact - wall_profile(y, 1.0)).max() < 2 / 27 + 1e-3


@pytest.mark.parametrize("cells", [2, 4, 8])
def test_both_halves_of_plane_poiseuille_flow_are_films(cells: int) -> None:
    # u / U = 1 - (2 y / H - 1)^2 across a gap H; the wall distance counts from the nearer side
    y = (np.arange(2 * cells) + 0.5) / (2 * cells)
    share = film_profile(np.minimum(y, 1 - y), 0.5)
    assert np.allclose(share, 1 - (2 * y - 1) ** 2, atol=1e-12)


def test_a_laminar_layer_is_seen_by_the_cells_that_resolve_it_and_not_by_coarse_ones() -> None:
    # Blasius: u/U = 0.32979 at eta = 1 and 0.62977 at 2 (Schlichting); the cubic has d = 4.64 in eta
    for spacing, exact in ((2.0, 0.32979), (4.0, 0.62977)):
        assert wall_profile(0.5 * spacing, 4.64) == pytest.approx(exact, abs=0.03)
    assert wall_profile(0.5 * 12.0, 4.64) == 1.0  # eta = 6: 0.9990


def test_the_log_law_has_its_mean_at_85_percent_of_the_surface_and_nothing_below_its_roughness() -> None:
    y = (np.arange(200_000) + 0.5) / 200_000
    # 1 - 1 / ln(h / y0) leaves out the layer below y0, a thousandth of the depth
    assert log_profile(y, 1.0).mean() == pytest.approx(SURFACE_COEFFICIENT, abs=2e-3)
    rough = log_profile(y, 1.0, roughness=0.01)
    assert rough.mean() == pytest.approx(1 - 0.99 / np.log(100), abs=2e-3)
    assert (rough[y < 0.01] == 0).all() and rough[-1] == pytest.approx(1.0, abs=1e-4)
    # equal steps of speed for equal factors of height
    steps = np.diff(log_profile(np.array([0.05, 0.1, 0.2, 0.4, 0.8]), 1.0, roughness=0.01))
    assert np.allclose(steps, np.log(2) / np.log(100))


def test_a_rough_bed_slows_the_stream_more_than_a_smooth_one() -> None:
    assert log_profile(0.1, 1.0, 0.03) < log_profile(0.1, 1.0, 0.003) < log_profile(0.1, 1.0, 0.0003)
    with pytest.raises(ValueError, match="roughness"):
        log_profile(0.1, 1.0, 2.0)


def test_bed_cells_take_the_wall_function_and_the_depth_of_their_own_column() -> None:
    surface = np.tile([1.0, 0.0, 0.0], (3, 1))
    depth = np.array([0.2, 0.4, 0.8])
    for wall, profile in (("log", log_profile), ("film", film_profile)):
        v = bed_velocity(surface, np.array([1.0, 0.0, 0.0]), kind="stream", spacing=0.1, depth=depth, wall=wall)
        assert np.allclose(v[:, 0], profile(np.full(3, 0.05), depth))
    with pytest.raises(ValueError, match="depth"):
        bed_velocity(surface, np.array([1.0, 0.0, 0.0]), kind="stream", spacing=0.1, wall="log")
    with pytest.raises(ValueError, match="plug"):
        speed_share(np.array(0.1), kind="stream", spacing=0.1, wall="plug")


def sloping_surface(slope: float, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (m) and velocities (m/s) of a plane that falls along x."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 2, 21), np.linspace(0, 0.6, 7), indexing="ij"))
    along = np.array([1.0, 0.0, -slope]) / np.hypot(1.0, slope)
    return np.stack([x, y, -slope * x], axis=-1), np.tile(speed * along, (x.size, 1))


def test_films_of_honey_are_told_from_rivers_by_their_speed_for_slope_and_depth() -> None:
    angle, depth, viscosity = np.radians(22), 0.04, 0.007
    film = 9.81 * np.sin(angle) * depth**2 / (2 * viscosity)  # Nusselt 1916; Re = 2.4, so sqrt(Re / 2) = 1.1
    points, velocities = sloping_surface(np.tan(angle), film)
    shares = [film_share(size * points, size * velocities, size * depth) for size in (0.5, 1.0, 2.0)]
    assert shares[0] == 1.0 and shares[1] > 0.85
    assert shares[2] > 0.5  # a size twice too large makes the ratio 1.4 times as large
    # Manning's n = 0.035, a stony brook of 0.3 m on a slope of 2 %: 1.8 m/s; and a torrent of boulders at 10 %, n = 0.1
    for slope, n in ((0.02, 0.035), (0.1, 0.1)):
        speed = 0.3 ** (2 / 3) * np.sqrt(slope) / n
        points, velocities = sloping_surface(slope, speed)
        assert film_share(points, velocities, 0.3) < 0.3
    level, still = sloping_surface(0.0, 0.01)
    assert film_share(level, still, 0.3) == 0.0


def test_a_river_on_a_slope_that_was_guessed_is_no_film_and_honey_on_a_steep_one_is() -> None:
    # 2 m/s and 2 m deep, level, seen as a tenth of that on a plane that falls by 5 degrees, give or take 8
    points, velocities = sloping_surface(np.tan(np.radians(5)), 0.2)
    assert film_share(points, velocities, 0.2) == 1.0  # were the slope known
    assert film_share(points, velocities, 0.2, slope_error=np.tan(np.radians(8))) == 0.0
    # honey on 22 degrees: no error of 8 makes water as slow as this
    speed = 9.81 * np.sin(np.radians(22)) * 0.04**2 / (2 * 0.007)
    points, velocities = sloping_surface(np.tan(np.radians(22)), speed)
    assert film_share(points, velocities, 0.04, slope_error=np.tan(np.radians(8))) > 0.75
    # a slope that is said to be better known than one view shows is not taken at its word
    assert film_share(points, velocities, 0.04, slope_error=0.0) == film_share(points, velocities, 0.04)


def test_a_stream_that_gains_speed_as_it_falls_has_no_friction_to_explain() -> None:
    points, velocities = sloping_surface(0.3, 1.0)
    fast = np.sqrt(0.05**2 + 2 * 9.81 * 0.3 * points[:, :1])  # z + v^2 / 2g is the same everywhere
    assert film_share(points, fast * velocities, 0.3) == 0.0
    assert film_share(points, 0.2 * velocities, 0.3) == 1.0


def test_a_chute_above_a_pool_is_no_film_although_the_pool_is_slow() -> None:
    # a fifth of the way is 45 degrees steep and at 1.5 m/s, the rest a level pool at 0.3 m/s, 0.2 m deep
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 0.6, 13), indexing="ij"))
    chute = x < 0.4
    points = np.stack([x, y, np.where(chute, 0.4 - x, 0.0)], axis=-1)
    velocities = np.where(chute[:, None], 1.5 * np.sqrt(0.5) * np.array([1.0, 0.0, -1.0]), [0.3, 0.0, 0.0])
    assert film_share(points, velocities, 0.2) == 0.0
    # all of it as one plane: a slope of 0.15, whose turbulent stream would be at 1.4 m/s
    fitted = np.polyfit(x, points[:, 2], 1)[0]
    plane, slow = sloping_surface(-fitted, 0.3)
    assert film_share(plane, slow, 0.2) == 1.0


def test_a_film_of_honey_that_ends_on_a_level_plate_is_a_film() -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 0.6, 13), indexing="ij"))
    points = np.stack([x, y, 0.4 * np.maximum(1.4 - x, 0.0)], axis=-1)
    velocities = np.where((x < 1.4)[:, None], [0.3, 0.0, -0.12], [0.1, 0.0, 0.0])
    assert film_share(points, velocities, 0.04) > 0.85
