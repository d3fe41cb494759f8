"""Which frames of a clip become the body at rest."""

from __future__ import annotations

import numpy as np

from fluidlift.pipeline.fluid_masks import FluidMasks
from fluidlift.types import VideoClip

FEWEST_PIXELS = 16
"""of fluid at the first instant: fewer have no shape"""


def rest_frame(area: np.ndarray) -> int:
    """First frame in which a good part of the fluid is there (smoke and pours begin with nothing), of areas [T]."""
    enough = area >= 0.3 * np.percentile(area, 90)
    return int(np.argmax(enough)) if enough.any() else int(np.argmax(area))


def united_range(clip: VideoClip, fluid: FluidMasks, longest: int) -> tuple[int, int]:
    """First frame whose body is wanted, and how many in all become one, at most `longest`."""
    from fluidlift.shape.unite import window_length

    frames, start = clip.frames, rest_frame(fluid.areas())
    stop = min(len(frames), start + 2 * longest + 1)
    return start, int(min(window_length(frames[start:stop], fluid[start], longest=longest), len(frames) - start))
