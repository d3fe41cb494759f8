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
    """by label (`gravity_z`, `restitution`, ...): identifiable (sigma within 5 %), known loosely (fitted all the same),
    or not determined by the data (the prior)"""
    loss_history: np.ndarray
    """float [iterations]"""
    converged: bool
    """False with an empty `reason`: better than the first guess, but not at the minimum; `notes` say what ended it"""
    rollouts: int
    """of one window, all told; a gradient counts as three"""
    notes: tuple[str, ...] = ()
    extra: dict[str, float] = field(default_factory=dict)
    """figures for the report, such as the loss of a fluid at rest"""
    reason: str = ""
    """why the fit failed and the parameters are the initial ones; empty where it did not"""
    ends: tuple[FluidParameters, ...] = ()
    """where fits from several initial scales ended, the given one's first; empty where there was one"""
