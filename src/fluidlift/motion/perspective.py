"""How much perspective the turns of a camera show: the focal length, of a camera that turns (Hartley 1994).

A camera that turns by an angle shifts the middle of its picture by the focal length times that, and its corners by
more, and not quite the same way; one that slides before a wall shifts all alike. A hand does both. One number for a
clip says what is between: q = 1 / focal^2 of a pure turn, 0 of a pure slide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.numerics.homography2 import carried, turn_rates, turned

WIDEST = 0.5
"""least focal length looked for, in longer sides of the picture: a field of view of 90 degrees"""
STEPS = 24
"""perspectives tried, evenly from none to that of the widest lens; a parabola through the best three is finer"""
ERROR = 0.4
"""px, by which a corner is found beside its place, compression and all: the scale of the residuals' weights"""
LEAST_PAIRS = 20
"""features that two frames must share"""
ROUNDS = 6
"""of reweighting"""
TOLD = 0.03
"""part of the cost of similarities by which a perspective must lower it. Of real clips of 1.2 s it is 0.74 where a hand
tilts by a tenth of the picture, 0.04 to 0.22 where it sways by a hundredth or two; fluids alone tell less"""


@dataclass(frozen=True)
class Pair:
    """Features that two frames show."""

    here: Float[np.ndarray, "n 2"]
    """px, as pixel indices"""
    there: Float[np.ndarray, "n 2"]
    guess: Float[np.ndarray, "3 3"]
    """a homography from here to there that is right to some px"""


def perspective_of(pairs: list[Pair], size: tuple[int, int]) -> float:
    """1 over the focal length squared, 1/px^2, that the turns between pairs of frames agree on; 0 where none is told.

    Of all pairs together the robust cost (Cauchy) is least.

    Args:
        pairs: of frames far apart: of a way of d px, the corners of the picture tell it by about a quarter of d.
        size: width and height of the picture, px.
    """
    pairs = [pair for pair in pairs if len(pair.here) >= LEAST_PAIRS]
    if not pairs:
        return 0.0
    tried = np.linspace(0.0, 1.0 / (WIDEST * max(size)) ** 2, STEPS)
    costs = np.array([sum(_cost(pair, q, size) for pair in pairs) for q in tried])
    best = int(costs.argmin())
    if best == 0 or costs[best] > (1.0 - TOLD) * costs[0]:
        return 0.0
    if best == STEPS - 1:
        return float(tried[best])
    before, at, after = costs[best - 1 : best + 2]
    return float(tried[best] + 0.5 * (tried[1] - tried[0]) * (before - after) / (before - 2.0 * at + after))


def _cost(pair: Pair, perspective: float, size: tuple[int, int]) -> float:
    """Sum over features of log(1 + (distance / error)^2), with the turn that makes it least."""
    middle = 0.5 * (np.asarray(size, float) - 1.0)
    rates = turn_rates(pair.here - middle, perspective)
    design = rates.reshape(4, -1).T
    # of the guess only where the middle of the picture goes: the rest was found without perspective
    start = carried(pair.guess, middle) - middle
    motion = turned(np.array([*start, 0.0, 0.0]), perspective, middle)
    for _ in range(ROUNDS):
        left = carried(np.linalg.inv(motion), pair.there) - pair.here
        weight = 1.0 / (1.0 + (left**2).sum(axis=1) / ERROR**2)
        weighted = design * np.tile(weight, 2)[:, None]
        step = np.linalg.solve(weighted.T @ design + 1e-9 * np.eye(4), weighted.T @ left.T.ravel())
        motion = motion @ turned(step, perspective, middle)
    left = carried(np.linalg.inv(motion), pair.there) - pair.here
    return float(np.log1p((left**2).sum(axis=1) / ERROR**2).sum())
