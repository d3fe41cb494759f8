"""Raw optimiser variables to physical parameters and back: the only place where the maps exist.

The paper rescales each parameter by an exponential or a sigmoid "depending on whether negative values are
permissible". Here: a sigmoid where both ends bound it, an exponential where it must be positive, a scale where its
sign is free. One raw unit is about one natural scale of the parameter.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fluidlift.errors import require
from fluidlift.physics.rollout import RolloutParameters
from fluidlift.types import FluidParameters
from fluidlift.types.parameter_table import FITTABLE, VECTORS, FitVariable

UNITS = {name: p.unit for name, p in FITTABLE.items()}
"""every parameter that can be fitted, and its unit"""


class Range(ABC):
    """A monotone map from raw to physical."""

    @abstractmethod
    def physical(self, raw: Tensor) -> Tensor:
        """Physical value of a raw one; differentiable."""

    @abstractmethod
    def raw(self, physical: float) -> float:
        """The inverse, for values inside the range."""

    def slope(self, raw: float) -> float:
        """d physical / d raw: turns a raw standard deviation into a physical one."""
        x = torch.tensor(raw, dtype=torch.float64, requires_grad=True)
        self.physical(x).backward()
        assert x.grad is not None
        return abs(float(x.grad))


@dataclass(frozen=True)
class Bounded(Range):
    """Between `low` and `high`, by a sigmoid."""

    low: float = 0.0
    high: float = 1.0
    margin: float = 0.05
    """share of the width that a start at an end is moved inwards: the sigmoid is flat at its ends"""

    def physical(self, raw: Tensor) -> Tensor:
        return self.low + (self.high - self.low) * torch.sigmoid(raw)

    def raw(self, physical: float) -> float:
        share = min(max((physical - self.low) / (self.high - self.low), self.margin), 1 - self.margin)
        return math.log(share / (1 - share))


@dataclass(frozen=True)
class Positive(Range):
    """Positive, by an exponential; raw 0 is `scale`."""

    scale: float

    def __post_init__(self) -> None:
        require(self.scale > 0, f"scale {self.scale}", "a positive scale")

    def physical(self, raw: Tensor) -> Tensor:
        return self.scale * torch.exp(raw)

    def raw(self, physical: float) -> float:
        require(physical > 0, f"{physical} for a positive parameter", "a positive value")
        return math.log(physical / self.scale)


@dataclass(frozen=True)
class Signed(Range):
    """Of either sign, in units of `scale`."""

    scale: float

    def __post_init__(self) -> None:
        require(self.scale > 0, f"scale {self.scale}", "a positive scale")

    def physical(self, raw: Tensor) -> Tensor:
        return self.scale * raw

    def raw(self, physical: float) -> float:
        return physical / self.scale


@dataclass(frozen=True)
class FittedParameter:
    """One raw variable."""

    name: str
    """field of `FluidParameters`"""
    component: int | None
    """0, 1, 2 of a vector; None for a scalar"""
    range: Range
    prior: float
    """physical value that it keeps where the data say nothing"""
    center: float
    """the prior moved into the open range (a positive parameter may have the prior 0): centre of the prior's bell"""
    prior_sigma: float
    """standard deviation of the prior in raw units"""

    @property
    def label(self) -> str:
        """`gravity_z`, `restitution`, ..."""
        return self.name if self.component is None else f"{self.name}_{'xyz'[self.component]}"

    @property
    def prior_raw(self) -> float:
        """The centre of the prior in raw units."""
        return self.range.raw(self.center)


@dataclass(frozen=True)
class FixedParameter:
    """One number that the fit does not touch."""

    name: str
    component: int | None
    value: float

    @property
    def label(self) -> str:
        """As for a fitted one."""
        return self.name if self.component is None else f"{self.name}_{'xyz'[self.component]}"


@dataclass(frozen=True)
class ParameterSpace:
    """Which parameters are fitted and which are fixed."""

    fitted: tuple[FittedParameter, ...]
    fixed: tuple[FixedParameter, ...]

    @property
    def prior_raw(self) -> np.ndarray:
        """float64 [p]"""
        return np.array([f.prior_raw for f in self.fitted])

    @property
    def prior_sigma(self) -> np.ndarray:
        """float64 [p], raw"""
        return np.array([f.prior_sigma for f in self.fitted])

    def physical(self, raw: Tensor) -> RolloutParameters:
        """Physical tensors of the raw vector [p]; differentiable."""
        parts: dict[tuple[str, int | None], Tensor] = {
            (f.name, f.component): f.range.physical(raw[i]) for i, f in enumerate(self.fitted)
        }
        parts |= {(f.name, f.component): torch.as_tensor(f.value, dtype=raw.dtype) for f in self.fixed}
        values = {}
        for name in UNITS:
            is_vector = name in VECTORS
            values[name] = torch.stack([parts[name, a] for a in range(3)]) if is_vector else parts[name, None]
        return RolloutParameters(**values)

    def fluid_parameters(self, raw: np.ndarray, keep: np.ndarray | None = None) -> FluidParameters:
        """Plain numbers of the raw vector; those not kept have their prior to the digit, also where it is at an end."""
        if keep is not None:
            held = {f.label for f, k in zip(self.fitted, keep) if not k}
            return self.keep_prior(held).fluid_parameters(raw[keep])
        return self.physical(torch.as_tensor(raw, dtype=torch.float64)).fluid_parameters()

    def keep_prior(self, labels: set[str]) -> ParameterSpace:
        """The same space with some fitted parameters fixed at their prior."""
        stay = tuple(f for f in self.fitted if f.label not in labels)
        held = tuple(FixedParameter(f.name, f.component, f.prior) for f in self.fitted if f.label in labels)
        return ParameterSpace(stay, self.fixed + held)


def parameter_space(
    prior: FluidParameters,
    *,
    free: tuple[str, ...],
    speed: float,
    spacing: float,
    prior_sigmas: dict[str, float] | None = None,
) -> ParameterSpace:
    """The raw variables of the named parameters.

    Args:
        prior: values where the data say nothing.
        free: names of `FluidParameters` to fit; the others are fixed.
        speed: typical speed of the flow, m/s: the unit of velocities.
        spacing: cell width, m; with the speed it sets the viscosity below which the grid sees none.
        prior_sigmas: raw standard deviations that replace the defaults.

    Raises:
        ValueError: an unknown name.
    """
    unknown = set(free) - set(UNITS)
    require(not unknown, f"unknown parameters {sorted(unknown)}", ", ".join(UNITS))
    strength = max(math.hypot(*prior.gravity), 1e-3)
    units = {
        "density": 1000.0, "kinematic_viscosity": speed * spacing, "gravity": strength, "time_step": prior.time_step,
    }  # fmt: skip
    maps = {FitVariable.LOG: Positive, FitVariable.LINEAR: Signed}
    ranges: dict[str, Range] = {
        name: Bounded() if p.scale is FitVariable.LOGIT else maps[p.scale](units.get(name, speed))
        for name, p in FITTABLE.items()
    }
    floors = {"kinematic_viscosity": 1e-7, "inflow_fluctuation": 0.02 * speed}
    sigmas = {n: p.prior_sigma for n, p in FITTABLE.items() if p.prior_sigma is not None} | (prior_sigmas or {})
    fitted, fixed = [], []
    # what the rollout knows: surface tension is not part of it
    for name, values in ((n, v) for n, v in prior.to_dict().items() if n in UNITS):
        components = enumerate(values) if name in VECTORS else [(None, values)]
        for component, value in components:
            if name in free:
                center = max(value, floors[name]) if name in floors else value
                fitted.append(FittedParameter(name, component, ranges[name], value, center, sigmas[name]))
            else:
                fixed.append(FixedParameter(name, component, value))
    return ParameterSpace(tuple(fitted), tuple(fixed))
