"""Emitters: closed meshes in the world whose volume is kept full of fluid while they are on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fluidlift.errors import require
from fluidlift.types import TriangleMesh


@dataclass(frozen=True)
class Emitter:
    """A tap, a nozzle, a spring: while start <= t < end its volume is filled with fluid at its velocity."""

    name: str
    mesh: TriangleMesh
    """closed, m, in the world"""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m/s, of what comes out"""
    start: float = 0.0
    """s"""
    end: float | None = None
    """s; None: it never ends"""
    color: tuple[float, float, float] | None = None
    """sRGB in [0, 1]; None: that of the nearest Gaussian at rest"""
    line: str = ""
    """where it stands in the file, for later complaints"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", tuple(float(v) for v in self.velocity))
        require(len(self.velocity) == 3 and all(map(math.isfinite, self.velocity)), f"velocity {self.velocity}")
        require(math.isfinite(self.start) and self.start >= 0, f"start {self.start}", "0 s or more")
        require(self.end is None or self.end > self.start, f"end {self.end} s", f"later than the start, {self.start} s")
        if self.color is not None:
            object.__setattr__(self, "color", tuple(float(c) for c in self.color))
            require(len(self.color) == 3 and all(0 <= c <= 1 for c in self.color), f"color {self.color}", "0 to 1")

    def on(self, time: float) -> bool:
        """Whether it runs at a time (s)."""
        return self.start <= time and (self.end is None or time < self.end)
