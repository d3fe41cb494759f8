"""How much of the pictures was taken for fluid, and how sure labels and flow are there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
        float(areas.mean() / (width * height)), total / float(areas.sum()), count / (len(confidence) * int(wet.sum()))
    )
