"""A fit is judged by what it explains, and each number says where it comes from."""

import math

import numpy as np
import pytest

from fluidlift.fit import outcome
from fluidlift.fit.outcome import interval_of, table, verdict
from fluidlift.fit.ranges import UNITS, Bounded, Positive
from fluidlift.types import Estimate, FitResult, FluidParameters

KNOWN = Estimate(0.5, 0.01, True, 0.4, "m/s")
UNKNOWN = Estimate(1e-5, math.inf, False, 1e-5, "m^2/s")


def result(*, loss=0.1, first=1.0, rest=2.0, converged=True, estimates=None, notes=()):
    return FitResult(
        FluidParameters(), {"outflow_velocity": KNOWN} if estimates is None else estimates, np.ones(3), converged, 12,
        notes, {"loss": loss, "loss_at_prior": first, "loss_at_rest": rest},
    )  # fmt: skip


def test_a_fit_that_explains_more_than_the_first_guess_is_used():
    assert verdict(result()).status == "fitted" and not verdict(result()).warnings()
    # a first guess that was right cannot be bettered
    assert verdict(result(loss=1.0)).usable


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (result(loss=1.1), "worse than the first guess"),
        (result(loss=0.9, rest=0.5), "still water"),
        (result(loss=math.inf), "breaks down"),
        (result(loss=math.nan), "breaks down"),
        (result(estimates={"density": UNKNOWN}), "determines none"),
        (result(estimates={"density": UNKNOWN}, converged=False, notes=("the budget ended early",)), "cut off"),
    ],
)
def test_a_fit_that_explains_nothing_has_failed_and_says_why(found, reason):
    judged = verdict(found)
    assert judged.status == "failed" and not judged.usable
    (warning,) = judged.warnings()
    assert reason in warning and "first guess is kept" in warning


def test_a_fit_that_was_cut_off_keeps_what_is_better_than_the_first_guess():
    judged = verdict(result(converged=False))
    assert judged.status == "unfinished" and judged.usable
    assert "before it converged" in judged.warnings()[0] and "fit.max_seconds" in judged.warnings()[0]


@pytest.mark.parametrize("value", [1e-6, 3e-3, 0.4])
def test_the_interval_of_a_positive_number_is_that_of_its_logarithm(value):
    """95 % in the variable that was fitted: never below zero, however uncertain."""
    scale, raw = Positive(0.01), 1.5
    sigma = raw * scale.slope(scale.raw(value))
    low, high = interval_of("kinematic_viscosity", Estimate(value, sigma, True, 1e-5))
    assert math.log(value / low) == pytest.approx(1.96 * raw) == pytest.approx(math.log(high / value))


def test_the_interval_of_a_share_stays_between_zero_and_one():
    share, raw = Bounded(), 2.0
    sigma = raw * share.slope(share.raw(0.9))
    low, high = interval_of("wall_damping", Estimate(0.9, sigma, True, 0.5))
    assert share.raw(0.9) - math.log(low / (1 - low)) == pytest.approx(1.96 * raw)
    assert 0.9 < high < 1.0


def test_the_interval_of_anything_else_is_symmetric_and_of_nothing_none():
    assert interval_of("gravity_z", Estimate(-9.8, 0.1, True, -9.81)) == pytest.approx((-9.996, -9.604))
    assert interval_of("density", UNKNOWN) is None
    assert interval_of("inflow_fluctuation", Estimate(0.0, 0.1, False, 0.0)) == pytest.approx((-0.196, 0.196))


def test_every_number_says_where_it_comes_from():
    estimates = {
        "gravity_z": KNOWN, "density": UNKNOWN, "inflow_velocity_x": UNKNOWN, "restitution": UNKNOWN,
        "kinematic_viscosity": outcome.as_given("kinematic_viscosity", UNKNOWN, FluidParameters()),
    }  # fmt: skip
    rows = table(estimates, held={"kinematic_viscosity"}, free={"gravity", "density"}, measured={"inflow_velocity"})
    assert {r["name"]: r["source"] for r in rows} == {
        "gravity_z": "fitted", "density": "prior: not determined by the clip", "inflow_velocity_x": "measured",
        "restitution": "prior: not fitted", "kinematic_viscosity": "given",
    }  # fmt: skip
    given = rows[-1]
    assert (given["value"], given["sigma"], given["interval"]) == (1e-6, 0.0, [1e-6, 1e-6])
    assert outcome.in_words(given) == "exact" and outcome.in_words(rows[1]) == "unknown"


@pytest.mark.parametrize(
    ("source", "relative", "said", "sigma"),
    [
        ("size", None, "given", 0.0), ("depth", None, "given", None), ("camera", None, "measured: camera", None),
        ("free fall", 0.06, "measured: free fall", 0.03), ("assumed", None, "prior: not determined by the clip", None),
    ],
)  # fmt: skip
def test_the_size_says_where_metres_come_from(source, relative, said, sigma):
    row = outcome.size_row({"source": source, "across": 0.5, "relative_error": relative})
    assert (row["source"], row["unit"]) == (said, "m")
    assert row["sigma"] == (None if sigma is None else pytest.approx(sigma))
    assert outcome.size_estimate(row).identifiable == (source == "free fall")


def test_an_earlier_version_did_not_note_the_size():
    assert outcome.size_row({"source": "size", "value": 2.0}) is None


def test_the_bar_is_full_where_the_value_is_sure():
    def bar(sigma):
        (row,) = table({"gravity_z": Estimate(-10.0, sigma, True, -9.81)}, held=(), free=("gravity",), measured=())
        return outcome.how_sure(row).count("▰")

    assert (bar(0.01), bar(10.0)) == (10, 0)
    assert 0 < bar(2.0) < 10


def test_a_failed_fit_has_an_estimate_of_every_number_of_which_nothing_is_known():
    initial = FluidParameters(inflow_velocity=(0.5, 0.0, 0.1))
    found = outcome.first_guess_as_result(initial, UNITS)
    assert found["inflow_velocity_z"].value == 0.1 and found["density"].value == 1000.0
    assert not any(e.identifiable or math.isfinite(e.sigma) for e in found.values())
    # three numbers for each vector
    assert len(found) == len(UNITS) + 4
