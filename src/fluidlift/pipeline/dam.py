"""A body of liquid that is let go: when, and what the masks of the clip say of its shape and of its basin."""

from __future__ import annotations

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.pipeline.fluid_masks import FluidMasks
from fluidlift.shape import standing
from fluidlift.types import PinholeCamera

LAST = 1.0 / 3.0
"""part of the clip in which the liquid is looked at in its basin"""
SPREADS, RECENT = 0.1, 3
"""share by which the liquid still grows over that part, from which it has not arrived: then the last frames count"""
FOLLOWED = 120
"""frames in which the front is followed at most"""


def let_go(fluid: FluidMasks) -> int:
    """The last frame in which the body stands."""
    first = fluid[0]
    area = max(int(first.sum()), 1)
    return standing.held_until(lambda t: float((fluid[t] ^ first).sum()) / area, len(fluid))


def stood(fluid: FluidMasks, start: int, camera: PinholeCamera) -> standing.StandingBody:
    """The body as it stands at a frame, its basin, and what stands in it.

    Args:
        fluid: masks of the clip.
        start: frame in which it still stands.
        camera: canonical.

    Raises:
        InputRejected: a clip that ends before the body moves, or a view that shows no ground.
    """
    late = max(len(fluid) - max(round(LAST * (len(fluid) - start)), 1), start)
    if late <= start:
        raise InputRejected(
            f"a dam that is let go at frame {start} of {len(fluid)}", "a clip that shows where the liquid goes",
            "a longer clip, or another --kind",
        )  # fmt: skip
    if _covers(fluid, len(fluid) - 1) > (1.0 + SPREADS) * _covers(fluid, late):
        late = max(len(fluid) - RECENT, start + 1)
    shape = fluid.shape[1:]
    often = np.zeros(shape)
    for t in range(late, len(fluid)):
        often += fluid[t]
    return standing.find_standing(camera, fluid[start], often / (len(fluid) - late))


def front_speed(fluid: FluidMasks, start: int, camera: PinholeCamera, found: standing.StandingBody) -> float:
    """Speed of its front in units of the body per frame, from the masks of the frames after the first."""
    last = min(len(fluid), start + 1 + FOLLOWED)
    return standing.front_speed(camera, found, (fluid[t] for t in range(start + 1, last)))


def _covers(fluid: FluidMasks, t: int) -> float:
    """Width of the picture, px, in which there is liquid."""
    return float(fluid[t].any(axis=0).sum())
