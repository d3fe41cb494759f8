"""Edits of the terrain before a simulation: moved, turned, scaled, twisted or replaced."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fluidlift.errors import require
from fluidlift.types import TriangleMesh


def _three(values: tuple[float, ...], what: str) -> tuple[float, float, float]:
    found = tuple(float(v) for v in values)
    require(len(found) == 3 and all(map(math.isfinite, found)), f"{what} {found}", "three finite numbers")
    return found  # type: ignore[return-value]


@dataclass(frozen=True)
class Move:
    """The terrain shifted as a whole."""

    offset: tuple[float, float, float]
    """m"""
    line: str = ""
    """where it stands in the file, for later complaints"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "offset", _three(self.offset, "offset"))


@dataclass(frozen=True)
class Rotate:
    """The terrain turned about the vertical through its centre, counter-clockwise seen from above."""

    degrees: float
    line: str = ""

    def __post_init__(self) -> None:
        require(math.isfinite(self.degrees), f"{self.degrees} degrees", "a finite number")


@dataclass(frozen=True)
class Scale:
    """The terrain stretched about its centre (its lowest height for z: the ground stays where it is)."""

    factors: tuple[float, float, float]
    line: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "factors", _three(self.factors, "factors"))
        require(min(self.factors) > 0, f"factors {self.factors}", "positive (a mirror would turn it inside out)")


@dataclass(frozen=True)
class Twist:
    """The terrain turned about the mainstream through its centre, the more the farther downstream."""

    degrees_per_metre: float
    line: str = ""

    def __post_init__(self) -> None:
        require(math.isfinite(self.degrees_per_metre), f"{self.degrees_per_metre} degrees per metre", "a finite number")


@dataclass(frozen=True)
class Replace:
    """Another solid instead of the terrain."""

    mesh: TriangleMesh
    """closed, m, in the world"""
    line: str = ""


TerrainEdit: TypeAlias = Move | Rotate | Scale | Twist | Replace
