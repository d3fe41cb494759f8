"""Errors in what a rollout begins with are errors of the data too: the start of a window as an unknown.

The start is an unknown beside the parameters, with the measured one as its prior (strong-constraint 4D-Var). For a
linear model and errors of known ratio this is total least squares, which unlike a fit that trusts a noisy start is
consistent (Fuller, Measurement Error Models, 1987): trusted, the errors of a start pass for shear, and viscosity is
raised to damp them.

* `corrected_starts` finds the start by L-BFGS (SciPy's) on the adjoint gradient, at fixed parameters.
* `profile` finds how that start moves with each parameter, and so the derivative of all residuals along it (variable
  projection; Golub & Pereyra 1973). What is left of a column says how much the data know of a parameter once the
  start has explained what it can.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import fmin_l_bfgs_b
from torch import Tensor

from fluidlift.fit.evaluation import BACKWARD, Budget, Jacobian, Residuals, products
from fluidlift.fit.problem import FitProblem
from fluidlift.fit.ranges import ParameterSpace

PROBE = 0.02
"""largest change of a face, in units of U, that a directional derivative is measured with"""
SETTLED = 1e-3
"""of the objective: where no more than that is left to gain, a start is found. A quadratic whose curvature is at least
that of the departures is lowered by g^2 / (2 curvature) at most"""


class _Settled(Exception):
    """A start that will do: the search goes on until it is told to end."""

    def __init__(self, point: np.ndarray) -> None:
        self.point = point.copy()


def corrected_starts(
    problem: FitProblem, space: ParameterSpace, raw: Float[np.ndarray, " p"], budget: Budget, *, iterations: int = 8
) -> FitProblem:
    """The problem from starts that fit their windows better, at fixed parameters."""
    parameters = space.physical(torch.as_tensor(raw, dtype=torch.float32))
    calls = [0] * len(problem.windows)

    def one(index: int) -> Tensor:
        begin, unit = problem.windows[index].start, problem.speed
        count, known = begin.numel(), []
        # of the departure alone: what the loss adds makes the valley steeper, so that less is left to gain
        curvature = 2.0 * count * unit**2 * problem.start_weight(index)
        inverse = torch.where(curvature > 0, 1.0 / curvature, 0.0)

        def objective(point: np.ndarray) -> tuple[float, np.ndarray]:
            move = torch.as_tensor(point, dtype=torch.float32).requires_grad_()
            start = begin + unit * move
            run = problem.roll(index, parameters, known or None, start)
            known[:] = run.potentials  # first guesses for the next one, which is near
            total = problem.loss(index, run) + problem.departure(index, start)
            # single precision: the gradient of a mean over many faces would be tiny
            total = total * count
            total.backward()
            calls[index] += 1
            assert move.grad is not None
            value = float(total.detach())
            if 0.5 * float((move.grad**2 * inverse).sum()) < SETTLED * value:
                raise _Settled(point)
            return value, move.grad.double().numpy()

        # as many past steps as there are make up the curvature; when to end is said by the two bounds and above
        bounds = {"maxiter": iterations, "maxfun": 2 * iterations, "m": iterations, "factr": 0.0, "pgtol": 0.0}
        try:
            move = fmin_l_bfgs_b(objective, np.zeros(count), **bounds)[0]
        except _Settled as end:
            move = end.point
        found = begin + unit * torch.as_tensor(move, dtype=torch.float32)
        return found if bool(torch.isfinite(found).all()) else begin

    starts = budget.each(problem, one, list(range(len(problem.windows))))
    budget.count(problem, (1 + BACKWARD) * float(np.mean(calls)))
    return problem.with_starts(starts)


@dataclass(frozen=True)
class Profile:
    """Residuals of loss and start together, and their derivatives along the best start."""

    slopes: Jacobian
    """columns: the loss's residuals, then one row per face of the start"""
    moves: list[Float[np.ndarray, "p f"]]
    """d start / d raw, per window"""


def start_residuals(problem: FitProblem) -> list[Float[np.ndarray, " f"]]:
    """Squares add up to the departures from the measured starts, per window."""
    return [
        (torch.sqrt(problem.start_weight(i)) * (w.start - w.measured)).double().numpy()
        for i, w in enumerate(problem.windows)
    ]


def profile(
    problem: FitProblem, space: ParameterSpace, here: Residuals, slopes: Jacobian, budget: Budget, *, iterations: int
) -> Profile:
    """Derivatives along the best start, by conjugate gradients on the start's normal equations.

    Args:
        problem: from corrected starts.
        space: of the parameters.
        here: residuals of the loss from these starts.
        slopes: their derivatives at fixed starts.
        budget: counts the work.
        iterations: of the conjugate gradients; eigenvalues lie between 1 and about one plus the number of frames.
    """
    n, workers = len(problem.windows), 1 if problem.placed else budget.workers
    # as many equal parts of windows as keep all workers busy to the end
    parts = [
        (i, part)
        for i, columns in enumerate(slopes.columns)
        for part in np.array_split(np.flatnonzero(columns.any(axis=1)), workers // math.gcd(n, workers))
        if len(part)
    ]
    columns = [
        np.concatenate([c, np.zeros((len(c), w.start.numel()), np.float32)], axis=1)
        for c, w in zip(slopes.columns, problem.windows)
    ]
    moves = [np.zeros((len(c), w.start.numel()), np.float32) for c, w in zip(slopes.columns, problem.windows)]

    def one(index: int, part: np.ndarray) -> None:
        columns[index][part], moves[index][part] = _along_best_start(
            problem, space, here.raw, index, slopes.columns[index][part], iterations
        )

    budget.each(problem, one, *zip(*parts))
    budget.count(problem, len(here.raw) * iterations * (1 + BACKWARD))
    together = [np.concatenate([r.ravel(), s]) for r, s in zip(here.residuals, start_residuals(problem))]
    return Profile(Jacobian(columns, *products(columns, together)), moves)


def _along_best_start(
    problem: FitProblem, space: ParameterSpace, raw: np.ndarray, index: int, columns: np.ndarray, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """[p, n + f] columns of a window, none of them zero, along its best start, and [p, f] how that moves."""
    parameters = space.physical(torch.as_tensor(raw, dtype=torch.float32))
    start = problem.windows[index].start.clone().requires_grad_()
    run = problem.roll(index, parameters, start=start)
    at = problem.residual(index, run).reshape(-1)
    weight = problem.start_weight(index)
    # hidden faces are nearly free: as scale serves what a seen one weighs
    scale = weight.clamp(min=float(weight.max()) * 0.5)

    def forward(direction: Tensor) -> Tensor:
        size = float(direction.abs().max())
        if size == 0:
            return torch.zeros_like(at)
        step = PROBE * problem.speed / size
        with torch.no_grad():
            there = problem.roll(index, parameters, run.potentials, start=start + step * direction)
            return (problem.residual(index, there).reshape(-1) - at.detach()) / step

    def adjoint(rows: Tensor) -> Tensor:
        # a scalar has its gradient without torch's symbolic shapes, which take half a second to load
        (at * rows).sum().backward(retain_graph=True)
        found, start.grad = start.grad, None
        assert found is not None
        return found

    out, moves = [], []
    for column in columns:
        target = torch.from_numpy(column)
        move, image = torch.zeros_like(weight), torch.zeros_like(at)
        rest = -adjoint(target)
        eased = rest / scale
        direction, power = eased.clone(), float((rest * eased).sum())
        first = power
        for turn in range(iterations):
            if power <= 1e-4 * first or power == 0:
                break
            moved = forward(direction)
            alpha = power / float((weight * direction**2).sum() + (moved**2).sum())
            move, image = move + alpha * direction, image + alpha * moved
            if turn == iterations - 1:
                break  # what is left is not asked for
            rest = rest - alpha * (weight * direction + adjoint(moved))
            eased = rest / scale
            power, before = float((rest * eased).sum()), power
            direction = eased + power / before * direction
        out.append(torch.cat([target + image.detach(), torch.sqrt(weight) * move]).detach().numpy())
        moves.append(move.numpy())
    return np.stack(out), np.stack(moves)
