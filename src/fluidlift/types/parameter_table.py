"""Table of the physical parameters: what scene.yaml, the fit and the viewer know of each, in one place."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class FitVariable(Enum):
    """In which variable a parameter is fitted, and its range of 95 % symmetric."""

    LOG = "logarithm"
    """positive"""
    LOGIT = "logit"
    """a share, 0 to 1"""
    LINEAR = "value"
    """of either sign"""


@dataclass(frozen=True)
class Parameter:
    """One field of `FluidParameters`."""

    unit: str
    limits: tuple[float, float]
    """what scene.yaml takes; of a vector each component"""
    scale: FitVariable
    prior_sigma: float | None
    """of the fit, in the fitted variable (of a vector or speed: its own size); None: no part of the rollout, not
    fitted"""
    example: str = ""
    """of a vector, as YAML"""
    label: str = ""
    """of its slider; empty: it has none, or several of its own"""
    span: tuple[float, float] = (0.0, 1.0)
    """of its slider"""
    hint: str = ""

    @property
    def is_vector(self) -> bool:
        """Three numbers."""
        return bool(self.example)

    @property
    def sign(self) -> str:
        """The unit with raised digits, as people see it."""
        return self.unit.replace("^2", "²").replace("^3", "³")


PARAMETERS: dict[str, Parameter] = {
    # the prior: pictures do not show it
    "density": Parameter("kg/m^3", (1e-3, 1e6), FitVariable.LOG, 0.1, label="density", span=(200.0, 5000.0),
                         hint="matters to what floats in it, and to surface tension"),
    # the prior: a factor e^3 = 20
    "kinematic_viscosity": Parameter("m^2/s", (0.0, 1e6), FitVariable.LOG, 3.0, label="viscosity", span=(1e-7, 1.0),
                                     hint="kinematic: water 1e-6, oil 1e-4, honey 7e-3, lava 0.1 m²/s and more"),
    "surface_tension": Parameter("N/m", (0.0, 10.0), FitVariable.LOG, None, label="surface tension", span=(0.0, 0.5),
                                 hint="water 0.072 N/m; drops and thin jets only; small cells then need short steps"),
    # the prior: 10 % and some 6 degrees, since a slow viscous flow only knows its ratio to the viscosity, and errors
    # of the free surface look like less of it
    "gravity": Parameter("m/s^2", (-1e3, 1e3), FitVariable.LINEAR, 0.1, example="[0, 0, -9.81]"),
    # the priors of velocities: the flow's own speed
    "inflow_velocity": Parameter("m/s", (-1e3, 1e3), FitVariable.LINEAR, 1.0, example="[1, 0, 0]"),
    "inflow_fluctuation": Parameter("m/s", (0.0, 1e3), FitVariable.LOG, 1.0, label="inflow fluctuation",
                                    hint="root mean square of how the speed at the inlet varies"),
    "outflow_velocity": Parameter("m/s", (-1e3, 1e3), FitVariable.LINEAR, 1.0),
    # the priors of wall coefficients: about the whole range
    "restitution": Parameter("", (0.0, 1.0), FitVariable.LOGIT, 1.5, label="bounce",
                             hint="share of the speed that a wall gives back"),
    "wall_damping": Parameter("", (0.0, 1.0), FitVariable.LOGIT, 2.5, label="wall friction",
                              hint="0: slips along walls freely; 1: sticks to them"),
    "time_step": Parameter("s", (1e-9, 1e3), FitVariable.LOG, 0.1),
}  # fmt: skip
"""by the names of `FluidParameters`, in its order"""
FITTABLE = {name: p for name, p in PARAMETERS.items() if p.prior_sigma is not None}
"""the paper's: what the differentiable rollout knows"""
VECTORS = tuple(name for name, p in PARAMETERS.items() if p.is_vector)
"""those with three numbers"""
