"""The weights of the kinds are those that the script fits to the table of clips."""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.special import log_softmax

from fluidlift.shape.kind import KINDS, terms
from fluidlift.shape.kind_weights import WEIGHTS

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def fit():
    sys.path.insert(0, str(BENCHMARKS))
    yield importlib.import_module("kinds_fit")
    sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def rows(fit):
    return fit.read()


def test_the_weights_of_the_package_are_fitted(fit, rows):
    found = fit.SHARPNESS * fit.fitted(rows, fit.by_hand(rows.terms))
    kept = np.array([[WEIGHTS[kind].get(term, 0.0) for term in rows.terms] for kind in KINDS])
    assert set(rows.terms) >= {term for weights in WEIGHTS.values() for term in weights}
    np.testing.assert_allclose(kept, found, atol=fit.LEAST + 0.005)  # smaller ones are left out; two decimals
    assert np.abs(found - fit.SHARPNESS * fit.by_hand(rows.terms)).max() > 0.15, "the clips say something"


def test_a_clip_counts_once_however_often_it_was_looked_at(fit, rows):
    some = rows.where(np.isin(rows.names, np.unique(rows.names)[:12]))
    twice = some.where(np.tile(np.arange(len(some.names)), 2))
    prior = fit.by_hand(rows.terms)
    np.testing.assert_allclose(fit.fitted(twice, prior), fit.fitted(some, prior), atol=2e-3)


def test_a_narrow_prior_keeps_the_weights_and_a_wide_one_follows_the_clips(fit, rows):
    prior = fit.by_hand(rows.terms)
    losses = []
    for spread in (1e-3, 0.35, 10.0):
        weights = fit.fitted(rows, prior, spread)
        share = np.exp(log_softmax(rows.columns @ weights.T, axis=1))
        losses.append(-float(rows.weight @ np.log((share * rows.shows).sum(axis=1))))
        if spread == 1e-3:
            np.testing.assert_allclose(weights, prior, atol=1e-3)
    assert losses[0] > losses[1] > losses[2]


def test_looks_take_the_place_of_those_of_the_same_part(fit, tmp_path):
    kinds = importlib.import_module("kinds")
    table = tmp_path / "table.json"
    look = {"clip": "a", "part": "middle", "shows": "stream", "features": {"grey": 0.1}}
    kinds.add_to_table(table, [look, look | {"part": "first"}])
    kinds.add_to_table(table, [look | {"features": {"grey": 0.2}}])
    assert sorted((s["part"], s["features"]["grey"]) for s in fit.json.loads(table.read_text())["looks"]) == [
        ("first", 0.1),
        ("middle", 0.2),
    ]


@pytest.mark.parametrize(
    ("changes", "stays"),
    [
        ({}, 1.0),
        ({"contained": 0.0}, 0.0),  # no rim is seen around it
        ({"hanging": 1.0}, 0.0),  # it comes in from beyond the picture
        ({"falling": 0.9}, 0.1),
        ({"vessel filled by a jet": 1.0}, 0.0),
    ],
    ids=["boils", "lies open", "hangs", "falls", "fills"],
)
def test_what_a_vessel_holds_stays_in_it(fit, changes, stays):
    none = dict.fromkeys(json.loads(fit.TABLE.read_text(encoding="utf-8"))["looks"][0]["features"], 0.0)
    found = terms(none | {"contained": 0.95, "enclosed": 1.0} | changes, None)
    assert found["staying"] == pytest.approx(stays) and found["staying inside"] <= found["staying"]
