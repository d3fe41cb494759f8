"""The pressure of a rollout: the ways through the Poisson equation and their gradients, behind one door (`project`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.physics.rollout_domain import RolloutDomain
from fluidlift.physics.rollout_operators import apply_linear
from fluidlift.types import SolveReport


@dataclass(frozen=True)
class RolloutOptions:
    """How a step is computed."""

    projection: str = "implicit"
    """"implicit": solved to `tolerance`, differentiated implicitly; "jacobi": exactly `sweeps` sweeps, self-adjoint"""
    tolerance: float = 1e-5
    sweeps: int = 100
    advection_gradient: str = "exact"
    """"exact", "upwind" (the paper's surrogate) or "plain" """
    max_iterations: int = 200


class _Pressure(torch.autograd.Function):
    """q with A q = rhs. A is symmetric, so the adjoint is the same solve (or the same sweeps) of the gradient.

    K Jacobi sweeps from zero are a polynomial in the scaled operator times its diagonal: symmetric as well.
    """

    @staticmethod
    def forward(
        ctx: Any,
        rhs: Tensor,
        system: PoissonSystem,
        options: RolloutOptions,
        guess: np.ndarray | None,
        kept: list[tuple[np.ndarray, SolveReport]],
    ) -> Tensor:
        ctx.system, ctx.options = system, options
        q, report = _solve_pressure(rhs, system, options, guess)
        kept.append((q, report))
        return torch.from_numpy(q.ravel())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        q, _ = _solve_pressure(gradients[0], ctx.system, ctx.options, None)
        return torch.from_numpy(q.ravel()), None, None, None, None


def _solve_pressure(
    rhs: Tensor, system: PoissonSystem, options: RolloutOptions, guess: np.ndarray | None
) -> tuple[np.ndarray, SolveReport]:
    b = np.where(system.unknown, rhs.detach().contiguous().numpy().reshape(system.unknown.shape), 0)
    if options.projection == "jacobi":
        return solve(system, b, method="jacobi", tolerance=0.0, max_iterations=options.sweeps)
    return solve(system, b, tolerance=options.tolerance, max_iterations=options.max_iterations, initial=guess)


def project(
    velocity: Float[Tensor, "f"],
    domain: RolloutDomain,
    *,
    options: RolloutOptions | None = None,
    guess: np.ndarray | None = None,
    kept: list[tuple[np.ndarray, SolveReport]] | None = None,
) -> Float[Tensor, "f"]:
    """The velocity without its divergence; appends the potential and the report of the solve to `kept`."""
    options = options or RolloutOptions()
    rhs = -apply_linear(velocity, domain.divergence)
    q = _Pressure.apply(rhs, domain.system, options, guess, [] if kept is None else kept)
    return velocity - apply_linear(q, domain.gradient)
