"""Sliders: ranges around what was fitted, units, and what happens on nonsense."""

import numpy as np
import pytest

from fluidlift.types import FluidParameters
from fluidlift.types.parameters import Estimate
from fluidlift.viewer.controls import INFLOW, WHITEWATER, WHOLE, controls_of, direction, number, path_of, turned

FITTED = FluidParameters(
    kinematic_viscosity=3e-5, gravity=(0.2, 0.1, -9.7), inflow_velocity=(0.4, 0.0, -0.1), wall_damping=0.3
)
VALUES = FITTED.to_dict() | {INFLOW: 1.0, WHITEWATER: 0.0}


def control(key, fitted=FITTED, kind="stream"):
    return next(c for c in controls_of(fitted, kind) if c.key == key)


@pytest.mark.parametrize("kind", ["stream", "fall", "pour", "plume"])
@pytest.mark.parametrize(
    "fitted", [FluidParameters(), FITTED, FluidParameters(kinematic_viscosity=30.0, gravity=(0, 0, 0))]
)
def test_every_fitted_value_is_inside_its_range_and_under_the_mark_of_its_slider(kind, fitted):
    for c in controls_of(fitted, kind):
        value = c.read(fitted.to_dict() | {INFLOW: 1.0, WHITEWATER: 0.0})
        assert c.low <= value <= c.high
        assert c.value_of(c.slider_of(c.fitted)) == c.fitted
        assert c.unit in c.told(value) and c.range_told()


@pytest.mark.parametrize("c", controls_of(FITTED, "stream"), ids=lambda c: c.key)
def test_the_slider_is_monotone_and_its_ends_are_those_of_the_range(c):
    low, high, step = c.slider
    assert 100 < (high - low) / step < 400  # a hand can tell so many places apart
    values = [c.value_of(s) for s in np.linspace(low, high, 300)]
    assert values[0] == pytest.approx(c.low, rel=1e-3, abs=1e-9)  # four digits
    assert values[-1] == pytest.approx(c.high, rel=1e-3)
    # the fitted value takes the place of those within half a step
    assert (np.diff([c.slider_of(v) for v in values]) >= -0.51 * step).all()


def test_viscosity_is_moved_by_its_power_of_ten_and_gravity_in_its_own_unit():
    assert control("kinematic_viscosity").value_of(-3.0) == pytest.approx(1e-3)
    assert control("gravity").value_of(3.7) == pytest.approx(3.7)


@pytest.mark.parametrize("c", controls_of(FITTED, "stream"), ids=lambda c: c.key)
def test_what_a_control_writes_it_reads_again_and_parameters_accept_it(c):
    for share in (0.1, 0.35, 0.9):
        low, high, _ = c.slider
        value = c.value_of(low + share * (high - low))
        written = c.write(VALUES, value)
        if c.key != "gravity_heading":
            assert c.read(VALUES | written) == pytest.approx(value, rel=1e-3, abs=2e-2)
        FITTED.updated({k: v for k, v in written.items() if k not in (INFLOW, WHITEWATER)})


def test_gravity_keeps_its_strength_when_it_is_tilted_and_its_direction_when_it_is_stronger():
    tilted = control("gravity_tilt").write(VALUES, 40.0)["gravity"]
    strong = control("gravity").write(VALUES, 20.0)["gravity"]
    assert np.linalg.norm(tilted) == pytest.approx(np.linalg.norm(FITTED.gravity), rel=1e-5)
    np.testing.assert_allclose(np.cross(strong, FITTED.gravity), 0, atol=1e-3)  # six digits are written


@pytest.mark.parametrize(("tilt", "heading", "expected"), [
    (0, 0, (0, 0, -2)), (90, 0, (2, 0, 0)), (90, 90, (0, 2, 0)), (180, 0, (0, 0, 2)), (90, -180, (-2, 0, 0)),
])  # fmt: skip
def test_tilt_and_heading_are_angles_from_straight_down_and_from_x(tilt, heading, expected):
    np.testing.assert_allclose(turned(2.0, tilt, heading), expected, atol=1e-5)
    assert direction(expected, expected)[0] == pytest.approx(tilt)


def test_gravity_that_was_taken_away_comes_back_from_where_it_was():
    none = control("gravity").write(VALUES, 0.0)
    back = control("gravity").write(VALUES | none, float(np.linalg.norm(FITTED.gravity)))
    np.testing.assert_allclose(back["gravity"], FITTED.gravity, atol=1e-4)


def test_smoke_has_buoyancy_and_no_viscosity():
    keys = {c.key: c.label for c in controls_of(FITTED, "plume")}
    assert keys["gravity"] == "buoyancy" and "kinematic_viscosity" not in keys and "gravity_tilt" not in keys


def test_without_an_inlet_nothing_flows_in():
    assert not any("inflow" in c.key for c in controls_of(FluidParameters(), "pour"))


@pytest.mark.parametrize(("text", "value", "complaint"), [
    ("1e-5", 1e-5, ""), ("0,5", 0.5, ""), (" 2e-6 m²/s ", 2e-6, ""), ("-3", 1e-7, "outside"), ("1e9", 1.0, "outside"),
    ("nan", None, "finite"), ("inf", None, "finite"), ("", None, "no number"), ("twelve", None, "no number"),
    ("__import__('os')", None, "no number"),
])  # fmt: skip
def test_what_is_typed_is_clamped_or_refused_with_the_range_in_the_message(text, value, complaint):
    found, message = control("kinematic_viscosity").typed(text)
    assert found == value
    assert complaint in message and bool(message) == bool(complaint)
    assert not message or "1e-7 to 1 m²/s" in message


def test_values_stand_under_their_section_of_the_scene():
    assert path_of("gravity") == "parameters.gravity" and path_of(INFLOW) == INFLOW


@pytest.mark.parametrize(("value", "text"), [
    (1000.0, "1000"), (1e-5, "1e-5"), (1.2345e-5, "1.23e-5"), (0.0, "0"), (-1.7, "-1.7"), (9.811, "9.81"), (2e7, "2e7"),
    (0.00261, "0.00261"), (12345.0, "12300"),
])  # fmt: skip
def test_numbers_are_told_as_a_person_writes_them(value, text):
    assert number(value, 3) == text


@pytest.mark.parametrize("c", controls_of(FITTED, "stream"), ids=lambda c: c.key)
def test_a_number_and_its_unit_stay_in_one_line(c):
    from fluidlift.viewer.panel_fluid import _label

    amount = _label(c, c.fitted).removeprefix(f"{c.label} ")
    assert amount and not set(amount) & set(" /-._")  # viser lets a line end behind each of these
    read = amount
    for old, new in WHOLE.items():
        read = read.replace(new, chr(old))
    assert read == f"{number(c.fitted, 3)} {c.unit}".strip().replace(" °", "°")


def test_what_was_not_fitted_is_not_called_so():
    """A number that the data say nothing about is a prior, one that a person gave is given: as in the report."""
    estimates = {
        "kinematic_viscosity": Estimate(1e-6, 4e-7, False, 2e-6, "m^2/s", (4e-7, 3e-6), "fitted to the motion"),
        "density": Estimate(1000.0, np.inf, False, 1000.0, "kg/m^3", None, "prior, not determined by the clip"),
        "gravity_z": Estimate(-9.81, 0.0, True, -9.81, "m/s^2", None, "given"),
        "inflow_velocity_x": Estimate(1.0, 0.1, True, 0.5, "m/s", (0.8, 1.2), "fitted"),
        "inflow_velocity_y": Estimate(0.0, np.inf, False, 0.0, "m/s", None, "prior, not determined by the clip"),
    }
    found = {c.key: c for c in controls_of(FITTED, "stream", estimates)}
    assert found["kinematic_viscosity"].origin == "fitted"
    assert found["kinematic_viscosity"].hint.endswith("fitted to the motion; 95 %: 4e-7 to 3e-6 m^2/s")
    assert (found["density"].origin, found["gravity"].origin, found[INFLOW].origin) == ("prior", "given", "fitted")
    assert found["density"].hint.endswith("prior, not determined by the clip")
    assert found["density"].known == "1000 kg/m^3; prior, not determined by the clip"
    assert found["kinematic_viscosity"].known == "1e-6 m^2/s (95 %: 4e-7 to 3e-6 m^2/s); fitted to the motion"
    assert found[WHITEWATER].known == "" and found[WHITEWATER].fitted == 0.0
    assert found["surface_tension"].origin == "lifted"


def test_the_dial_of_white_water_says_how_much_foam_the_clip_shows_and_stays_at_none():
    share = Estimate(0.078, 0.005, False, 0.0, "", (0.059, 0.103), "measured: bright, grey pixels")
    (found,) = (c for c in controls_of(FITTED, "stream", {"foam_share": share}) if c.key == WHITEWATER)
    assert found.known == "foam on 0.078 (95 %: 0.059 to 0.103); measured: bright, grey pixels"
    assert found.origin == "none" and found.fitted == 0.0
