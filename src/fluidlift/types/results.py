"""What solvers and fits report. A numerical failure is a value, judged at the boundary."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fluidlift.types.parameters import Estimate, FluidParameters


@dataclass(frozen=True)
class SolveReport:
    """How an iterative solve ended."""

    converged: bool
    iterations: int
    residual: float
    """true relative residual |b - A x| / |b|"""
    method: str = ""
    advice: str = ""


@dataclass(frozen=True)
class FitResult:
    """Fitted parameters and the way there."""

    parameters: FluidParameters
    estimates: dict[str, Estimate]
    loss_history: np.ndarray
    """float [iterations]"""
    converged: bool
    rollouts: int
    """number of value-and-gradient evaluations"""
    notes: tuple[str, ...] = ()
    extra: dict[str, float] = field(default_factory=dict)
    """figures for the report, such as the loss of a fluid at rest"""
    reason: str = ""
    """why the fit failed and the parameters are the initial ones; empty where it did not"""
    ends: tuple[FluidParameters, ...] = ()
    """where fits from several initial scales ended, the given one's first; empty where there was one"""
