"""Surfaces that are functions of the ground position: planes, profiles, samples."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.numerics.nearest import nearest

FOOT = 1.0
"""degrees: slope of what runs below a fall. A basin is level and a stream hardly steeper; more would empty either"""
FARTHEST = 12.0
"""ratio of the largest and the smallest depth that a fluid's surface is believed to have: what would be farther counts
as that far, and hardly moves"""


class HeightModel(ABC):
    """A surface that is a function of the ground position."""

    @property
    def steps(self) -> bool:
        """Whether fluid comes down onto the rest of it, from an upper end that stands higher."""
        return False

    @abstractmethod
    def height(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """z above the ground positions."""

    def sheet(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Greatest thickness of the fluid above the ground positions; infinite where the surface does not say."""
        return np.full(np.shape(xy)[:-1], np.inf)


@dataclass(frozen=True)
class PlaneHeight(HeightModel):
    """z = slope . (x, y) + offset."""

    slope: tuple[float, float]
    offset: float

    def height(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """z above the ground positions."""
        return xy[..., 0] * self.slope[0] + xy[..., 1] * self.slope[1] + self.offset


@dataclass(frozen=True)
class ProfileHeight(HeightModel):
    """A surface of translation: z depends on the distance uphill alone (a fall)."""

    away: Float[np.ndarray, " k"]
    """increasing distances (x, y) . uphill"""
    z: Float[np.ndarray, " k"]
    uphill: tuple[float, float] = (0.0, 1.0)
    """unit vector over the ground; away from the viewer for a fall seen from the front"""

    def height(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """z above the ground positions; level beyond the upper end, sloping by `FOOT` beyond the foot."""
        y = xy[..., 0] * self.uphill[0] + xy[..., 1] * self.uphill[1]
        inside = np.interp(y, self.away, self.z)
        return np.where(y < self.away[0], self.z[0] - (self.away[0] - y) * np.tan(np.radians(FOOT)), inside)


@dataclass(frozen=True)
class ProfileAlongHeight(HeightModel):
    """A surface that is level across a stream: z depends on the distance along it alone."""

    ahead: tuple[float, float]
    """unit vector that points downstream over the ground"""
    along: Float[np.ndarray, " k"]
    """increasing distances (x, y) . ahead"""
    z: Float[np.ndarray, " k"]

    def height(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """z above the ground positions; straight on beyond both ends."""
        s = xy[..., 0] * self.ahead[0] + xy[..., 1] * self.ahead[1]
        first, last = np.diff(self.z)[[0, -1]] / np.diff(self.along)[[0, -1]]
        before, after = np.minimum(s - self.along[0], 0.0), np.maximum(s - self.along[-1], 0.0)
        return np.interp(s, self.along, self.z) + first * before + last * after


@dataclass(frozen=True)
class SampledHeight(HeightModel):
    """A surface through given points: inverse-distance mean of the nearest four."""

    points: Float[np.ndarray, "n 3"]

    def height(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """z above the ground positions."""
        flat = np.asarray(xy).reshape(-1, 2)
        distance, index = nearest(self.points[:, :2], flat, min(4, len(self.points)))
        distance, index = distance.reshape(len(flat), -1), index.reshape(len(flat), -1)
        weight = 1.0 / (distance + 1e-6)
        z = (weight * self.points[index, 2]).sum(1) / weight.sum(1)
        return z.reshape(np.shape(xy)[:-1])
