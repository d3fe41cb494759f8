"""From a problem to its minimum: parameters, starts of windows, and what the data know of each."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from fluidlift.fit.evaluation import Budget, Jacobian, Residuals, evaluate, jacobian, losses, products
from fluidlift.fit.identifiability import BLOCK, Curvature, block_scatter, determined
from fluidlift.fit.methods import adam, levenberg_marquardt, precision
from fluidlift.fit.problem import FitProblem
from fluidlift.fit.ranges import ParameterSpace
from fluidlift.fit.settings import FitOptions
from fluidlift.fit.starts import Profile, corrected_starts, profile, start_residuals

PROFILE_ITERATIONS = 3
"""conjugate gradients per parameter: the rest changes a standard deviation by some per cent"""
FIRST_CORRECTION, LATER_CORRECTION = 12, 6
"""L-BFGS steps of the starts"""
SECOND_ORDER = 1.25
"""widening of standard deviations where starts have errors: those act on derivatives too, which the linear theory
leaves out, and the conjugate gradients are cut short"""
VISCOSITIES = (0.01, 0.1, 1.0)
"""first guesses beside the given one, in units of U h: below what a grid resolves the loss is flat"""


@dataclass(frozen=True)
class Optimum:
    """Where a fit ended."""

    raw: Float[np.ndarray, " p"]
    keep: Bool[np.ndarray, " p"]
    """which variables the data determine; the others are at their prior"""
    curvature: Curvature
    loss: float
    history: tuple[float, ...]
    converged: bool
    solved: bool
    reason: str = ""
    """why nothing was found; empty where something was"""

    def objective(self, space: ParameterSpace) -> float:
        """A negative log probability, to compare ends of one problem: the loss, the prior where losses are equal."""
        away = (self.raw - space.prior_raw) / space.prior_sigma
        return 0.5 * self.curvature.precision_per_loss * self.loss + 0.5 * float(np.square(away).sum())


def first_point(
    problem: FitProblem, space: ParameterSpace, raw: Float[np.ndarray, " p"], budget: Budget
) -> Float[np.ndarray, " p"]:
    """The point, with the viscosity of the lowest loss among a few."""
    index = [i for i, f in enumerate(space.fitted) if f.name == "kinematic_viscosity"]
    if not index or budget.spent:
        return raw
    points = [raw] + [np.where(np.arange(len(raw)) == index[0], math.log(v), raw) for v in VISCOSITIES]
    one = replace(problem, windows=problem.windows[:1])
    best, lowest = raw, math.inf
    for point, loss in zip(points, losses(one, space, points, budget)):
        # a hundredth better, or the given one stays
        if loss < 0.99 * lowest:
            best, lowest = point, loss
    return best


def minimise(
    problem: FitProblem, space: ParameterSpace, start: Float[np.ndarray, " p"], budget: Budget, options: FitOptions,
    *, errors: bool,
) -> Optimum:  # fmt: skip
    """Minimise, correct the starts, hold what is not determined at its prior, and minimise the rest again.

    Args:
        problem: all windows.
        space: of the parameters.
        start: first point.
        budget: what may be spent.
        options: of the fit.
        errors: the targets have errors or hidden cells, so starts are corrected.
    """
    if options.method == "adam":
        found = adam(problem, space, start, budget)
    else:
        found = levenberg_marquardt(problem, space, start, budget)
    none = np.zeros(len(start), bool)
    if found.curvature is None or found.jacobian is None or found.at is None:
        broken = not math.isfinite(found.loss)
        reason = "the rollout breaks down at the start" if broken else "the budget ended early"
        curvature = Curvature(np.zeros((len(start), len(start))), found.loss, 1.0)
        return Optimum(space.prior_raw, none, curvature, found.loss, tuple(found.history), False, found.solved, reason)
    raw, converged, history = found.raw, found.converged, list(found.history)
    slopes, here, moves = found.jacobian, found.at, None
    rounds = options.start_rounds if errors else 0
    for i in range(rounds):
        if budget.spent:
            converged = False
            break
        steps = FIRST_CORRECTION if i == 0 else LATER_CORRECTION
        problem = corrected_starts(problem, space, raw, budget, iterations=steps)
        here = evaluate(problem, space, raw, budget)
        if moves is None:
            slopes = jacobian(problem, space, here, budget, slopes) or slopes
            along = profile(problem, space, here, slopes, budget, iterations=PROFILE_ITERATIONS)
            slopes, moves = along.slopes, along.moves
        problem, raw, here = _stepped(problem, space, here, Profile(slopes, moves), budget, np.ones(len(raw), bool))
        history.append(here.loss)
        budget.tell()
    curvature = curvature_of(problem, here, slopes, with_starts=moves is not None)
    keep = determined(curvature, space.prior_sigma, raw - space.prior_raw)
    if keep.any() and not keep.all():
        problem, raw, here, done = _again(problem, space, raw, keep, budget, slopes, moves, here)
        converged = converged and done
        history.append(here.loss)
        curvature = curvature_of(problem, here, slopes, with_starts=moves is not None)
    raw = np.where(keep, raw, space.prior_raw)
    return Optimum(raw, keep, curvature, here.loss, tuple(history), converged, here.solved(problem))


def _again(
    problem: FitProblem, space: ParameterSpace, raw: np.ndarray, keep: np.ndarray, budget: Budget, slopes: Jacobian,
    moves: list[np.ndarray] | None, here: Residuals,
) -> tuple[FitProblem, np.ndarray, Residuals, bool]:  # fmt: skip
    """The minimum of the kept variables, the others at their prior."""
    if moves is not None:
        problem, raw, here = _stepped(problem, space, here, Profile(slopes, moves), budget, keep)
        return problem, raw, here, True
    held = {f.label for f, k in zip(space.fitted, keep) if not k}
    smaller = space.keep_prior(held)
    found = levenberg_marquardt(problem, smaller, raw[keep], budget, max_iterations=8, explore=False)
    raw = space.prior_raw.copy()
    raw[keep] = found.raw
    return problem, raw, evaluate(problem, space, raw, budget), found.converged


def _stepped(
    problem: FitProblem, space: ParameterSpace, here: Residuals, along: Profile, budget: Budget, keep: np.ndarray
) -> tuple[FitProblem, np.ndarray, Residuals]:
    """One Gauss-Newton step of parameters and starts together, shortened until it is downhill.

    Variables that are not kept go to their prior, and the others make up for it as far as they can.
    """
    prior, width = space.prior_raw, space.prior_sigma
    scale = precision(problem, here)
    _, slope = products(along.slopes.columns, _together(problem, here))
    step = np.where(keep, 0.0, prior - here.raw)
    slope = slope + along.slopes.normal @ step
    part = np.ix_(keep, keep)
    hessian = scale * along.slopes.normal[part] + np.diag(1 / width[keep] ** 2)
    step[keep] = -np.linalg.solve(hessian, scale * slope[keep] + ((here.raw - prior) / width**2)[keep])
    before = _value(problem, space, here, scale)
    for _ in range(4):
        moved = problem.with_starts(
            [w.start + torch.from_numpy((step @ m).astype(np.float32)) for w, m in zip(problem.windows, along.moves)]
        )
        there = evaluate(moved, space, here.raw + step, budget, here.guesses)
        if not keep.all() or _value(moved, space, there, scale) <= before:
            return moved, there.raw, there
        step = 0.5 * step
    return problem, here.raw, here


def _together(problem: FitProblem, here: Residuals) -> list[np.ndarray]:
    return [np.concatenate([r.ravel(), s]) for r, s in zip(here.residuals, start_residuals(problem))]


def _value(problem: FitProblem, space: ParameterSpace, here: Residuals, scale: float) -> float:
    away = (here.raw - space.prior_raw) / space.prior_sigma
    departed = sum(float(np.square(s).sum()) for s in start_residuals(problem))
    return 0.5 * scale * (here.loss + departed) + 0.5 * float(np.square(away).sum())


def curvature_of(problem: FitProblem, here: Residuals, slopes: Jacobian, *, with_starts: bool) -> Curvature:
    """The quadratic model of the loss, and the scatter of its gradient over blocks of cells."""
    p, parts = len(here.raw), []
    edge = _edge(problem, p)
    rests = _together(problem, here) if with_starts else [r.ravel() for r in here.residuals]
    for window, columns, rest in zip(problem.windows, slopes.columns, rests):
        shape = window.domains[0].shape
        rows = np.repeat(torch.cat(list(window.cells)).numpy(), 6)
        blocks = [_block_of(np.stack(np.unravel_index(rows, shape)), shape, edge)]
        if with_starts:
            for faces in window.domains[0].face_shapes:
                blocks.append(_block_of(np.stack(np.unravel_index(np.arange(math.prod(faces)), faces)), shape, edge))
        parts.append((columns, rest, np.concatenate(blocks)))
    scatter = block_scatter(parts, p) * (SECOND_ORDER**2 if with_starts else 1.0)
    return Curvature(slopes.normal, here.loss, here.observations(problem), scatter)


def _block_of(index: np.ndarray, shape: tuple[int, int, int], edge: int) -> np.ndarray:
    counts = [(n + edge - 1) // edge for n in shape]
    # a face on the far side of the box belongs to the last cell
    i, j, k = (np.minimum(x // edge, n - 1) for x, n in zip(index, counts))
    return (i * counts[1] + j) * counts[2] + k


def _edge(problem: FitProblem, parameters: int) -> int:
    """Cells along a block: `BLOCK`, or fewer where there would be too few blocks to tell their scatter."""
    window = problem.windows[0]
    shape, cells = window.domains[0].shape, torch.cat(list(window.cells)).numpy()
    for edge in range(BLOCK, 2, -1):
        if len(np.unique(_block_of(np.stack(np.unravel_index(cells, shape)), shape, edge))) >= 4 * parameters:
            return edge
    return 2
