"""Points continued beyond their ends by their own mirror image: what lies there, and moves in from there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from fluidlift.errors import require

TRIES = 4
"""images that are looked at, a quarter of the length apart, where the first one falls into a hole between the points"""

NARROW = 4.0
"""spacings: rows shorter than that take the ends of their neighbours"""


def folded(
    values: Float[np.ndarray, " n"], low: Float[np.ndarray, " n"] | float, high: Float[np.ndarray, " n"] | float
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Values thrown back at both ends until they lie between them, and whether an odd number of times."""
    length = np.maximum(np.asarray(high, np.float64) - low, 1e-12)
    turns = np.floor((values - low) / length)
    rest = np.clip(values - low - turns * length, 0.0, length)
    turned = turns % 2 == 1
    return low + np.where(turned, length - rest, rest), turned


@dataclass(frozen=True)
class MirrorImages:
    """Which points stand for which places."""

    place: Int[np.ndarray, " m"]
    """index of the place"""
    offset: Float[np.ndarray, "m 3"]
    """from there, m"""
    point: Int[np.ndarray, " m"]
    """index of the point"""


class MirroredPoints:
    """Points [n,3] (m) that repeat along a direction, every other time as in a mirror.

    Each row along the direction has ends of its own, so that a pattern which a slanting edge cuts off goes on without a
    seam there.

    Args:
        points: the pattern, m.
        direction: unit vector along which it repeats.
        spacing: width of rows, and of the boxes around places, m.
        level: (x, y [n,2]) -> z [n] of the surface that the points lie at: places keep their depth below it. None:
            places keep what lies beside them along the direction.
        ends: where each row turns back, as shares of its length.

    Raises:
        ValueError: no points, or a spacing that is not positive.
    """

    def __init__(
        self,
        points: Float[np.ndarray, "n 3"],
        direction: Float[np.ndarray, "3"],
        spacing: float,
        level: Callable[[np.ndarray], np.ndarray] | None = None,
        ends: tuple[float, float] = (0.0, 1.0),
    ) -> None:
        require(len(points) > 0, "a pattern without points", "one or more")
        require(np.isfinite(spacing) and spacing > 0, f"a spacing of {spacing} m", "positive metres")
        require(0 <= ends[0] < ends[1] <= 1, f"ends {ends}", "two shares in order")
        self._points, self._spacing, self._level = np.asarray(points, np.float64), float(spacing), level
        self._along = np.asarray(direction, np.float64)
        side = np.array([-self._along[1], self._along[0], 0.0])
        size = np.linalg.norm(side)
        # without a level to follow, or straight down, there is nothing beside the direction to tell rows by
        self._across = side / size if level is not None and size > 0.5 else np.zeros(3)
        self._tree = KDTree(self._points)
        along, across = self._points @ self._along, self._points @ self._across
        row = np.round(across / spacing).astype(np.int64)
        self._first = int(row.min())
        count = int(row.max()) - self._first + 1
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, row - self._first, along)
        np.maximum.at(high, row - self._first, along)
        ok = np.flatnonzero(high - low >= NARROW * spacing)
        if len(ok) == 0:
            self._low, self._high = np.full(count, along.min()), np.full(count, along.max())
        else:
            nearest = ok[np.abs(np.arange(count)[:, None] - ok).argmin(axis=1)]
            self._low, self._high = low[nearest], high[nearest]
        length = self._high - self._low
        self._low, self._high = self._low + ends[0] * length, self._low + ends[1] * length

    def nearest(self, places: Float[np.ndarray, "n 3"], run: float = 0.0) -> Int[np.ndarray, " n"]:
        """The point nearest to the image of each place (m) once the pattern has moved on by `run` (m)."""
        return self._tree.query(self._images(np.asarray(places, np.float64), run, 0)[0])[1].reshape(-1)

    def around(self, places: Float[np.ndarray, "n 3"], run: float = 0.0) -> MirrorImages:
        """All points in the box of a spacing around the image of each place (m) once the pattern has moved on by `run`.

        Where there is none, the next images are looked at.
        """
        places = np.asarray(places, np.float64)
        left, parts = np.arange(len(places)), []
        for attempt in range(TRIES):
            images, turned, beside = self._images(places[left], run, attempt)
            members = self._tree.query_ball_point(images, 0.5 * self._spacing, p=np.inf, return_sorted=True)
            count = np.array([len(m) for m in np.atleast_1d(members)], np.int64)
            if count.any():
                own = np.repeat(np.arange(len(left)), count)
                point = np.concatenate([m for m in members if m]).astype(np.int64)
                offset = self._points[point] - images[own]
                for axis, flip in ((self._along, turned[own]), (self._across, beside[own])):
                    offset[flip] -= 2.0 * (offset[flip] @ axis)[:, None] * axis
                parts.append(MirrorImages(left[own], offset, point))
            left = left[count == 0]
            if len(left) == 0:
                break
        if not parts:
            return MirrorImages(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, np.int64))
        return MirrorImages(
            *(np.concatenate([getattr(p, name) for p in parts]) for name in ("place", "offset", "point"))
        )

    def _images(self, places: np.ndarray, run: float, attempt: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where places are in the pattern, and whether mirrored along it and across it."""
        along, across = places @ self._along, places @ self._across
        first = (self._first - 0.5) * self._spacing
        inside, beside = folded(across, first, first + len(self._low) * self._spacing)
        row = np.clip(np.round(inside / self._spacing).astype(np.int64) - self._first, 0, len(self._low) - 1)
        low, high = self._low[row], self._high[row]
        target, turned = folded(along - run - attempt / TRIES * (high - low), low, high)
        images = places + (target - along)[:, None] * self._along + (inside - across)[:, None] * self._across
        if self._level is not None:
            images[:, 2] = places[:, 2] + self._level(images[:, :2]) - self._level(places[:, :2])
        return images, turned, beside
