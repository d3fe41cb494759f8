"""How a fountain moves: every drop as a stone does, from its nozzle to its apex and back into the pool.

A clip shows how high the water gets and how wide it lands, and its mean motion only the outer half of it. Both say all
of a flight without drag: with the height h it leaves with v = sqrt(2 g h), is in the air for T = 2 v / g, and spreads
evenly over a circle of radius R, (R - r) / T to the side from a nozzle of radius r. Within the cone of what rises it
rises, outside of it what came down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from fluidlift.errors import require
from fluidlift.types import GRAVITY, CellType, FaceVelocity, Grid


@dataclass(frozen=True)
class Flight:
    """A column of a fountain, m, z up."""

    nozzle: tuple[float, float]
    """x, y of where it rises"""
    landing: tuple[float, float]
    """x, y of the middle of where it lands; wind, or a nozzle that leans, takes it there"""
    level: float
    """z of the mouth of its nozzle, over the pool"""
    height: float
    """above that"""
    narrow: float
    """radius that it rises with"""
    wide: float
    """radius that it lands with"""

    def __post_init__(self) -> None:
        require(self.height > 0, f"a fountain {self.height} m high", "more than 0")
        require(0 < self.narrow <= self.wide, f"a fountain of {self.narrow} to {self.wide} m", "radii that grow")

    @property
    def speed(self) -> float:
        """m/s at the nozzle."""
        return float(np.sqrt(2.0 * GRAVITY * self.height))

    @property
    def duration(self) -> float:
        """s in the air."""
        return 2.0 * self.speed / GRAVITY

    def velocity(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """m/s at points (m); below the level what is in the nozzle."""
        points = np.asarray(points, np.float64)
        over = np.clip(points[:, 2] - self.level, 0.0, self.height)
        along = np.sqrt(np.maximum(self.speed**2 - 2.0 * GRAVITY * over, 0.0))
        carried = (np.asarray(self.landing) - np.asarray(self.nozzle)) / self.duration
        growth = (self.wide - self.narrow) / self.duration
        out = np.zeros_like(points)
        rising = np.zeros(len(points), bool)
        for way, time in ((1.0, (self.speed - along) / GRAVITY), (-1.0, (self.speed + along) / GRAVITY)):
            radius = self.narrow + growth * time
            away = points[:, :2] - np.asarray(self.nozzle) - carried * time[:, None]
            share = away / radius[:, None]
            share /= np.maximum(np.linalg.norm(share, axis=1, keepdims=True), 1.0)
            moves = np.concatenate([carried + growth * share, (way * along)[:, None]], axis=1)
            within = np.hypot(*away.T) <= radius
            use = within if way > 0 else ~rising
            out[use] = moves[use]
            rising = within
        return out


def with_flights(
    velocity: FaceVelocity,
    flights: Sequence[Flight],
    cell_types: UInt8[np.ndarray, "nx ny nz"],
    surface_height: Float[np.ndarray, "nx ny"],
    grid: Grid,
) -> FaceVelocity:
    """The velocity (m/s), with that of the nearest flight in inlets and in all fluid above the surface of the pool."""
    if not flights:
        return velocity
    cells = np.asarray(cell_types)
    above = grid.centers()[..., 2] > np.asarray(surface_height)[..., None]
    flies = (cells == CellType.INFLOW) | (above & (cells == CellType.FLUID))
    out = []
    for axis, component in enumerate(velocity.components):
        padded = np.pad(flies, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        count = flies.shape[axis]
        beside = np.take(padded, range(count + 1), axis) | np.take(padded, range(1, count + 2), axis)
        points = grid.faces(axis)[beside]
        away = np.stack([np.hypot(*(points[:, :2] - np.asarray(f.landing)).T) / f.wide for f in flights])
        nearest, changed = away.argmin(axis=0), np.array(component)
        values = np.zeros(len(points))
        for number, flight in enumerate(flights):
            own = nearest == number
            values[own] = flight.velocity(points[own])[:, axis]
        changed[beside] = values
        out.append(changed)
    return FaceVelocity(*out)
