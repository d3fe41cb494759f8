"""Raw and physical parameters."""

import numpy as np
import pytest
import torch

from fluidlift.fit.ranges import UNITS, Bounded, Positive, Signed, parameter_space
from fluidlift.types import FluidParameters

EVERYTHING = tuple(UNITS)


@pytest.mark.parametrize(
    ("mapping", "values"),
    [(Bounded(), [0.05, 0.5, 0.9]), (Positive(0.01), [1e-6, 0.01, 3.0]), (Signed(9.81), [-20.0, 0.0, 4.0])],
)
def test_physical_and_raw_are_inverse_and_the_slope_is_the_derivative(mapping, values):
    for value in values:
        raw = mapping.raw(value)
        assert float(mapping.physical(torch.tensor(raw, dtype=torch.float64))) == pytest.approx(value, rel=1e-12)
        e = 1e-6
        high, low = (float(mapping.physical(torch.tensor(raw + s * e, dtype=torch.float64))) for s in (1, -1))
        # central difference: second order in 1e-6, and rounding of 1e-16 / 1e-6
        assert mapping.slope(raw) == pytest.approx((high - low) / (2 * e), rel=1e-6)


def test_ends_of_a_bounded_range_start_inside_where_the_slope_is_not_zero():
    mapping = Bounded()
    assert np.isfinite(mapping.raw(0.0)) and np.isfinite(mapping.raw(1.0))
    assert mapping.slope(mapping.raw(0.0)) > 0.01


def test_any_raw_vector_gives_allowed_parameters():
    prior = FluidParameters(inflow_velocity=(1.0, 0.0, 0.0))
    space = parameter_space(prior, free=EVERYTHING, speed=1.0, spacing=0.1)
    rng = np.random.default_rng(0)
    for _ in range(20):
        raw = space.prior_raw + 3 * space.prior_sigma * rng.standard_normal(len(space.fitted))
        found = space.fluid_parameters(raw)  # checks itself
        assert 0 <= found.restitution <= 1


def test_the_prior_comes_back_and_held_parameters_keep_it_to_the_digit():
    prior = FluidParameters(kinematic_viscosity=0.0, restitution=0.0, inflow_velocity=(0.3, -0.2, 0.0))
    space = parameter_space(prior, free=("gravity", "kinematic_viscosity", "restitution"), speed=0.5, spacing=0.1)
    assert [f.label for f in space.fitted] == [
        "kinematic_viscosity", "gravity_x", "gravity_y", "gravity_z", "restitution",
    ]  # fmt: skip
    assert space.fluid_parameters(space.prior_raw).inflow_velocity == pytest.approx(prior.inflow_velocity)
    held = space.keep_prior({"kinematic_viscosity", "restitution"})
    found = held.fluid_parameters(held.prior_raw)
    assert found.kinematic_viscosity == 0.0
    assert found.restitution == 0.0
    assert found.gravity == pytest.approx(prior.gravity)


def test_what_is_not_kept_has_its_prior_to_the_digit_also_at_an_end_of_its_range():
    prior = FluidParameters(restitution=0.0, wall_damping=0.02, kinematic_viscosity=1e-5)
    space = parameter_space(prior, free=("restitution", "wall_damping", "kinematic_viscosity"), speed=1.0, spacing=0.1)
    assert space.fluid_parameters(space.prior_raw, np.zeros(3, bool)) == prior
    # the sigmoid reaches neither 0 nor 0.02
    assert space.fluid_parameters(space.prior_raw).restitution > 0.04
    labels = [f.label for f in space.fitted]
    kept = space.fluid_parameters(space.prior_raw + 1.0, np.array([name == "kinematic_viscosity" for name in labels]))
    assert (kept.restitution, kept.wall_damping) == (0.0, 0.02)
    assert kept.kinematic_viscosity > 2e-5


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="surface_tension"):
        parameter_space(FluidParameters(), free=("surface_tension",), speed=1.0, spacing=0.1)
