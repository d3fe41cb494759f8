"""What a simulation is told of the filmed flow beside its first instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from fluidlift.types.grid import FaceVelocity


@dataclass(frozen=True)
class Filmed:
    """On the grid of an asset."""

    force: FaceVelocity | None = None
    """m/s^2 beside gravity, that keeps the filmed flow; None: none"""
    dry: Bool[np.ndarray, "nx ny nz"] | None = None
    """cells that the clip shows dry throughout; None: not known"""
