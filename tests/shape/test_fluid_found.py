"""How likely a mask is right, by the confidence of its labels."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.shape.fluid_found import chance_of_mask, fluid_figures, likely_overlap
from fluidlift.types import Label, PixelFlow, PixelLabels


def labels_of(inside: float, outside: float) -> PixelLabels:
    """Two frames of which a quarter is fluid; confidence there, and elsewhere."""
    labels = np.full((2, 20, 20), Label.BACKGROUND, np.uint8)
    labels[:, :10, :10] = Label.FLUID
    confidence = np.where(labels == Label.FLUID, inside, outside).astype(np.float16)
    return PixelLabels(labels, confidence)


def test_the_likely_overlap_is_the_one_that_a_draw_by_its_chances_has():
    labels = labels_of(0.6, 0.8)  # chances 0.8 and 0.9: 80 of 100 are fluid, and 30 of 300 beside them
    assert likely_overlap(labels.labels, labels.confidence) == pytest.approx(80.0 / 130.0, abs=1e-3)
    drawn = np.random.default_rng(0).random((4000, 400)) < np.r_[np.full(100, 0.8), np.full(300, 0.1)]
    overlap = drawn[:, :100].sum() / (100 * len(drawn) + drawn[:, 100:].sum())
    assert likely_overlap(labels.labels, labels.confidence) == pytest.approx(overlap, abs=2e-3)


def test_a_sure_mask_is_all_of_it_and_one_without_fluid_none():
    sure = labels_of(1.0, 1.0)
    assert likely_overlap(sure.labels, sure.confidence) == 1.0
    assert likely_overlap(np.zeros_like(sure.labels), sure.confidence) == 0.0


def test_the_surer_a_mask_the_likelier_it_is_right():
    chances = [chance_of_mask(overlap) for overlap in np.linspace(0.0, 1.0, 11)]
    assert np.all(np.diff(chances) > 0.0) and chances[0] < 0.01 and chances[-1] > 0.95


def test_it_is_among_the_figures_of_a_clip():
    labels = labels_of(0.6, 0.8)
    flow = PixelFlow(np.zeros((1, 20, 20, 2), np.float16), np.ones((1, 20, 20), np.float16))
    found = fluid_figures(labels, flow)
    assert found is not None
    assert found.likely_overlap == likely_overlap(labels.labels, labels.confidence)
    assert found.sure == pytest.approx(0.6, abs=1e-3)
