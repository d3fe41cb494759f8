"""What a person may ask of the fit: names, known values, and what is refused by name."""

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.pipeline.fit_request import NAMES, FitRequest, parameter_named, request_of, startable
from fluidlift.types import FluidParameters

GUESS = FluidParameters(inflow_velocity=(0.3, 0.0, -0.4), outflow_velocity=0.2, inflow_fluctuation=0.1)
ALONG = np.array([0.0, 1.0, 0.0])


def asked(*settings):
    return request_of(build_config(overrides=[f"fit.{s}" for s in settings]).fit)


@pytest.mark.parametrize(
    ("word", "name"),
    [("viscosity", "kinematic_viscosity"), ("gravity", "gravity"), ("damping", "wall_damping"),
     ("outflow", "outflow_velocity"), ("Inflow-Velocity", "inflow_velocity"), ("time step", "time_step")],
)  # fmt: skip
def test_a_part_of_a_name_is_enough_where_no_other_has_it(word, name):
    assert parameter_named(word) == name


@pytest.mark.parametrize(
    ("word", "said"), [("velocity", "inflow_velocity or outflow_velocity"), ("viscosty", "try kine")]
)
def test_a_word_that_means_two_parameters_or_none_is_refused(word, said):
    with pytest.raises(InputRejected, match=said):
        parameter_named(word)


def test_lists_come_with_commas_from_the_command_line_and_as_lists_from_files():
    one = asked("free=gravity,viscosity", "hold=density=998,restitution=0")
    two = asked("free=[gravity, viscosity]", "hold={density: 998, restitution: 0}")
    assert one == two == FitRequest(("gravity", "kinematic_viscosity"), {"density": 998.0, "restitution": 0.0})


def test_all_is_every_parameter_but_those_that_are_known():
    request = asked("free=all", "hold=density=998")
    assert request.everything and request.free == ()
    assert set(request.free_of(("gravity",))) == set(NAMES) - {"density"}
    assert asked("free=gravity").free_of(("viscosity",)) == ("gravity",)


def test_a_vector_is_given_by_its_length_or_by_three_numbers():
    request = asked("hold=gravity=1.62,inflow_velocity=[1, 0, 0.5]")
    assert request.held == {"gravity": 1.62, "inflow_velocity": (1.0, 0.0, 0.5)}
    known = request.applied(GUESS, along=ALONG)
    assert known.gravity == (0.0, 0.0, -1.62)
    assert known.inflow_velocity == (1.0, 0.0, 0.5)
    assert known.outflow_velocity == GUESS.outflow_velocity


def test_a_speed_at_the_inlet_keeps_the_direction_that_was_seen():
    assert asked("hold=inflow_velocity=2").applied(GUESS, along=ALONG).inflow_velocity == pytest.approx((1.2, 0, -1.6))
    still = FluidParameters()
    assert asked("hold=inflow_velocity=2").applied(still, along=ALONG).inflow_velocity == pytest.approx((0, 2.0, 0))
    assert asked("hold=gravity=-9.81").applied(still, along=ALONG).gravity == pytest.approx((0, 0, -9.81))


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("hold=viscosity", "name=value"), ("hold=viscosity=thick", "a number"), ("hold=viscosity=-1", "0 or more"),
        ("hold=density=[1,2,3]", "a number"), ("hold=gravity=[1,2]", "three"), ("hold=restitution=2", "0 to 1"),
        ("hold=time_step=0.01", "scene.yaml"), ("free=colour", "unknown parameter"), ("free=3", "words"),
    ],
)  # fmt: skip
def test_what_cannot_be_known_is_refused_and_said_why(setting, said):
    with pytest.raises(InputRejected, match=said):
        asked(setting)


def test_a_parameter_is_fitted_or_known():
    with pytest.raises(InputRejected, match="--free and --hold"):
        asked("free=viscosity", "hold=viscosity=1e-6")


def test_what_is_known_is_not_fitted():
    usual = ("gravity", "kinematic_viscosity", "density")
    assert asked("hold=viscosity=1e-6").free_of(usual) == ("gravity", "density")
    assert asked("free=density,outflow").free_of(usual) == ("density", "outflow_velocity")
    assert asked().free_of(usual) == usual


def test_a_known_zero_is_not_replaced_by_what_was_seen():
    """The fit reads zeros at the ends off the velocities: a known zero is kept a trace away from it."""
    request = asked("hold=outflow=0,inflow_fluctuation=0,inflow_velocity=[0,0,0]")
    ready = startable(request.applied(GUESS, along=ALONG), request.held)
    for value in (ready.outflow_velocity, ready.inflow_fluctuation, np.linalg.norm(ready.inflow_velocity)):
        assert 0 < value < 1e-6
    assert startable(FluidParameters(), {}) == FluidParameters()
