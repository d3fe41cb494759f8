"""What is told of what was found."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fluidlift.types import SlopeEvidence


def evidence(slope: float, standard_error: float, level_share: float, likeliest: float) -> SlopeEvidence:
    return SlopeEvidence(slope, standard_error, 0.0, level_share, likeliest, "motion")


def test_the_error_of_a_slope_is_that_of_both_models_about_the_one_that_was_taken() -> None:
    # sampled: level in two of five, else normal about 10 degrees
    rng = np.random.default_rng(0)
    true = np.where(rng.random(200_000) < 0.4, 0.0, rng.normal(10.0, 3.0, 200_000))
    for taken in (0.0, 6.0, 10.0):
        expected = math.sqrt(float(((true - taken) ** 2).mean()))
        assert evidence(taken, 3.0, 0.4, 10.0).error == pytest.approx(expected, rel=0.01)


def test_a_slope_that_is_surely_not_level_has_the_error_of_its_posterior_and_a_level_one_none() -> None:
    assert evidence(22.0, 8.0, 0.0, 22.0).error == pytest.approx(8.0)
    assert evidence(0.0, 8.0, 1.0, 22.0).error == 0.0
