"""Physical parameters of a fluid, and how well they are known."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected, require

GRAVITY = 9.81
"""m/s^2, at the surface of the earth"""


@dataclass(frozen=True)
class FluidParameters:
    """What the simulator needs to know (paper: v_in, v~_in, v_out, rho, nu, b, d, g, dt)."""

    density: float = 1000.0
    """kg/m^3"""
    kinematic_viscosity: float = 1e-6
    """m^2/s"""
    surface_tension: float = 0.0
    """N/m; 0: none. It limits the time step (`surface_tension.capillary_time_step`)"""
    gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY)
    """m/s^2"""
    inflow_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m/s, bulk velocity at the inlet"""
    inflow_fluctuation: float = 0.0
    """m/s, root mean square of the variation of the inlet velocity over the inlet and over time"""
    outflow_velocity: float = 0.0
    """m/s, bulk speed through the outlet along the mainstream"""
    restitution: float = 0.0
    """0 to 1: share of the normal velocity that a wall gives back"""
    wall_damping: float = 0.0
    """0 (free slip) to 1 (no slip): share of the tangential velocity that a wall takes at the scale of the grid"""
    time_step: float = 0.01
    """s, longest simulation step"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "gravity", tuple(float(g) for g in self.gravity))
        object.__setattr__(self, "inflow_velocity", tuple(float(g) for g in self.inflow_velocity))
        for name in ("gravity", "inflow_velocity"):
            require(len(getattr(self, name)) == 3, f"{name} {getattr(self, name)}", "three components")
        numbers = [*self.gravity, *self.inflow_velocity] + [
            v for v in asdict(self).values() if isinstance(v, int | float)
        ]
        require(bool(np.isfinite(numbers).all()), "a parameter that is not a finite number")
        require(self.density > 0, f"density {self.density}", "positive kg/m^3")
        require(self.kinematic_viscosity >= 0, f"kinematic viscosity {self.kinematic_viscosity}", "0 or more m^2/s")
        require(self.surface_tension >= 0, f"surface tension {self.surface_tension}", "0 or more N/m")
        require(0 <= self.restitution <= 1, f"restitution {self.restitution}", "0 to 1")
        require(0 <= self.wall_damping <= 1, f"wall damping {self.wall_damping}", "0 to 1")
        require(self.time_step > 0, f"time step {self.time_step}", "positive seconds")
        require(self.inflow_fluctuation >= 0, f"inflow fluctuation {self.inflow_fluctuation}", "0 or more m/s")

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    def updated(self, overrides: dict[str, Any]) -> FluidParameters:
        """With some values replaced.

        Raises:
            InputRejected: an unknown name or a value of the wrong kind or range.
        """
        known = set(asdict(self))
        for name in overrides:
            if name not in known:
                raise InputRejected(f"unknown parameter '{name}'", "one of " + ", ".join(sorted(known)))
        try:
            clean = {k: tuple(v) if isinstance(v, list) else v for k, v in overrides.items()}
            return replace(self, **clean)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputRejected(f"parameters that do not fit: {error}") from None


@dataclass(frozen=True)
class Estimate:
    """One fitted number."""

    value: float
    sigma: float
    """standard deviation, in the unit of the value; inf where the data say nothing"""
    identifiable: bool
    """determined by the data, and sigma at most 5 % (`precise_within`) of the value, of a vector for its components.
    Else it is known loosely (`value` is the fitted one all the same), or not determined (`value` is the prior)"""
    prior: float
    unit: str = ""
    interval: tuple[float, float] | None = None
    """holds the value with 95 %; None where nothing is known"""
    source: str = ""
    """where the value comes from, in words: fitted, measured, given, or a prior (docs/fit.md)"""

    @property
    def fitted(self) -> bool:
        """The value is the data's, well or loosely known: what they say nothing about keeps its prior to the digit."""
        return math.isfinite(self.sigma) and (self.identifiable or self.value != self.prior)
