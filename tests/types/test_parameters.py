"""Physical parameters stay in the range where they mean something."""

import json

import pytest

from fluidlift.errors import InputRejected
from fluidlift.types import FluidParameters


@pytest.mark.parametrize(
    ("name", "bad", "edge"),
    [
        ("density", 0.0, 1e-3), ("kinematic_viscosity", -1e-9, 0.0), ("restitution", 1.01, 1.0),
        ("restitution", -0.01, 0.0), ("wall_damping", 1.01, 1.0), ("wall_damping", -0.01, 0.0),
        ("time_step", 0.0, 1e-6), ("inflow_fluctuation", -0.1, 0.0),
    ],
)  # fmt: skip
def test_the_range_ends_where_physics_ends(name, bad, edge):
    FluidParameters(**{name: edge})
    with pytest.raises(ValueError, match=name.replace("_", " ")):
        FluidParameters(**{name: bad})


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["density", "time_step", "outflow_velocity"])
def test_parameters_are_finite(name, bad):
    with pytest.raises(ValueError):
        FluidParameters(**{name: bad})


@pytest.mark.parametrize("name", ["gravity", "inflow_velocity"])
def test_vectors_are_finite_tuples(name):
    with pytest.raises(ValueError, match="finite"):
        FluidParameters(**{name: (0, 0, float("nan"))})
    assert getattr(FluidParameters(**{name: [1, 2, 3]}), name) == (1.0, 2.0, 3.0)


def test_vectors_have_three_components():
    for name in ("gravity", "inflow_velocity"):
        with pytest.raises(ValueError):
            FluidParameters(**{name: (0.0, -9.81)})


def test_an_edited_value_replaces_one_and_keeps_the_rest():
    p = FluidParameters(density=998.0).updated({"kinematic_viscosity": 1e-3, "gravity": [0, 0, -1.62]})
    assert (p.density, p.kinematic_viscosity, p.gravity) == (998.0, 1e-3, (0.0, 0.0, -1.62))


@pytest.mark.parametrize(
    "overrides",
    [
        {"viscosity": 1.0}, {"density": -1}, {"density": "heavy"}, {"gravity": 9.81}, {"gravity": ["a", 0, 0]},
        {"gravity": [0, 0]}, {"restitution": 2}, {"density": None}, {"density": [1.0]},
    ],
    ids=str,
)  # fmt: skip
def test_an_edit_that_makes_no_sense_is_rejected_as_input(overrides):
    with pytest.raises(InputRejected):
        FluidParameters().updated(overrides)


def test_an_unknown_name_is_answered_with_the_known_ones():
    with pytest.raises(InputRejected, match="kinematic_viscosity"):
        FluidParameters().updated({"viscosity": 1.0})


def test_parameters_survive_the_way_over_json():
    p = FluidParameters(inflow_velocity=(0.1, 0.2, 0.3), outflow_velocity=0.7)
    assert FluidParameters().updated(json.loads(json.dumps(p.to_dict()))) == p
