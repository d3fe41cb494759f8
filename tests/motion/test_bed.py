"""The wall function against what laminar layers do."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.motion.bed import bed_velocity, laminar_layer_thickness, layer_thickness, wall_profile

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


def test_laminar_layers_grow_with_the_root_of_the_way() -> None:
    one = laminar_layer_thickness(1e-6, 1.0, 1.0)
    assert one == pytest.approx(4.64e-3)
    assert laminar_layer_thickness(1e-6, 4.0, 1.0) == pytest.approx(2 * one)
    assert laminar_layer_thickness(4e-6, 1.0, 1.0) == pytest.approx(2 * one)
    assert laminar_layer_thickness(0.0, 1.0, 1.0) == 0.0


def test_layers_scale_with_the_cell_and_stay_within_the_fluid() -> None:
    for kind in KINDS:
        assert layer_thickness(kind, 0.02) == pytest.approx(2 * layer_thickness(kind, 0.01))
        assert layer_thickness(kind, 0.1, depth=0.03) <= 0.03
    assert layer_thickness("pour", 0.01) > layer_thickness("stream", 0.01) > layer_thickness("plume", 0.01)
    with pytest.raises(ValueError, match="lava"):
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
