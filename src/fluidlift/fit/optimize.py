"""Physical parameters from velocities (paper, `optLoss`): stage 2 as one call.

    v_sim^{i+n} = DiffSim^n(v_target^i; v_in, v~_in, v_out, rho, nu, b, d, g, dt)

Windows of frames are rolled out from the target velocity at their start and compared with the target at their end.
Weak priors around the initial values keep what the data cannot determine in place, and the curvature of the loss says
what that is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numba
import numpy as np
import torch

from fluidlift.errors import require
from fluidlift.fit.coarsen import coarse_grid, coarsen_cells, coarsen_terrain, coarsen_velocity
from fluidlift.fit.identifiability import Curvature, determined, estimates
from fluidlift.fit.loss import LossWeights
from fluidlift.fit.methods import Budget, Minimum, Progress, adam, evaluate, levenberg_marquardt
from fluidlift.fit.problem import FitProblem, FitScene, boundary_prior, build_problem, build_scene, plan_windows
from fluidlift.fit.ranges import ParameterSpace, parameter_space
from fluidlift.numerics.poisson import PoissonSystem
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.types import FaceVelocity, FitResult, FluidParameters, Grid, Terrain

DEFAULT_FREE = (
    "density", "kinematic_viscosity", "gravity", "inflow_velocity", "inflow_fluctuation", "outflow_velocity",
    "restitution", "wall_damping", "time_step",
)  # fmt: skip
"""All of the paper's. The time step has a narrow prior: the interval between frames is known, its division a choice."""
MOST_CELLS = 60_000
"""layouts with more cells are coarsened by two, as often as needed"""
BUOYANCY_SIGMA = 1.0
"""prior width of a plume's buoyancy, in units of its scale estimate"""
PLANNED_ITERATIONS = 7
"""Levenberg-Marquardt iterations that the number of windows leaves time for"""


@contextmanager
def _single_thread() -> Iterator[None]:
    """torch and Numba alternate in short kernels here: their thread pools would wait for each other by spinning."""
    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


def fit_parameters(
    targets: Sequence[FaceVelocity],
    cell_types: Sequence[np.ndarray] | np.ndarray,
    system_or_terrain: PoissonSystem | Terrain | None,
    grid: Grid,
    interval: float,
    initial: FluidParameters,
    *,
    kind: str = "stream",
    mainstream: np.ndarray | None = None,
    windows: int = 3,
    frames_per_window: int | None = None,
    steps_per_frame: int | None = None,
    max_rollouts: int = 600,
    max_seconds: float = 60.0,
    method: str = "lm",
    free: Sequence[str] = DEFAULT_FREE,
    prior_sigmas: dict[str, float] | None = None,
    weights: LossWeights | None = None,
    options: RolloutOptions | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> FitResult:
    """Fit the global parameters of a flow to its estimated velocities.

    Args:
        targets: velocities of consecutive frames, m/s; one alone is taken as a steady flow.
        cell_types: u8 [nx,ny,nz], one for all frames or one per target.
        system_or_terrain: terrain (pressure systems are built per layout), a finished system for one layout, or None
            (walls by cell type).
        grid: of the targets.
        interval: s between frames.
        initial: start and centre of the priors. Inflow velocity, fluctuation and outflow speed that are zero are first
            read off the targets. Its time step is replaced by interval / steps per frame.
        kind: "plume" is a gas: EMPTY cells are solved too, the box is open, and `gravity` acts on FLUID (smoke) cells
            alone and upwards: its size is the buoyancy in m/s^2, also in `extra["buoyancy"]`. All others are liquids.
        mainstream: unit direction of the outflow; default: the terrain's, else the mean velocity.
        windows: most windows; fewer where time is short.
        frames_per_window: n; default from the dynamics (`problem.plan_windows`).
        steps_per_frame: default from the Courant number.
        max_rollouts: rollouts of one window, all told.
        max_seconds: wall clock; the best point so far is returned then. First-time compilation is not counted.
        method: "lm" (Levenberg-Marquardt, finite differences) or "adam" (analytic gradient; the paper's way).
        free: parameters to fit.
        prior_sigmas: raw prior widths instead of `ranges.DEFAULT_PRIOR_SIGMAS`.
        weights: of the loss.
        options: of the rollout.
        device: "cpu".
        progress: called with (done, total): per cent of the budget used.

    Returns:
        parameters, one `Estimate` per number (`gravity_z`, `restitution`, ...), the loss history, and what happened.
        Parameters that the data do not determine have their prior value and `identifiable=False`; their sigma may be
        inf.

    Raises:
        ValueError: arguments that do not fit together.
    """
    require(device == "cpu", f"device '{device}'", "'cpu'")
    require(method in ("lm", "adam"), f"method '{method}'", "'lm' or 'adam'")
    require(len(targets) >= 1, "no target velocity", "one or more")
    require(np.isfinite(interval) and interval > 0, f"interval {interval}", "positive seconds")
    layouts = [cell_types] * len(targets) if isinstance(cell_types, np.ndarray) else list(cell_types)
    require(len(layouts) == len(targets), f"{len(layouts)} layouts, {len(targets)} targets", "one, or one per target")
    require(all(t.shape == grid.shape for t in targets), "targets of another shape than the grid", str(grid.shape))
    require(all(c.shape == grid.shape for c in layouts), "cell types of another shape than the grid", str(grid.shape))
    notes: list[str] = []
    with _single_thread():
        begun = time.monotonic()
        scene = _scene(targets, layouts, system_or_terrain, grid, kind, mainstream, notes)
        prior, sigmas = boundary_prior(scene, initial), dict(prior_sigmas or {})
        if kind == "plume":
            prior, sigmas = _buoyancy_prior(prior, scene), {"gravity": BUOYANCY_SIGMA} | sigmas
        fall = math.hypot(*prior.gravity)
        plan = plan_windows(
            scene, interval, windows=windows, steps_per_frame=steps_per_frame, frames=frames_per_window, fall=fall
        )
        if plan.steady:
            notes.append("one target velocity: the flow is taken as steady")
        prior = replace(prior, time_step=interval / plan.steps_per_frame)
        space = parameter_space(
            prior, free=tuple(free), speed=scene.speed, spacing=scene.grid.spacing, prior_sigmas=sigmas
        )
        problem = build_problem(scene, plan, weights=weights, options=options)
        budget = Budget(begun + max_seconds, max_rollouts, progress=progress)
        problem = _within_budget(problem, space, budget, notes)
        result = _fit(problem, space, budget, method, notes)
    if kind == "plume":
        return replace(result, extra=result.extra | {"buoyancy": math.hypot(*result.parameters.gravity)})
    return result


def _scene(
    targets: Sequence[FaceVelocity],
    layouts: Sequence[np.ndarray],
    solid: PoissonSystem | Terrain | None,
    grid: Grid,
    kind: str,
    mainstream: np.ndarray | None,
    notes: list[str],
) -> FitScene:
    """The scene, coarsened until it is small enough."""
    while grid.cells > MOST_CELLS and not isinstance(solid, PoissonSystem):
        known = {id(c): coarsen_cells(c) for c in layouts}
        targets, layouts = [coarsen_velocity(t) for t in targets], [known[id(c)] for c in layouts]
        solid = coarsen_terrain(solid) if isinstance(solid, Terrain) else None
        grid = coarse_grid(grid)
        notes.append(f"fitted on {grid.shape} cells of {grid.spacing:.3g} m, coarsened by two")
    return build_scene(targets, layouts, solid, grid, kind=kind, mainstream=mainstream)


def _buoyancy_prior(prior: FluidParameters, scene: FitScene) -> FluidParameters:
    """Buoyancy of a plume from its speed: smoke that rose through half its height H has v^2 = g' H."""
    height = np.ptp(np.argwhere(scene.domains[0].system.unknown)[:, 2]) + 1
    strength = scene.fast**2 / (height * scene.grid.spacing)
    down = np.asarray(prior.gravity)
    size = float(np.linalg.norm(down))
    down = down / size if size > 0 else np.array([0.0, 0.0, -1.0])
    return replace(prior, gravity=tuple(strength * down))


def _within_budget(problem: FitProblem, space: ParameterSpace, budget: Budget, notes: list[str]) -> FitProblem:
    """Fewer windows where all of them would take too long for a handful of iterations."""
    one = replace(problem, windows=problem.windows[:1])
    evaluate(one, space, space.prior_raw, budget)
    # the first call compiles; that is paid once per machine and not the fit's
    began = time.monotonic()
    budget.deadline += began - budget.started
    evaluate(one, space, space.prior_raw, budget)
    each = max(time.monotonic() - began, 1e-6)
    columns = len(space.fitted) + 2
    room = min((budget.deadline - began) / each, budget.max_rollouts - budget.rollouts)
    affordable = max(int(room / (PLANNED_ITERATIONS * columns)), 1)
    if affordable >= len(problem.windows):
        return problem
    chosen = np.unique(np.linspace(0, len(problem.windows) - 1, affordable).round().astype(int))
    notes.append(f"{len(chosen)} of {len(problem.windows)} windows, to keep within the budget")
    return replace(problem, windows=tuple(problem.windows[i] for i in chosen))


def _start(problem: FitProblem, space: ParameterSpace, budget: Budget) -> np.ndarray:
    """The prior, with the viscosity of the lowest loss among a few.

    Viscosity spans decades, and below what the grid resolves the loss is flat in it: a start there would never move.
    """
    best = space.prior_raw
    index = [i for i, f in enumerate(space.fitted) if f.name == "kinematic_viscosity"]
    if not index:
        return best
    one = replace(problem, windows=problem.windows[:1])
    lowest = math.inf
    for value in (space.prior_raw[index[0]], *np.log([0.01, 0.1, 1.0])):
        raw = space.prior_raw.copy()
        raw[index[0]] = value
        if budget.spent:
            break
        loss = evaluate(one, space, raw, budget).loss
        # a hundredth better, or the prior stays
        if loss < 0.99 * lowest:
            best, lowest = raw, loss
    return best


def _fit(problem: FitProblem, space: ParameterSpace, budget: Budget, method: str, notes: list[str]) -> FitResult:
    """Minimise, hold what is not determined at its prior, and minimise the rest again."""
    minimise = levenberg_marquardt if method == "lm" else adam
    at_prior = evaluate(problem, space, space.prior_raw, budget).loss
    start = _start(problem, space, budget)
    found = minimise(problem, space, start, budget)
    history, converged = list(found.history), found.converged
    curvature, raw = found.curvature, found.raw.copy()
    if curvature is None:
        broken = "the rollout breaks down at the start" if not math.isfinite(found.loss) else "the budget ended early"
        notes.append(f"{broken}: nothing was fitted")
        raw = space.prior_raw
        curvature = Curvature(np.zeros((len(raw), len(raw))), found.loss, 1.0)
    keep = determined(curvature, space.prior_sigma, raw - space.prior_raw)
    held = {f.label for f, k in zip(space.fitted, keep) if not k}
    smaller, kept, final = space.keep_prior(held), curvature, found.loss
    if keep.any() and held:
        again = levenberg_marquardt(problem, smaller, raw[keep], budget, max_iterations=8)
        raw[keep] = again.raw
        history += again.history[1:]
        converged, final = converged and again.converged, again.loss
        kept = _widened(again, keep) or curvature
    if not converged:
        notes.append(f"not converged after {budget.rollouts} rollouts")
    if not found.solved:
        notes.append("some pressure solves did not reach their tolerance")
    if held:
        notes.append("not determined by the data, kept at the prior: " + ", ".join(sorted(held)))
    return FitResult(
        parameters=smaller.fluid_parameters(raw[keep]),
        estimates=estimates(space, raw, keep, everything=curvature, kept=kept),
        loss_history=np.asarray(history),
        converged=converged,
        rollouts=budget.rollouts,
        notes=tuple(notes),
        extra={
            "loss": final,
            "loss_at_prior": at_prior,
            "loss_at_rest": problem.loss_at_rest(),
            "observations": kept.observations,
            "windows": float(len(problem.windows)),
            "steps_per_window": float(len(problem.windows[0].domains)),
            "speed": problem.speed,
            "seconds": time.monotonic() - budget.started,
        },
    )


def _widened(minimum: Minimum, keep: np.ndarray) -> Curvature | None:
    """The curvature of some parameters in the matrix of all."""
    if minimum.curvature is None:
        return None
    normal = np.zeros((keep.size, keep.size))
    normal[np.ix_(keep, keep)] = minimum.curvature.normal
    return Curvature(normal, minimum.curvature.loss, minimum.curvature.observations)
