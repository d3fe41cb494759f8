"""Two ways to the minimum: Levenberg-Marquardt (default) and Adam on the analytic gradient (paper, reference)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from fluidlift.fit.evaluation import BACKWARD, Budget, Jacobian, Residuals, chunks, evaluate, jacobian
from fluidlift.fit.identifiability import Curvature, noise_level
from fluidlift.fit.problem import FitProblem
from fluidlift.fit.ranges import ParameterSpace

EXPLORING_ITERATIONS = 6
EXPLORING_OBSERVATIONS = 300.0
"""leaving the prior by three of its widths costs as much as a change that explains 3 % of the loss gains"""
RESCALED_ADAM = (10, 20, 30, 45)


@dataclass(frozen=True)
class Minimum:
    """Where a method ended."""

    raw: Float[np.ndarray, " p"]
    history: list[float]
    converged: bool
    curvature: Curvature | None
    """None where the budget ended before the first Jacobian"""
    loss: float
    solved: bool
    scale: float = 0.0
    """weight of the loss against the prior at the end"""
    jacobian: Jacobian | None = None
    """the last one"""
    at: Residuals | None = None
    """residuals at `raw`"""


@dataclass(frozen=True)
class _Objective:
    """scale / 2 sum r^2 + prior / 2: a negative log probability."""

    space: ParameterSpace
    scale: float

    def value(self, there: Residuals) -> float:
        away = (there.raw - self.space.prior_raw) / self.space.prior_sigma
        return 0.5 * self.scale * there.loss + 0.5 * float(np.square(away).sum())

    def step(self, slopes: Jacobian, at: np.ndarray, damping: float) -> tuple[np.ndarray, float]:
        """The damped Gauss-Newton step, of two prior widths at most, and the gain it predicts."""
        width = self.space.prior_sigma
        hessian = self.scale * slopes.normal + np.diag(1 / width**2)
        gradient = self.scale * slopes.slope + (at - self.space.prior_raw) / width**2
        step = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
        step *= min(1.0, 2.0 / max(float(np.abs(step / width).max()), 1e-12))
        return step, -float(step @ gradient + 0.5 * step @ hessian @ step)


@dataclass
class _Search:
    """The state of Levenberg-Marquardt."""

    here: Residuals
    damping: float = 1e-2
    slopes: Jacobian | None = None
    fresh: bool = False
    """`slopes` are differences at `here`, and not carried on from the point before"""
    small: bool = False
    """the last step gained little or was short"""

    def advance(self, problem: FitProblem, objective: _Objective, budget: Budget, *, enough: float) -> bool:
        """One step to a better point; False where damping finds none."""
        width, before = objective.space.prior_sigma, objective.value(self.here)
        assert self.slopes is not None
        while self.damping < 1e6 and not budget.spent:
            step, predicted = objective.step(self.slopes, self.here.raw, self.damping)
            there = evaluate(problem, objective.space, self.here.raw + step, budget, self.here.guesses)
            gain = before - objective.value(there)
            short = float(np.abs(step / width).max()) < 0.01
            if gain > 0:
                self.small = short or gain < enough
                self.damping = max(self.damping / 10, 1e-7)
                # a model that foretold the gain is good for one more step
                trusted = self.fresh and gain > 0.5 * predicted and not self.small
                self.slopes = carried_on(self.slopes, step, self.here, there) if trusted else None
                self.fresh, self.here = False, there
                return True
            if not self.fresh:
                # the model may be at fault, not the length
                self.slopes = None
                return True
            if short:
                break
            self.damping *= 8
        self.small = self.small or not budget.spent
        return False


def carried_on(slopes: Jacobian, step: np.ndarray, before: Residuals, after: Residuals) -> Jacobian:
    """The products of the Jacobian changed least so that it explains the last step (Broyden 1965).

    J' = J + m u^T, with m = r1 - r0 - J s what it missed and u = s / |s|^2. J' itself is not made.
    """
    along, square = step / float(step @ step), 0.0
    missed_by, slope, last = np.zeros(len(step)), np.zeros(len(step)), 0.0
    for c, r0, r1 in zip(slopes.columns, before.residuals, after.residuals):
        for part in chunks(r0.size):
            wide, now = c[:, part].astype(float), r1.ravel()[part].astype(float)
            missed = now - r0.ravel()[part] - (step[:, None] * wide).sum(axis=0)
            missed_by += (wide * missed).sum(axis=1)
            slope += (wide * now).sum(axis=1)
            square += float(np.square(missed).sum())
            last += float((missed * now).sum())
    tied = np.outer(along, missed_by)
    return Jacobian([], slopes.normal + tied + tied.T + square * np.outer(along, along), slope + last * along)


def levenberg_marquardt(
    problem: FitProblem,
    space: ParameterSpace,
    start: Float[np.ndarray, " p"],
    budget: Budget,
    *,
    max_iterations: int = 20,
    explore: bool = True,
) -> Minimum:
    """Minimise N / (2 L) sum r^2 + prior / 2.

    Two phases. Far from the minimum the residual is signal, not noise; taken for noise (large, smooth, so few
    observations) it would excuse the prior for ever. So first N is `EXPLORING_OBSERVATIONS`, with L that of the current
    point, for a few iterations or until steps get small. Then N and L are estimated from the residual found there and
    stay fixed: an objective that is re-estimated all the time can be lowered for ever by going back and forth.

    Every other Jacobian is carried on by Broyden's update where the step went as foretold. A phase ends where a step
    moves no variable by more than a hundredth of its prior width, or gains less than 0.01 (exploring: 0.5) in the
    objective, a log probability, or where damping finds no better point.

    Args:
        explore: False begins with the second phase.
    """
    search = _Search(evaluate(problem, space, start, budget))
    history, converged, scale = [search.here.loss], False, 0.0
    if not np.isfinite(search.here.loss):
        return Minimum(search.here.raw, history, False, None, search.here.loss, search.here.solved(problem))
    exploring = explore
    if not explore:
        scale = precision(problem, search.here)
    last: Jacobian | None = None
    for iteration in range(max_iterations):
        if search.slopes is None:
            search.slopes, search.fresh = jacobian(problem, space, search.here, budget, last), True
            if search.slopes is None:
                break
            last = search.slopes
        if exploring and (converged or iteration >= EXPLORING_ITERATIONS):
            exploring, converged, search.damping = False, False, min(search.damping, 1e-2)
            scale = precision(problem, search.here)
        elif exploring:
            scale = EXPLORING_OBSERVATIONS / noise_level(search.here.loss)
        objective, before = _Objective(space, scale), search.here
        found = search.advance(problem, objective, budget, enough=0.5 if exploring else 0.01)
        if search.here is not before:
            history.append(search.here.loss)
        budget.tell()
        converged = search.small
        search.small = False
        if (converged and not exploring) or (not found and not converged):
            break
    here = search.here
    curvature = None if last is None else Curvature(last.normal, here.loss, here.observations(problem))
    return Minimum(
        here.raw, history, converged and not exploring, curvature, here.loss, here.solved(problem), scale, last, here
    )


def precision(problem: FitProblem, here: Residuals) -> float:
    """N / L: turns the loss into twice a negative log likelihood."""
    return here.observations(problem) / noise_level(here.loss)


def adam(
    problem: FitProblem,
    space: ParameterSpace,
    start: Float[np.ndarray, " p"],
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
        budget.count(problem, 1 + BACKWARD)
        # the windows' gradients are in z.grad; the prior's is added in closed form, in units of the loss
        with torch.no_grad():
            value = data + float((z**2).sum()) / scale
            assert z.grad is not None
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
    slopes = jacobian(problem, space, here, budget)
    curvature = None if slopes is None else Curvature(slopes.normal, here.loss, here.observations(problem))
    return Minimum(
        best, history or [first.loss], converged, curvature, here.loss, here.solved(problem), scale, slopes, here
    )
