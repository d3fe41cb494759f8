"""Quantities with units, against the definitions of the units."""

import math

import pytest

from fluidlift.types.quantity import DEGREES, METRES, OF_UNIT, SECONDS, parameter, quantity


@pytest.mark.parametrize(
    ("text", "units", "value"),
    [
        ("3", SECONDS, 3.0),
        ("3s", SECONDS, 3.0),
        ("2 min", SECONDS, 120.0),
        (" 1.5e2ms ", SECONDS, 0.15),
        ("10 cm", METRES, 0.1),
        ("-.5 in", METRES, -0.0127),
        ("1rad", DEGREES, 180.0 / math.pi),
        ("12°", DEGREES, 12.0),
    ],
)
def test_a_number_with_a_unit_is_in_si_units(text, units, value):
    assert quantity(text, units) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("text", ["", "cm", "3 parsec", "1e999", "nan", "inf", "1_0", "٣", "3 s s", "9" * 5000])
def test_what_is_no_quantity_is_refused_with_the_units_there_are(text):
    with pytest.raises(ValueError, match="is no number, alone or with one of s, sec, ms"):
        quantity(text, SECONDS)


def test_a_dynamic_viscosity_is_divided_by_the_density():
    """Glycerine at 20 degrees: 1.412 Pa s, 1261 kg/m^3, hence 1120 cSt."""
    assert parameter("1.412 Pa s", "m^2/s", density=1261.0) == pytest.approx(1.12e-3, rel=1e-3)
    assert parameter("1412 cP", "m^2/s", density=1261.0) == pytest.approx(parameter("1120 mm²/s", "m^2/s"), rel=1e-3)
    with pytest.raises(ValueError, match="cSt"):
        parameter("1.412 Pa s", "m^2/s")


def test_every_unit_of_the_table_of_parameters_is_understood():
    from fluidlift.types.parameter_table import PARAMETERS

    for row in PARAMETERS.values():
        if row.unit:
            assert parameter(f"2 {row.unit}", row.unit) == 2.0 and row.unit in OF_UNIT
