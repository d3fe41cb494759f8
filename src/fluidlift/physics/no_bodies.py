"""Where there are no rigid bodies: what `rigid.RigidBodies` does, for none (a null object)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fluidlift.messages import Notice
from fluidlift.numerics.poisson import LowRankTerm
from fluidlift.physics import boundaries
from fluidlift.physics.active_region import ActiveRegion
from fluidlift.physics.boundaries import Walls
from fluidlift.physics.viscous_bodies import DraggedBody
from fluidlift.types import FaceVelocity


class NoBodies:
    """Nothing is inside, nothing is pushed, and walls are those of the region."""

    warnings: tuple[Notice, ...] = ()

    def __init__(self) -> None:
        self.position, self.orientation = np.zeros((0, 3)), np.zeros((0, 4))
        self._walls: Walls | None = None

    def __len__(self) -> int:
        return 0

    def inside(self, positions: np.ndarray) -> np.ndarray:
        """bool [n]: none."""
        return np.zeros(len(positions), bool)

    def max_speed(self, horizon: float) -> float:
        """0 m/s."""
        return 0.0

    def enter(self, region: ActiveRegion) -> ActiveRegion:
        """The region as it is."""
        self._walls = region.walls
        return region

    def predict(self, dt: float, pressure_rate: np.ndarray | None = None) -> None:
        """Nothing."""

    def face_velocity(self) -> FaceVelocity | None:
        """None: all walls are at rest."""
        return None

    def dragged(self) -> tuple[DraggedBody, ...]:
        """None."""
        return ()

    def apply_viscosity(self, dragged: Sequence[DraggedBody], change: np.ndarray) -> None:
        """Nothing."""

    def coupling(self, unknown: np.ndarray) -> tuple[LowRankTerm, ...]:
        """None."""
        return ()

    def apply_pressure(self, q: np.ndarray) -> None:
        """Nothing."""

    def fill_films(self, types: np.ndarray) -> np.ndarray:
        """The cell types as they are."""
        return types

    def slide(self, velocity: FaceVelocity) -> FaceVelocity:
        """Along the walls of the region."""
        assert self._walls is not None  # `enter` was called
        return boundaries.slide_along_walls(velocity, self._walls)

    def advance(self) -> None:
        """Nothing."""

    def push_out(self, positions: np.ndarray, velocities: np.ndarray, *, tangential_share: float = 1.0) -> np.ndarray:
        """bool [n], particles that found no place: none."""
        return np.zeros(len(positions), bool)

    def state(self) -> dict[str, np.ndarray]:
        """Nothing."""
        return {}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Nothing."""
