"""The closed forms obey the equations that they claim to solve."""

import numpy as np
import pytest

from fluidlift.physics.pressure import divergence
from fluidlift.synthetic.analytic import film_speed, on_faces, taylor_green, tilted_channel, uniform
from fluidlift.types import Grid

GRID = Grid((16, 12, 10), 0.05, (-0.3, -0.2, 0.1))


@pytest.mark.parametrize(
    "field",
    [uniform((1.0, -2.0, 0.5)), taylor_green(wavelength=0.8)],
)
def test_incompressible_fields_have_no_divergence_on_the_grid(field):
    velocity = on_faces(field, GRID, np.float64)
    # central differences of sin and cos on a staggered grid cancel exactly; what is left is rounding (1e-15 / 0.05)
    assert np.abs(divergence(velocity, GRID)).max() < 1e-12


def test_vortices_decay_as_the_heat_equation_says():
    nu, k = 0.01, 2 * np.pi
    early, late = taylor_green(viscosity=nu), taylor_green(viscosity=nu, time=3.0)
    x = np.random.default_rng(0).normal(size=(9, 3))
    np.testing.assert_allclose(late(x), early(x) * np.exp(-2 * nu * k * k * 3.0), rtol=1e-12)


def test_the_film_balances_gravity_and_friction():
    kwargs = {"thickness": 0.03, "slope": np.radians(22), "viscosity": 0.008}
    y = np.linspace(0.001, 0.029, 57)
    u = film_speed(y, **kwargs)
    curvature = np.diff(u, 2) / (y[1] - y[0]) ** 2
    # nu u'' = -g sin(slope); second differences of a parabola are exact up to rounding
    np.testing.assert_allclose(0.008 * curvature, -9.81 * np.sin(np.radians(22)), rtol=1e-6)
    assert film_speed(np.array([0.0, -0.01, 0.031]), **kwargs).tolist() == [0.0, 0.0, 0.0]
    assert film_speed(np.array([0.03]), **kwargs)[0] == pytest.approx(9.81 * np.sin(np.radians(22)) * 0.03**2 / 0.016)


def test_the_film_runs_down_its_plane():
    slope = np.radians(10)
    field = tilted_channel(thickness=0.1, slope=slope, viscosity=0.1, height=0.5)
    along, normal = np.array([np.cos(slope), 0, -np.sin(slope)]), np.array([np.sin(slope), 0, np.cos(slope)])
    foot = np.array([0.0, 0.0, 0.5])
    v = field(np.stack([foot + 0.05 * normal, foot + 0.05 * normal + 3 * along, foot - 0.01 * normal]))
    assert v[0] @ normal == pytest.approx(0.0, abs=1e-12) and v[0] @ along > 0
    np.testing.assert_allclose(v[0], v[1], atol=1e-12)
    assert not v[2].any()
