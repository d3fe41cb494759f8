"""The inflow over time: a factor on the inflow's velocity, between keyframes, with a surge of its own; and where the
inlet stands, as that of a jug in a hand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require

_HARMONICS = np.array([1.0, 1.618, 2.618])
"""frequencies of the surge over its own: powers of the golden mean never come back in step, so it never repeats"""
_SHARES = np.array([1.0, 0.7, 0.5]) / math.sqrt(0.5 * (1.0 + 0.49 + 0.25))
"""their amplitudes: the sum has unit root mean square"""
_PHASES = np.array([0.0, 1.9, 4.2])


@dataclass(frozen=True)
class InflowSchedule:
    """What the inflow's velocity is multiplied with at each time. The default leaves it as it is."""

    keyframes: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    """(time s, factor >= 0) in order of time: straight lines between them, the ends hold on"""
    fluctuation: float = 0.0
    """root mean square of the surge, as a share of the factor; 0: none"""
    period: float = 1.0
    """s, of the surge's strongest wave"""

    def __post_init__(self) -> None:
        keys = tuple((float(t), float(f)) for t, f in self.keyframes)
        object.__setattr__(self, "keyframes", keys)
        require(bool(keys), "an inflow without a keyframe", "one (time, factor) or more")
        require(bool(np.isfinite(keys).all()), "an inflow keyframe that is not finite")
        require(all(f >= 0 for _, f in keys), f"inflow factors {[f for _, f in keys]}", "0 or more")
        require(all(a < b for (a, _), (b, _) in zip(keys, keys[1:])), "inflow keyframes that are not in order of time")
        require(math.isfinite(self.fluctuation) and self.fluctuation >= 0, f"fluctuation {self.fluctuation}", ">= 0")
        require(math.isfinite(self.period) and self.period > 0, f"period {self.period}", "positive seconds")

    @property
    def steady(self) -> bool:
        """Whether it is the same at all times."""
        return self.fluctuation == 0.0 and len({f for _, f in self.keyframes}) == 1

    def factor(self, time: float) -> float:
        """No unit, 0 or more, at a time in s.

        The surge is a sum of three sines with frequencies that share no period; where it would turn the flow round,
        the flow stops instead.
        """
        times, factors = zip(*self.keyframes)
        own = float(np.interp(time, times, factors))
        if self.fluctuation == 0.0:
            return own
        surge = float(_SHARES @ np.sin(2 * math.pi * time / self.period * _HARMONICS + _PHASES))
        return own * max(0.0, 1.0 + self.fluctuation * surge)

    def run(self, time: float) -> float:
        """s at factor 1 that bring as much as comes in from 0 to `time` (s), without the surge."""
        times, factors = (np.array(v) for v in zip(*self.keyframes))
        inner = np.unique(np.concatenate([[0.0, time], times[(times > 0) & (times < time)]]))
        return float(np.trapezoid(np.interp(inner, times, factors), inner))

    def travelled(self, start: float, duration: float) -> float:
        """The mean factor from `start` (s) over `duration` (s), by Simpson's rule."""
        ends = self.factor(start) + self.factor(start + duration)
        return (ends + 4.0 * self.factor(start + 0.5 * duration)) / 6.0


@dataclass(frozen=True)
class InletPath:
    """Where the inlet stands over time, in whole cells from its own place: it goes there at once.

    Raises:
        ValueError: times that are not in order from 0 on, or not one place for each.
    """

    times: Float[np.ndarray, " n"]
    """s, from which on it stands in a place"""
    cells: Int[np.ndarray, "n 3"]

    def __post_init__(self) -> None:
        require(len(self.times) == len(self.cells) > 0, f"{len(self.cells)} places for {len(self.times)} times")
        require(self.times[0] == 0.0 and bool((np.diff(self.times) > 0).all()), "times that are not in order from 0 on")

    def at(self, time: float) -> tuple[int, int, int]:
        """Cells from its own place at a time, s."""
        x, y, z = self.cells[max(int(np.searchsorted(self.times, time, side="right")) - 1, 0)]
        return int(x), int(y), int(z)
