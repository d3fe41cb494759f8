"""Simulation particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require
from fluidlift.types.rows import rows


@dataclass(frozen=True)
class Particles:
    """The state of n particles. Ids are never used twice in one simulation."""

    positions: Float[np.ndarray, "n 3"]
    """m"""
    velocities: Float[np.ndarray, "n 3"]
    """m/s"""
    affine: Float[np.ndarray, "n 3 3"]
    """1/s: row a is the gradient of velocity component a (paper: C)"""
    deformation: Float[np.ndarray, "n 3 3"]
    """no unit (paper: F)"""
    masses: Float[np.ndarray, " n"]
    """kg"""
    source: Int[np.ndarray, " n"]
    """index of the rest Gaussian that lends its look"""
    ids: Int[np.ndarray, " n"]
    """stable over time"""

    def __post_init__(self) -> None:
        n = len(self.positions)
        shapes = {
            "positions": (n, 3), "velocities": (n, 3), "affine": (n, 3, 3), "deformation": (n, 3, 3),
            "masses": (n,), "source": (n,), "ids": (n,),
        }  # fmt: skip
        for name, shape in shapes.items():
            got = getattr(self, name).shape
            require(got == shape, f"{name} of shape {got}", str(shape))

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def at_rest(
        cls,
        positions: Float[np.ndarray, "n 3"],
        masses: float | Float[np.ndarray, " n"],
        source: Int[np.ndarray, " n"] | None = None,
        velocities: Float[np.ndarray, "n 3"] | None = None,
        first_id: int = 0,
    ) -> Particles:
        """Undeformed particles."""
        n = len(positions)
        return cls(
            np.ascontiguousarray(positions, np.float32),
            np.zeros((n, 3), np.float32) if velocities is None else np.ascontiguousarray(velocities, np.float32),
            np.zeros((n, 3, 3), np.float32),
            np.broadcast_to(np.eye(3, dtype=np.float32), (n, 3, 3)).copy(),
            np.broadcast_to(np.asarray(masses, np.float32), (n,)).copy(),
            np.zeros(n, np.int64) if source is None else np.asarray(source, np.int64),
            np.arange(first_id, first_id + n, dtype=np.int64),
        )

    def select(self, index: np.ndarray) -> Particles:
        """Those of a boolean or integer index."""
        return Particles(
            rows(self.positions, index), rows(self.velocities, index), rows(self.affine, index),
            rows(self.deformation, index), rows(self.masses, index), rows(self.source, index), rows(self.ids, index),
        )  # fmt: skip

    def joined(self, other: Particles) -> Particles:
        """These followed by others."""
        return Particles(
            *(
                np.concatenate([getattr(self, name), getattr(other, name)])
                for name in ("positions", "velocities", "affine", "deformation", "masses", "source", "ids")
            )
        )
