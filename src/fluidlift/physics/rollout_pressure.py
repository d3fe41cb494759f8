"""The pressure of a rollout: the ways through the Poisson equation and their gradients, behind one door (`project`).

Four routes solve A q = rhs, where A is symmetric:

* "implicit" (default): multigrid to a tolerance. The gradient is one more solve; nothing is stored.
* "jacobi": a fixed number of sweeps from zero. Their map is symmetric, so the gradient is as many sweeps of the
  incoming gradient; nothing is stored.
* "unrolled": the same sweeps as torch records them, every sweep kept until `backward`; the same numbers.
* "recurrent": the fitted recurrent convolution of the paper (PeRCNN, `numerics.recurrent_stencil`), symmetric as well;
  "recurrent_unrolled" is the form of the paper, recorded by torch.

A fixed number of sub-steps is not a solve to a tolerance: `SolveReport.residual` says what is left.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.errors import require
from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.numerics.recurrent_stencil import (
    FittedStencil,
    LayerInput,
    LayerWeights,
    recurrent_layers,
    recurrent_solve,
    relative_residual,
    stencil_domain,
)
from fluidlift.numerics.recurrent_stencil_fit import (
    PressureSample,
    StencilValidation,
    fit_recurrent_stencil,
    validate,
)
from fluidlift.physics.rollout_domain import RolloutDomain
from fluidlift.physics.rollout_operators import apply_linear, subtract_gradient
from fluidlift.types import SolveReport

ROUTES = ("implicit", "jacobi", "unrolled", "recurrent", "recurrent_unrolled")
ADVECTION_GRADIENTS = ("exact", "upwind", "plain")


class PressureRoute(ABC):
    """A way from the right side to the potential."""

    @abstractmethod
    def solve(
        self, rhs: Float[Tensor, " c"], system: PoissonSystem, guess: Float[np.ndarray, "nx ny nz"] | None
    ) -> tuple[Float[Tensor, " c"], SolveReport]:
        """q with A q = rhs, 0 outside the unknown cells; differentiable in `rhs`.

        Args:
            rhs: one value per cell in C order, q / m^2; values outside the unknown cells are ignored.
            system: the operator.
            guess: where to begin; routes of fixed work begin at zero, where alone their map is linear.
        """


class SymmetricRoute(PressureRoute):
    """A route whose map is symmetric: its adjoint is the map itself, and nothing is stored between the two."""

    @abstractmethod
    def potential(
        self, rhs: Float[np.ndarray, "nx ny nz"], system: PoissonSystem, guess: Float[np.ndarray, "nx ny nz"] | None
    ) -> tuple[Float[np.ndarray, "nx ny nz"], SolveReport]:
        """The map on arrays, without a record."""

    def solve(
        self, rhs: Float[Tensor, " c"], system: PoissonSystem, guess: Float[np.ndarray, "nx ny nz"] | None
    ) -> tuple[Float[Tensor, " c"], SolveReport]:
        """See `PressureRoute`."""
        reports: list[SolveReport] = []
        q = _SymmetricMap.apply(rhs, self, system, guess, reports)
        return q, reports[0]


class _SymmetricMap(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rhs: Tensor,
        route: SymmetricRoute,
        system: PoissonSystem,
        guess: np.ndarray | None,
        reports: list[SolveReport],
    ) -> Tensor:
        ctx.route, ctx.system = route, system
        q, report = route.potential(_cells(rhs, system), system, guess)
        reports.append(report)
        return torch.from_numpy(q.ravel())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        q, _ = ctx.route.potential(_cells(gradients[0], ctx.system), ctx.system, None)
        return torch.from_numpy(q.ravel()), None, None, None, None


def _cells(values: Tensor, system: PoissonSystem) -> np.ndarray:
    """Right side per cell, 0 outside the unknown cells."""
    return np.where(system.unknown, values.detach().contiguous().numpy().reshape(system.unknown.shape), 0)


@dataclass(frozen=True)
class ImplicitPressure(SymmetricRoute):
    """Solved to a tolerance, differentiated implicitly: A q = rhs gives A dq = drhs."""

    tolerance: float = 1e-5
    max_iterations: int = 200

    def potential(
        self, rhs: Float[np.ndarray, "nx ny nz"], system: PoissonSystem, guess: Float[np.ndarray, "nx ny nz"] | None
    ) -> tuple[Float[np.ndarray, "nx ny nz"], SolveReport]:
        """Multigrid-preconditioned conjugate gradients."""
        return solve(system, rhs, tolerance=self.tolerance, max_iterations=self.max_iterations, initial=guess)


@dataclass(frozen=True)
class RecurrentPressure(SymmetricRoute):
    """Sub-steps of a stencil from zero; Jacobi's sweeps are those of `FittedStencil.jacobi`."""

    stencil: FittedStencil
    tolerance: float = 1e-5
    """what the report calls converged"""
    method: str = "recurrent"

    def potential(
        self, rhs: Float[np.ndarray, "nx ny nz"], system: PoissonSystem, guess: Float[np.ndarray, "nx ny nz"] | None
    ) -> tuple[Float[np.ndarray, "nx ny nz"], SolveReport]:
        """The compiled recurrence."""
        q = recurrent_solve(self.stencil, stencil_domain(system), rhs)
        return q, _report(q, rhs, system, self.stencil, self.tolerance, self.method)


@dataclass(frozen=True)
class UnrolledPressure(PressureRoute):
    """The same sub-steps in plain torch, recorded one by one: `backward` walks the record (the form of the paper)."""

    stencil: FittedStencil
    tolerance: float = 1e-5
    method: str = "unrolled"

    def solve(
        self, rhs: Float[Tensor, " c"], system: PoissonSystem, guess: Float[np.ndarray, "nx ny nz"] | None
    ) -> tuple[Float[Tensor, " c"], SolveReport]:
        """See `PressureRoute`."""
        domain = stencil_domain(system)
        inside = torch.from_numpy(domain.inside)
        b = _without_constants(domain.crop(rhs.reshape(system.unknown.shape)) * inside, domain.closed)
        weights, conditions = LayerWeights.of(self.stencil, rhs.dtype), LayerInput.of(domain, rhs.dtype)
        boxed = _without_constants(recurrent_layers(weights, conditions, b, self.stencil.sub_steps), domain.closed)
        q = domain.uncrop(boxed)
        report = _report(q.detach().numpy(), _cells(rhs, system), system, self.stencil, self.tolerance, self.method)
        return q.reshape(-1), report


def _without_constants(values: Tensor, closed: np.ndarray) -> Tensor:
    """Values less their mean over each closed component, recorded."""
    for group in range(int(closed.max(initial=-1)) + 1):
        at = torch.from_numpy(closed == group)
        values = values - at * (values * at).sum() / at.sum()
    return values


def _report(
    q: np.ndarray, rhs: np.ndarray, system: PoissonSystem, stencil: FittedStencil, tolerance: float, method: str
) -> SolveReport:
    residual = relative_residual(stencil_domain(system), rhs, q)
    converged = residual <= tolerance
    advice = "" if converged else f"a fixed {stencil.sub_steps} sub-steps: take more, or the implicit route"
    return SolveReport(converged, stencil.sub_steps, residual, method, advice)


@dataclass(frozen=True)
class RolloutOptions:
    """How a step is computed."""

    projection: str = "implicit"
    """the pressure's route, one of `ROUTES`"""
    tolerance: float = 1e-5
    """relative residual of the implicit solve; what others leave is judged by it"""
    sweeps: int = 100
    """of "jacobi" and "unrolled" """
    advection_gradient: str = "exact"
    """"exact", "upwind" (the paper's surrogate) or "plain" """
    max_iterations: int = 200
    stencil: FittedStencil | None = None
    """of "recurrent" and "recurrent_unrolled": fitted and validated, see `recurrent_options`"""

    def __post_init__(self) -> None:
        require(self.projection in ROUTES, f"projection '{self.projection}'", " or ".join(ROUTES))
        gradients = ADVECTION_GRADIENTS
        require(
            self.advection_gradient in gradients,
            f"advection gradient '{self.advection_gradient}'",
            " or ".join(gradients),
        )
        needs = self.projection.startswith("recurrent")
        require(
            not needs or self.stencil is not None, f"projection '{self.projection}' without a stencil",
            "a fitted stencil", "fit one with recurrent_options",
        )  # fmt: skip

    @property
    def fixed_work(self) -> bool:
        """The number of sub-steps is given and the residual is what it is: not converging is no failure."""
        return self.projection != "implicit"

    def route(self) -> PressureRoute:
        """The way through the pressure solve."""
        if self.projection == "implicit":
            return ImplicitPressure(self.tolerance, self.max_iterations)
        plain = self.projection in ("jacobi", "unrolled")
        stencil = FittedStencil.jacobi(self.sweeps) if plain else self.stencil
        assert stencil is not None
        recorded = self.projection.endswith("unrolled")
        return (UnrolledPressure if recorded else RecurrentPressure)(stencil, self.tolerance, self.projection)


def project(
    velocity: Float[Tensor, " f"],
    domain: RolloutDomain,
    *,
    options: RolloutOptions | None = None,
    guess: np.ndarray | None = None,
    kept: list[tuple[np.ndarray, SolveReport]] | None = None,
) -> Float[Tensor, " f"]:
    """The velocity without its divergence; appends the potential and the report of the solve to `kept`."""
    options = options or RolloutOptions()
    rhs = -apply_linear(velocity, domain.divergence)
    q, report = options.route().solve(rhs, domain.system, guess)
    if kept is not None:
        kept.append((q.detach().numpy().reshape(domain.shape), report))
    return subtract_gradient(velocity, q, domain)


def sample_pressure_problems(
    domains: Sequence[RolloutDomain], potentials: Sequence[np.ndarray], *, most: int = 6, seed: int = 0
) -> list[PressureSample]:
    """Pairs of right side and solution from a rollout with the implicit solver (paper: "recording the pressure field
    both before and after solving"), and one pair of rough data per layout, since what comes back through `backward` is
    no flow.

    Args:
        domains: one per potential.
        potentials: `Rollout.potentials`, m^2/s.
        most: samples from the rollout, spread over it.
        seed: of the rough data.

    Returns:
        (system, rhs, q) with A q = rhs to rounding.
    """
    require(len(domains) == len(potentials) > 0, f"{len(potentials)} potentials, {len(domains)} domains", "as many")
    samples = []
    pick = np.unique(np.linspace(0, len(potentials) - 1, min(most, len(potentials))).astype(int))
    for i in pick:
        q = np.asarray(potentials[i], np.float64)
        samples.append(PressureSample(domains[i].system, domains[i].system.apply(q), q))
    rng = np.random.default_rng(seed)
    for domain in {id(domains[i]): domains[i] for i in pick}.values():
        rough = (rng.standard_normal(domain.offsets[3]) * domain.dynamic).astype(domain.interior.dtype)
        rhs = -apply_linear(torch.from_numpy(rough), domain.divergence).reshape(domain.shape).double().numpy()
        q, _ = solve(domain.system, rhs, tolerance=1e-9)
        samples.append(PressureSample(domain.system, domain.system.apply(q), q))
    return samples


def recurrent_options(
    domains: Sequence[RolloutDomain],
    potentials: Sequence[np.ndarray],
    options: RolloutOptions | None = None,
    *,
    iterations: int = 60,
    seed: int = 0,
) -> tuple[RolloutOptions, StencilValidation]:
    """Fit the recurrent stencil to a rollout's pressures, validate it on others, and choose.

    Args:
        domains: one per potential.
        potentials: of a rollout with the implicit solver; every other one is kept for validation.
        options: what else the rollout shall do; `sweeps` is the number of sub-steps.
        iterations: of the fit.
        seed: of the rough data and the order of the samples.

    Returns:
        options with the route "recurrent", or "implicit" where the stencil did not pass; the validation says why.
    """
    options = options or RolloutOptions()
    require(len(potentials) >= 2, f"{len(potentials)} potential(s)", "two or more: some to fit, some to validate")
    learn = sample_pressure_problems(domains[::2], potentials[::2], seed=seed)
    check = sample_pressure_problems(domains[1::2], potentials[1::2], seed=seed + 1)
    stencil = fit_recurrent_stencil(learn, sub_steps=options.sweeps, iterations=iterations, seed=seed)
    validation = validate(stencil, check)
    if not validation.accepted:
        return replace(options, projection="implicit", stencil=None), validation
    return replace(options, projection="recurrent", stencil=stencil), validation
