"""What the frames around the rest frame show together."""

import numpy as np

from fluidlift.pipeline.fluid_masks import FluidMasks
from fluidlift.pipeline.ground import seen_labels
from fluidlift.types.clip import Label


def test_a_rock_is_one_though_waves_wash_over_it_in_some_frames():
    labels = np.full((5, 2, 3), Label.FLUID, np.uint8)
    labels[:, 0] = Label.BACKGROUND
    labels[:3, 1, 1] = Label.SOLID  # bare in three frames of five
    labels[:2, 1, 2] = Label.SOLID  # in two of five: water
    seen = seen_labels(FluidMasks(labels), 0, 5, np.zeros((2, 3), bool))
    assert seen[0].tolist() == [Label.BACKGROUND] * 3
    assert seen[1].tolist() == [Label.FLUID, Label.SOLID, Label.FLUID]
