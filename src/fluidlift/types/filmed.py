"""What a simulation is told of the filmed flow beside its first instant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.types.grid import FaceVelocity


@dataclass(frozen=True)
class FilmedMotion:
    """The velocity in the volume of each frame of a clip, on the faces of a grid; it begins anew when it is over.

    Raises:
        ValueError: no frames, arrays of different grids, or an interval that is not positive.
    """

    u: Float[np.ndarray, "t nx+1 ny nz"]
    """m/s"""
    v: Float[np.ndarray, "t nx ny+1 nz"]
    w: Float[np.ndarray, "t nx ny nz+1"]
    interval: float
    """s between frames"""
    start: int = 0
    """frame that the body at rest shows"""

    def __post_init__(self) -> None:
        shapes = {c.shape[:1] + tuple(n - (a == k) for k, n in enumerate(c.shape[1:])) for a, c in self._arrays()}
        require(len(shapes) == 1 and len(next(iter(shapes))) == 4, f"arrays {shapes}", "u, v, w of the same frames")
        require(len(self.u) > 0, "no frames", "one at least")
        require(self.interval > 0 and 0 <= self.start < len(self.u), f"{self.interval} s, start {self.start}",
                f"seconds above 0, 0 to {len(self.u) - 1}")  # fmt: skip

    def _arrays(self) -> enumerate:
        return enumerate((self.u, self.v, self.w))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells of the grid."""
        return (self.v.shape[1], self.u.shape[2], self.u.shape[3])

    @property
    def components(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """u, v, w."""
        return (self.u, self.v, self.w)

    def around(self, seconds: float) -> tuple[int, int, float]:
        """The frames before and after a time (s since the body at rest), and how far it is from one to the other; after
        the last comes the first."""
        frames = len(self.u)
        at = (self.start + seconds / self.interval) % frames
        before = min(int(at), frames - 1)
        return before, (before + 1) % frames, at - before


@dataclass(frozen=True)
class Filmed:
    """On the grid of an asset."""

    force: FaceVelocity | None = None
    """m/s^2 beside gravity, that keeps the filmed flow; None: none"""
    dry: Bool[np.ndarray, "nx ny nz"] | None = None
    """cells that the clip shows dry throughout; None: not known"""
    dry_for: float = math.inf
    """s from the body at rest for which they stay so: an outline that grows has them to the end of its clip"""
    wet: Bool[np.ndarray, "nx ny nz"] | None = None
    """cells that it shows wet throughout; None: not known"""
    motion: FilmedMotion | None = None
    """that a simulation can be guided by; None: it was not asked for"""
    inlet: Float[np.ndarray, "t 3"] | None = None
    """m that the inlet stands beside its place at rest in each frame of the film; None: it stays"""
