"""How sure labels and flow are on what was taken for fluid."""

from __future__ import annotations

import numpy as np

from fluidlift.types import Label, PixelFlow, PixelLabels
from fluidlift.types.flow import TRUSTED
from fluidlift.types.fluid_masks import parts_of


def trusted_share(flow: PixelFlow, wet: np.ndarray) -> float:
    """Share of the fluid's pixels (bool [H,W]) and pairs whose flow is trusted."""
    confidence, count = flow.confidence, 0
    for part in parts_of(confidence):
        count += int((confidence[part][:, wet] > TRUSTED).sum())
    return count / (len(confidence) * int(wet.sum()))


def sureness(labels: PixelLabels, area: float) -> float:
    """Mean confidence of what was taken for fluid, `area` px in all frames together."""
    total = 0.0
    for part in parts_of(labels.labels):
        fluid = labels.labels[part] == Label.FLUID
        total += float(labels.confidence[part][fluid].sum(dtype=np.float64))
    return total / area
