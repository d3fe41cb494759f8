"""How much of the pictures was taken for fluid, and how sure labels and flow are there."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from fluidlift.types import Label, PixelFlow, PixelLabels
from fluidlift.types.flow import TRUSTED
from fluidlift.types.fluid_masks import FluidMasks, parts_of


class FluidFigures(NamedTuple):
    """Of what was taken for fluid, in all frames together."""

    share: float
    """of the pictures' pixels"""
    sure: float
    """mean confidence of its labels"""
    trusted: float
    """share of its pixels and pairs of frames whose flow is trusted"""
    likely_overlap: float
    """intersection over union with what is fluid, as the labels' confidence has it"""


CHANCE = (9.47, -5.72)
"""log odds per unit of the likely overlap, and at none of it, that a mask overlaps what a person drew by 0.7: logistic
regression over 34 real clips, of which 24 do (`benchmarks/masks_fit.py`). Each by the others: log loss 0.477, 0.637
without; of those below a half 3 of 7 are right, to 0.8 5 of 9, above 16 of 18"""


def chance_of_mask(likely_overlap: float) -> float:
    """Probability that a mask is right: 0.7 of its union with what a person would draw is in both."""
    return 1.0 / (1.0 + math.exp(-(CHANCE[0] * likely_overlap + CHANCE[1])))


def likely_overlap(labels: UInt8[np.ndarray, "t h w"], confidence: Float[np.ndarray, "t h w"]) -> float:
    """Expected intersection over expected union of the fluid; a confidence is twice the chance of a label, less one."""
    inside = doubted = 0.0
    area = 0
    for part in parts_of(labels):
        fluid, chance = labels[part] == Label.FLUID, 0.5 + 0.5 * confidence[part].astype(np.float32)
        right = float(chance[fluid].sum(dtype=np.float64))
        area += int(fluid.sum())
        inside += right
        doubted += fluid.size - float(chance.sum(dtype=np.float64)) - (int(fluid.sum()) - right)
    return inside / (area + doubted) if area else 0.0


def fluid_figures(labels: PixelLabels, flow: PixelFlow) -> FluidFigures | None:
    """None where there is no fluid."""
    fluid = FluidMasks(labels.labels)
    areas = fluid.areas()
    if not areas.any():
        return None
    wet, (height, width) = fluid.any_frame(), labels.labels.shape[1:]
    confidence, count = flow.confidence, 0
    for part in parts_of(confidence):
        count += int((confidence[part][:, wet] > TRUSTED).sum())
    total = 0.0
    for part in parts_of(labels.labels):
        total += float(labels.confidence[part][labels.labels[part] == Label.FLUID].sum(dtype=np.float64))
    return FluidFigures(
        float(areas.mean() / (width * height)), total / float(areas.sum()), count / (len(confidence) * int(wet.sum())),
        likely_overlap(labels.labels, labels.confidence),
    )  # fmt: skip
