"""The least of a smooth function of many numbers, from its gradient: L-BFGS (Nocedal and Wright 2006, algorithm 7.5).

`torch.optim` has the same, whose first step loads torch's compiler: 2 s of processor time for a dozen steps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

ENOUGH_DESCENT, ENOUGH_FLATTENING = 1e-4, 0.9
"""of the strong Wolfe conditions: shares of the slope at the start that a step lowers the function by at least, and
that is left of the slope at most (the usual ones of quasi-Newton methods, Nocedal and Wright 2006, section 3.1)"""
TRIES = 25
"""steps of a line search at most"""
LEAST_BEND = 1e-10
"""product of a step and of what it changes in the gradient, under which it says nothing of the curvature"""
MARGIN = 0.1
"""share of a bracket by which a step keeps off its ends where two in a row came close to one"""

Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]
"""point -> value and gradient"""
Settled = Callable[[float, np.ndarray], bool]
"""value and gradient -> whether that point will do"""


class _Trial(NamedTuple):
    """A point on the line."""

    length: float
    value: float
    slope: float
    gradient: np.ndarray


class _Found(Exception):
    """A point that will do."""


def lowered(
    objective: Objective, start: Float[np.ndarray, " n"], *, steps: int, evaluations: int,
    settled: Settled = lambda value, gradient: False,
) -> Float[np.ndarray, " n"]:  # fmt: skip
    """A point from which the function is hardly lower.

    Args:
        objective: value and gradient at a point; called with arrays of its own.
        start: first point, float32 or float64, as which all is kept.
        steps: at most; as many past steps make up the curvature.
        evaluations: of the objective, after which no further step is begun.
        settled: ends the search at the first point at which it says so.
    """
    search = _Line(objective, settled, np.array(start))
    try:
        here = search.first()
        past: deque[tuple[np.ndarray, np.ndarray, float]] = deque(maxlen=steps)
        scale, length = 1.0, min(1.0, 1.0 / max(float(np.abs(here.gradient).sum()), 1e-30))
        for _ in range(steps):
            direction = -_twice_looped(here.gradient, past, scale)
            if not float(direction @ here.gradient) < 0.0 or search.count >= evaluations:
                break
            there = search.along(direction, here, length)
            move, bend = there.length * direction, there.gradient - here.gradient
            search.point = search.point + move
            product = float(move @ bend)
            if product > LEAST_BEND:
                past.append((move, bend, 1.0 / product))
                scale = product / float(bend @ bend)
            here, length = there, 1.0
    except _Found:
        pass
    return search.point


def _twice_looped(gradient: np.ndarray, past: deque[tuple[np.ndarray, np.ndarray, float]], scale: float) -> np.ndarray:
    """The inverse of the curvature that past steps make up, times the gradient (algorithm 7.4)."""
    q, shares = gradient.copy(), []
    for move, bend, rho in reversed(past):
        shares.append(rho * float(move @ q))
        q -= shares[-1] * bend
    q *= scale
    for (move, bend, rho), share in zip(past, reversed(shares)):
        q += (share - rho * float(bend @ q)) * move
    return q


class _Line:
    """Line searches for the strong Wolfe conditions (algorithms 3.5 and 3.6)."""

    def __init__(self, objective: Objective, settled: Settled, point: np.ndarray) -> None:
        self._objective, self._settled = objective, settled
        self.point, self.count = point, 0

    def first(self) -> _Trial:
        """The point itself."""
        return self._at(np.zeros_like(self.point), 0.0)

    def _at(self, direction: np.ndarray, length: float) -> _Trial:
        there = self.point + length * direction
        self.count += 1
        value, gradient = self._objective(there)
        if self._settled(value, gradient):
            self.point = there
            raise _Found
        return _Trial(length, value, float(gradient @ direction), gradient)

    def along(self, direction: np.ndarray, here: _Trial, length: float) -> _Trial:
        """A point that meets the conditions, or the lowest found; `length` is tried first."""
        start = here._replace(length=0.0, slope=float(here.gradient @ direction))
        before, now = start, self._at(direction, length)
        for tries in range(TRIES):
            if self._too_high(now, start) or (tries > 1 and now.value >= before.value):
                return self._between(direction, start, before, now, TRIES - tries)
            if self._flat(now, start):
                return now
            if now.slope >= 0:
                return self._between(direction, start, before, now, TRIES - tries)
            ahead = now.length + 0.01 * (now.length - before.length), 10.0 * now.length
            before, now = now, self._at(direction, _lowest_between(before, now, *ahead))
        return now

    def _between(self, direction: np.ndarray, start: _Trial, one: _Trial, other: _Trial, tries: int) -> _Trial:
        """The same between two ends, between which such a point lies."""
        low, high = (one, other) if one.value <= other.value else (other, one)
        near_end, size = False, float(np.abs(direction).max())
        for _ in range(tries):
            first, last = sorted((low.length, high.length))
            if (last - first) * size < 1e-9:
                break
            length, margin = _lowest_between(low, high, first, last), MARGIN * (last - first)
            close = min(last - length, length - first) < margin
            if close and (near_end or not first < length < last):
                length = last - margin if last - length < length - first else first + margin
                close = False
            near_end, now = close, self._at(direction, length)
            if self._too_high(now, start) or now.value >= low.value:
                high = now
                if high.value < low.value:
                    low, high = high, low
            elif self._flat(now, start):
                return now
            else:
                low, high = now, low if now.slope * (high.length - low.length) >= 0 else high
        return low

    @staticmethod
    def _too_high(there: _Trial, start: _Trial) -> bool:
        return not there.value <= start.value + ENOUGH_DESCENT * there.length * start.slope

    @staticmethod
    def _flat(there: _Trial, start: _Trial) -> bool:
        return abs(there.slope) <= -ENOUGH_FLATTENING * start.slope


def _lowest_between(one: _Trial, other: _Trial, first: float, last: float) -> float:
    """Where the cubic through two points, with their slopes, is lowest within bounds; the middle if it has no dip."""
    a, b = (one, other) if one.length <= other.length else (other, one)
    mean = a.slope + b.slope - 3.0 * (a.value - b.value) / (a.length - b.length)
    square = mean**2 - a.slope * b.slope
    if not square >= 0:
        return 0.5 * (first + last)
    root = square**0.5
    at = b.length - (b.length - a.length) * (b.slope + root - mean) / (b.slope - a.slope + 2.0 * root)
    return min(max(at, first), last)
