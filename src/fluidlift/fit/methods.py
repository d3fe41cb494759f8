"""Two ways to the minimum: Levenberg-Marquardt (default) and Adam on the analytic gradient (paper, reference)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from fluidlift.fit.identifiability import Curvature, effective_observations, noise_level
from fluidlift.fit.problem import FitProblem
from fluidlift.fit.ranges import ParameterSpace

Progress = Callable[[int, int], None]
"""called with (done, total)"""
DIFFERENCE = 0.02
"""raw step of the forward differences: a few per cent, far above the 1e-5 that pressure solves leave"""
EXPLORING_ITERATIONS = 6
EXPLORING_OBSERVATIONS = 300.0
"""leaving the prior by three of its widths costs as much as a change that explains 3 % of the loss gains"""
RESCALED_ADAM = (10, 20, 30, 45)


@dataclass
class Budget:
    """What may be spent; counts as it goes."""

    deadline: float
    """of `time.monotonic`"""
    max_rollouts: int
    rollouts: int = 0
    progress: Progress | None = None
    started: float = field(default_factory=time.monotonic)

    @property
    def spent(self) -> bool:
        """Nothing is left."""
        return time.monotonic() >= self.deadline or self.rollouts >= self.max_rollouts

    def tell(self) -> None:
        """Report the share of the budget that is used."""
        if self.progress is not None:
            whole = max(self.deadline - self.started, 1e-9)
            used = max((time.monotonic() - self.started) / whole, self.rollouts / self.max_rollouts)
            self.progress(round(100 * min(used, 1.0)), 100)


@dataclass(frozen=True)
class Evaluation:
    """Residuals of all windows at one point."""

    raw: Float[np.ndarray, "p"]
    residuals: list[np.ndarray]
    guesses: list[tuple[np.ndarray, ...]]
    solved: bool
    """all pressure solves converged"""

    @property
    def loss(self) -> float:
        """Sum of squares; inf where the rollout blew up."""
        total = float(sum(np.vdot(r, r) for r in self.residuals))
        return total if np.isfinite(total) else float("inf")

    def observations(self, problem: FitProblem) -> float:
        """Effective number of observations, from the magnitude terms."""
        return effective_observations(
            [r[..., 3:] for r in self.residuals], [w.mask.double().numpy() for w in problem.windows]
        )


@dataclass(frozen=True)
class Minimum:
    """Where a method ended."""

    raw: Float[np.ndarray, "p"]
    history: list[float]
    converged: bool
    curvature: Curvature | None
    """None where the budget ended before the first Jacobian"""
    loss: float
    solved: bool


def evaluate(
    problem: FitProblem,
    space: ParameterSpace,
    raw: Float[np.ndarray, "p"],
    budget: Budget,
    guesses: Sequence[Sequence[np.ndarray]] | None = None,
) -> Evaluation:
    """Roll all windows out."""
    found, potentials, solved = [], [], True
    with torch.no_grad():
        parameters = space.physical(torch.as_tensor(raw, dtype=torch.float32))
        for i in range(len(problem.windows)):
            result = problem.roll(i, parameters, guesses[i] if guesses is not None else None)
            found.append(problem.residual(i, result))
            potentials.append(result.potentials)
            solved &= all(r.converged for r in result.reports) or problem.options.projection == "jacobi"
            budget.rollouts += 1
    return Evaluation(np.array(raw, float), found, potentials, solved)


def jacobian_products(
    problem: FitProblem, space: ParameterSpace, base: Evaluation, budget: Budget
) -> tuple[np.ndarray, np.ndarray] | None:
    """J^T J and J^T r by forward differences; None where the budget ends first.

    A dozen global parameters against many thousand residuals: one rollout per parameter, started from the pressures
    of the base rollout, costs less than one adjoint per residual or than carrying tangents.
    """
    r = np.concatenate([x.ravel() for x in base.residuals])
    columns = np.zeros((len(base.raw), r.size))
    for p in range(len(base.raw)):
        if budget.spent:
            return None
        # towards the prior, where the rollout is least likely to break down
        h = DIFFERENCE if base.raw[p] <= space.prior_raw[p] else -DIFFERENCE
        moved = base.raw.copy()
        moved[p] += h
        other = evaluate(problem, space, moved, budget, base.guesses)
        if not np.isfinite(other.loss):
            continue  # no derivative to be had here: the variable stays
        columns[p] = (np.concatenate([x.ravel() for x in other.residuals]) - r) / h
    return columns @ columns.T, columns @ r


def levenberg_marquardt(
    problem: FitProblem,
    space: ParameterSpace,
    start: Float[np.ndarray, "p"],
    budget: Budget,
    *,
    max_iterations: int = 20,
    longest: float = 2.0,
) -> Minimum:
    """Minimise N / (2 L) sum r^2 + prior / 2.

    Two phases. Far from the minimum the residual is signal, not noise; taken for noise (large, smooth, so few
    observations) it would excuse the prior for ever. So first N is `EXPLORING_OBSERVATIONS`, with L that of the current
    point, for a few iterations or until steps get small. Then N and L are estimated from the residual found there and
    stay fixed: an objective that is re-estimated all the time can be lowered for ever by going back and forth.

    A phase ends where a step moves no variable by more than a hundredth of its prior width, or gains less than 0.01
    (exploring: 0.5) in the objective, a log probability, or where damping finds no better point.

    Args:
        longest: longest step, in prior widths.
    """
    prior, width = space.prior_raw, space.prior_sigma
    here = evaluate(problem, space, start, budget)
    history, converged, curvature = [here.loss], False, None
    if not np.isfinite(here.loss):
        return Minimum(here.raw, history, False, None, here.loss, here.solved)
    damping, scale, exploring = 1e-2, 0.0, True
    for iteration in range(max_iterations):
        products = jacobian_products(problem, space, here, budget)
        if products is None:
            break
        normal, slope = products
        curvature = Curvature(normal, here.loss, here.observations(problem))
        if exploring and (converged or iteration >= EXPLORING_ITERATIONS):
            exploring, converged, damping = False, False, min(damping, 1e-2)
            scale = curvature.precision_per_loss
        elif exploring:
            scale = EXPLORING_OBSERVATIONS / noise_level(here.loss)
        hessian = scale * normal + np.diag(1 / width**2)
        gradient = scale * slope + (here.raw - prior) / width**2
        objective = 0.5 * scale * here.loss + 0.5 * float((((here.raw - prior) / width) ** 2).sum())
        better = None
        while damping < 1e6 and not budget.spent:
            step = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
            step *= min(1.0, longest / max(float(np.abs(step / width).max()), 1e-12))
            there = evaluate(problem, space, here.raw + step, budget, here.guesses)
            value = 0.5 * scale * there.loss + 0.5 * float((((there.raw - prior) / width) ** 2).sum())
            gain = objective - value
            small = float(np.abs(step / width).max()) < 0.01
            if gain > 0:
                better = there
                damping = max(damping / 10, 1e-7)
                converged = small or gain < (0.5 if exploring else 0.01)
                break
            if small:
                converged = True
                break
            damping *= 8
        if better is None:
            converged = converged or damping >= 1e6
            if not converged:
                break
        else:
            here = better
            history.append(here.loss)
        budget.tell()
        if converged and not exploring:
            break
    converged = converged and not exploring
    if curvature is not None:
        curvature = Curvature(curvature.normal, here.loss, here.observations(problem))
    return Minimum(here.raw, history, converged, curvature, here.loss, here.solved)


def adam(
    problem: FitProblem,
    space: ParameterSpace,
    start: Float[np.ndarray, "p"],
    budget: Budget,
    *,
    max_iterations: int = 100,
    rate: float = 0.05,
) -> Minimum:
    """Adam on the analytic gradient of loss plus prior, all windows per iteration (paper); the reference method.

    Steps are `rate` prior widths at first and fall to a tenth of it. Stops where the best objective of the last 15
    iterations improves on that before by less than a thousandth.
    """
    prior = torch.as_tensor(space.prior_raw, dtype=torch.float32)
    width = torch.as_tensor(space.prior_sigma, dtype=torch.float32)
    # in prior widths, so that one rate fits all variables
    z = ((torch.as_tensor(start, dtype=torch.float32) - prior) / width).requires_grad_()
    optimizer = torch.optim.Adam([z], lr=rate)
    first = evaluate(problem, space, start, budget)
    observations = first.observations(problem)
    scale = observations / noise_level(first.loss)
    history, values = [], []
    best, best_value, converged = np.array(start, float), float("inf"), False
    for iteration in range(max_iterations):
        if budget.spent:
            break
        if history and iteration in RESCALED_ADAM:
            # as the loss falls so does the noise, and the prior weighs less; best values of before no longer compare
            scale, best_value, values = observations / noise_level(history[-1]), float("inf"), []
        optimizer.param_groups[0]["lr"] = rate * (1 - 0.9 * iteration / max_iterations)
        optimizer.zero_grad()
        data = 0.0
        for i in range(len(problem.windows)):
            loss = problem.loss(i, problem.roll(i, space.physical(prior + width * z)))
            loss.backward()
            data += float(loss.detach())
            budget.rollouts += 1
        # the windows' gradients are in z.grad; the prior's is added in closed form, in units of the loss
        with torch.no_grad():
            value = data + float((z**2).sum()) / scale
            z.grad += 2 * z / scale
            if value < best_value:
                best, best_value = (prior + width * z).double().numpy().copy(), value
        history.append(data)
        values.append(value)
        if not np.isfinite(value):
            break
        optimizer.step()
        budget.tell()
        if len(values) > 30 and min(values[-15:]) > min(values[:-15]) * (1 - 1e-3):
            converged = True
            break
    here = evaluate(problem, space, best, budget)
    products = jacobian_products(problem, space, here, budget)
    curvature = None if products is None else Curvature(products[0], here.loss, here.observations(problem))
    return Minimum(best, history or [first.loss], converged, curvature, here.loss, here.solved)
