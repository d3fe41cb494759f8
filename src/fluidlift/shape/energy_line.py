"""How far a stream has fallen along its way, from its speeds: the energy line (Bernoulli, Manning)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.types import GRAVITY
from fluidlift.types.kind import STEEPEST_STREAM

MANNING = 0.035
"""s/m^(1/3), roughness of natural streams (Chow 1959, table 5-6: 0.03 clean and straight, 0.04 winding, 0.05 stony)"""
HYDRAULIC = 0.6
"""hydraulic radius over greatest depth of a parabolic bed five times as wide as deep (area 2/3, wetted width 1.1)"""
MEAN_OF_SURFACE = 0.85
"""mean speed over a column of water over that of its surface (the usual figure of image velocimetry)"""


@dataclass(frozen=True)
class Channel:
    """A stream in its bed."""

    width: float
    """m"""
    slope: float
    """degrees, as its perspective shows it; 0 where it does not"""
    depth_share: float = 0.2
    """depth over width"""


def energy_profile(
    along: Float[np.ndarray, " n"], speed: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"], channel: Channel
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """How far (m) the surface has fallen at distances along it (m), the first of them 0.

    Args:
        along: m down the stream, of each patch.
        speed: m/s there.
        weight: 0 to 1.
        channel: what is known of it.
    """
    low, high = np.percentile(along, [2.0, 98.0])
    run = np.linspace(low, high, 25)
    # the head of the middle of the stream: medians over slices, and a cubic through them (rocks, eddies)
    slices = np.clip(((along - low) / max(high - low, 1e-9) * 10).astype(int), 0, 9)
    filled = [k for k in range(10) if (slices == k).sum() >= 3]
    centre = np.array([np.average(along[slices == k], weights=weight[slices == k] + 1e-9) for k in filled])
    typical = np.array([np.median(speed[slices == k]) for k in filled])
    degree = min(3, len(filled) - 1)
    fitted = np.polyval(np.polyfit(centre, typical, max(degree, 0)), np.clip(run, centre[0], centre[-1]))
    head = np.square(np.clip(fitted, 0.0, typical.max())) / (2.0 * GRAVITY)
    gained = np.concatenate([[0.0], np.cumsum(np.maximum(np.diff(head), 0.0))])
    # as deep as continuity lets it be: half the radius where it is twice as fast
    usual = max(float(np.median(typical)), 1e-9)
    pace = np.clip(fitted / usual, 0.3, 3.0)
    radius = np.maximum(HYDRAULIC * channel.depth_share * channel.width / pace, 1e-3)
    friction = np.square(MANNING * MEAN_OF_SURFACE * usual * pace) / radius ** (4.0 / 3.0)
    friction = np.minimum(friction, np.tan(np.radians(STEEPEST_STREAM)))
    step = np.diff(run)
    fall = gained + np.concatenate([[0.0], np.cumsum(0.5 * (friction[1:] + friction[:-1]) * step)])
    missing = np.sin(np.radians(channel.slope)) * (run[-1] - run[0]) - fall[-1]
    return run, fall + max(missing, 0.0) * (run - run[0]) / max(run[-1] - run[0], 1e-9)
