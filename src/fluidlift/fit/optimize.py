"""Physical parameters from velocities (paper, `optLoss`): stage 2 as one call.

    v_sim^{i+n} = DiffSim^n(v_target^i; v_in, v~_in, v_out, rho, nu, b, d, g, dt)

Windows of frames are rolled out from the target velocity at their start and compared with the targets along them.
Weak priors around the initial values keep what the data cannot determine in place, and the curvature of the loss says
what that is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fluidlift.errors import require
from fluidlift.fit.coarsen import (
    coarse_grid,
    coarsen_cells,
    coarsen_seen,
    coarsen_terrain,
    coarsen_velocity,
)
from fluidlift.fit.evaluation import Budget, Progress, evaluate, single_thread
from fluidlift.fit.identifiability import estimates
from fluidlift.fit.inlet import boundary_prior, fluctuation_error
from fluidlift.fit.minimise import Optimum, first_point, minimise
from fluidlift.fit.problem import FitProblem, build_problem
from fluidlift.fit.ranges import UNITS, ParameterSpace, parameter_space
from fluidlift.fit.scene import FitScene, WindowPlan, build_scene, plan_windows
from fluidlift.fit.settings import DEFAULT_FREE, SCALES, FitOptions
from fluidlift.machine import cores
from fluidlift.numerics.poisson import PoissonSystem
from fluidlift.types import (
    CellType,
    Estimate,
    FaceVelocity,
    FitResult,
    FluidKind,
    FluidParameters,
    Grid,
    Terrain,
    kind_of,
)
from fluidlift.types.kind import STREAM
from fluidlift.types.parameter_table import VECTORS

__all__ = ["DEFAULT_FREE", "FitOptions", "fit_parameters"]

BUOYANCY_SIGMA = 1.0
"""prior width of a plume's buoyancy, in units of its scale estimate"""
PLANNED_ITERATIONS = 7
"""Levenberg-Marquardt iterations that the number of windows leaves work for"""
ERRORS_BEYOND = 0.02
"""standard deviation of a face's error, in units of U, from which the starts of windows are corrected"""
APART = 3.0
"""standard deviations between two ends that count as different"""


@dataclass(frozen=True)
class _Data:
    """What a fit is given, at one resolution."""

    targets: Sequence[FaceVelocity]
    layouts: Sequence[np.ndarray]
    solid: PoissonSystem | Terrain | None
    grid: Grid
    kind: FluidKind
    mainstream: np.ndarray | None
    observed: Sequence[np.ndarray] | None
    firsts: tuple[int, ...] = (0,)

    def scene(self) -> FitScene:
        return build_scene(
            self.targets, self.layouts, self.solid, self.grid, kind=self.kind, mainstream=self.mainstream,
            observed=self.observed, firsts=self.firsts,
        )  # fmt: skip

    def coarser(self) -> _Data:
        """Cells twice as wide."""
        cells = {id(c): coarsen_cells(c) for c in self.layouts}
        targets, views = [coarsen_velocity(t) for t in self.targets], None
        if self.observed is not None:
            targets, views = map(list, zip(*(coarsen_seen(t, o) for t, o in zip(self.targets, self.observed))))
        return replace(
            self,
            targets=targets,
            layouts=[cells[id(c)] for c in self.layouts],
            solid=coarsen_terrain(self.solid) if isinstance(self.solid, Terrain) else None,
            grid=coarse_grid(self.grid),
            observed=views,
        )


def fit_parameters(
    targets: Sequence[FaceVelocity],
    cell_types: Sequence[np.ndarray] | np.ndarray,
    system_or_terrain: PoissonSystem | Terrain | None,
    grid: Grid,
    interval: float,
    initial: FluidParameters,
    *,
    kind: str | FluidKind = STREAM,
    mainstream: np.ndarray | None = None,
    observed: Sequence[np.ndarray] | np.ndarray | None = None,
    firsts: Sequence[int] = (0,),
    restarts: int = 1,
    settings: FitOptions | None = None,
    progress: Progress | None = None,
    **changes: Any,
) -> FitResult:
    """Fit the global parameters of a flow to its estimated velocities; see `FitOptions` for `settings`.

    Args:
        targets: velocities of consecutive frames, m/s; one alone is taken as a steady flow.
        cell_types: u8 [nx,ny,nz], one for all frames or one per target.
        system_or_terrain: terrain, a finished system for one layout, or None (walls by cell type).
        grid: of the targets, which are `interval` (s) apart.
        initial: start and centre of the priors; its time step becomes interval / steps per frame. Values at the inlet
            and the outlet that are zero are first read off the targets.
        kind: of a gas, EMPTY cells are solved too, the box is open, and `gravity` acts on FLUID (smoke) cells
            alone: its size is the buoyancy, m/s^2, also in `extra["buoyancy"]`. All others are liquids.
        mainstream: unit direction of the outflow; default: the terrain's, or the mean velocity.
        observed: bool [nx,ny,nz], one or one per target: cells whose velocity was seen; what the targets hold elsewhere
            does not matter. None: all.
        firsts: targets with which another stretch of consecutive frames begins, of the same fluid at another time; 0
            is the first of them.
        restarts: starts from this many initial scales; the best counts, `FitResult.ends` holds all.
        settings: everything else; `changes` are fields of it, replaced.
        progress: called with (done, total): per cent of the work used.

    Returns:
        see there; a fit that failed has `reason`, and the initial parameters.

    Raises:
        ValueError: arguments that do not fit together.
    """
    options = replace(settings or FitOptions(), **({"restarts": max(restarts, 1)} | changes))
    require(len(targets) >= 1, "no target velocity", "one or more")
    require(np.isfinite(interval) and interval > 0, f"interval {interval}", "positive seconds")
    n = len(targets)
    layouts = _each(cell_types, n, grid, "layouts")
    assert layouts is not None
    require(all(t.shape == grid.shape for t in targets), "targets of another shape than the grid", str(grid.shape))
    views = _each(observed, n, grid, "observed cells")
    data = _Data(targets, layouts, system_or_terrain, grid, kind_of(kind), mainstream, views, tuple(firsts))
    nothing = _no_flow(data)
    if nothing:
        return _failure(initial, nothing)
    budget = _budget(options, progress)
    with single_thread(), budget.counted():
        result = _Fit(data, interval, initial, options, budget).run()
    if data.kind.is_gas:
        return replace(result, extra=result.extra | {"buoyancy": math.hypot(*result.parameters.gravity)})
    return result


def _budget(options: FitOptions, progress: Progress | None) -> Budget:
    workers = options.workers or cores()
    return Budget(time.monotonic() + options.max_seconds, options.max_rollouts, options.max_work, workers, progress)


def _each(values: Any, count: int, grid: Grid, what: str) -> list[np.ndarray] | None:
    """One array per target."""
    if values is None:
        return None
    out = [values] * count if isinstance(values, np.ndarray) else list(values)
    require(len(out) == count, f"{len(out)} {what}, {count} targets", "one, or one per target")
    require(all(v.shape == grid.shape for v in out), f"{what} of another shape than the grid", str(grid.shape))
    return out


def _no_flow(data: _Data) -> str:
    """Why there is nothing to fit; empty where there is."""
    views = data.observed if data.observed is not None else [np.ones(data.grid.shape, bool)] * len(data.targets)
    fluid = [(np.asarray(c) == CellType.FLUID) & v for c, v in zip(data.layouts, views)]
    if not all(f.any() for f in fluid):
        return "no fluid cell was seen"
    moving = sum(float(np.abs(t.at_centers()[f]).sum()) for t, f in zip(data.targets, fluid))
    return "" if moving > 0 or not math.isfinite(moving) else "the targets are at rest"


def _failure(initial: FluidParameters, reason: str) -> FitResult:
    """The initial values, of which nothing was learnt."""
    values, known = initial.to_dict(), {}
    for name, unit in UNITS.items():
        numbers = zip(("_x", "_y", "_z"), values[name]) if name in VECTORS else [("", values[name])]
        known |= {name + end: Estimate(float(v), math.inf, False, float(v), unit) for end, v in numbers}
    return FitResult(
        initial, known, np.zeros(0), False, 0, (f"{reason}: nothing was fitted",), {"loss": math.inf}, reason
    )


@dataclass
class _Fit:
    """One call of `fit_parameters`."""

    data: _Data
    interval: float
    initial: FluidParameters
    options: FitOptions
    budget: Budget

    def __post_init__(self) -> None:
        self.notes: list[str] = []

    def run(self) -> FitResult:
        options = self.options
        while self.data.grid.cells > options.most_cells and not isinstance(self.data.solid, PoissonSystem):
            self.data = self.data.coarser()
            grid, nothing = self.data.grid, _no_flow(self.data)
            if nothing:
                return _failure(self.initial, f"{nothing} on {grid.shape} cells, coarsened by two")
            self.notes.append(f"fitted on {grid.shape} cells of {grid.spacing:.3g} m, coarsened by two")
        scene = self.data.scene()
        plan, space = self.plan(scene)
        problem = self.problem(scene, plan, space)
        at_prior = evaluate(problem, space, space.prior_raw, self.budget)
        if not math.isfinite(at_prior.loss):
            self.notes.append("the rollout breaks down at the start: nothing was fitted")
            failed = _failure(
                space.fluid_parameters(space.prior_raw, np.zeros(len(space.prior_raw), bool)),
                "the rollout breaks down at the start",
            )
            return replace(failed, notes=tuple(self.notes), rollouts=self.budget.rollouts)
        ends = [
            self.one(scene, plan, problem, space, np.array(start))
            for start in self.starts(space)
            if not self.budget.spent or start is None or np.array_equal(start, space.prior_raw)
        ]
        best = min(ends, key=lambda e: (bool(e.reason), e.objective(space)))
        return self.result(scene, problem, space, best, ends, at_prior.loss)

    def plan(self, scene: FitScene) -> tuple[WindowPlan, ParameterSpace]:
        """Windows and variables."""
        prior, sigmas = boundary_prior(scene, self.initial), dict(self.options.prior_sigmas or {})
        if self.data.kind.is_gas:
            prior, sigmas = _buoyancy_prior(prior, scene), {"gravity": BUOYANCY_SIGMA} | sigmas
        plan = plan_windows(
            scene, self.interval, windows=self.options.windows, steps_per_frame=self.options.steps_per_frame,
            frames=self.options.frames_per_window, fall=math.hypot(*prior.gravity),
        )  # fmt: skip
        if plan.steady:
            self.notes.append("one target velocity: the flow is taken as steady")
        prior = replace(prior, time_step=self.interval / plan.steps_per_frame)
        space = parameter_space(
            prior, free=tuple(self.options.free), speed=scene.speed, spacing=scene.grid.spacing, prior_sigmas=sigmas
        )
        return plan, space

    def device(self, scene: FitScene, tell: bool) -> str:
        """Where layouts of this size are rolled out fastest: the device that was asked for, or the CPU."""
        asked, needed = self.options.device, self.options.device_from * self.budget.workers
        if asked == "cpu":
            return asked
        cells = max(int(d.system.unknown.sum()) for d in {id(d): d for d in scene.domains}.values())
        if cells >= needed:
            return asked
        if tell:
            self.notes.append(
                f"rolled out on the CPU: {cells} cells are too few for {asked}, which is faster than "
                f"{self.budget.workers} threads from {needed} on"
            )
        return "cpu"

    def problem(self, scene: FitScene, plan: WindowPlan, space: ParameterSpace, tell: bool = True) -> FitProblem:
        """The windows, fewer where all of them are too much work for a handful of iterations."""
        o = self.options
        device = self.device(scene, tell)
        problem = build_problem(scene, plan, weights=o.weights, options=o.options, compare=o.compare, device=device)
        columns, n = len(space.fitted) + 2, len(problem.windows)
        room = min(o.max_work / (problem.work / n), float(o.max_rollouts))
        affordable = max(int(room / (PLANNED_ITERATIONS * columns)), 1)
        if affordable >= n:
            return problem
        chosen = np.unique(np.linspace(0, n - 1, affordable).round().astype(int))
        if tell:
            self.notes.append(f"{len(chosen)} of {n} windows, to keep within the budget")
        return replace(problem, windows=tuple(problem.windows[i] for i in chosen))

    def starts(self, space: ParameterSpace) -> list[np.ndarray]:
        """The prior, and other scales of viscosity and of the velocities at the ends."""
        out = []
        for viscosity, ends in SCALES[: self.options.restarts]:
            raw = space.prior_raw.copy()
            for i, f in enumerate(space.fitted):
                if f.name == "kinematic_viscosity":
                    raw[i] += math.log(viscosity)
                elif f.name in ("inflow_velocity", "outflow_velocity"):
                    raw[i] *= ends
                elif f.name == "wall_damping":
                    raw[i] += math.log(ends)
            out.append(raw)
        return out

    def one(
        self, scene: FitScene, plan: WindowPlan, problem: FitProblem, space: ParameterSpace, start: np.ndarray
    ) -> Optimum:
        """The minimum from one start, first on wider cells where the layout is large."""
        errors = scene.noise > ERRORS_BEYOND * scene.speed or any(o is not None and not o.all() for o in scene.observed)
        begun = start
        coarse = scene.grid.cells > self.options.coarse_first and not isinstance(self.data.solid, PoissonSystem)
        wide = self.data.coarser() if coarse and not self.budget.spent else None
        if wide is not None and not _no_flow(wide):
            rough = self.problem(wide.scene(), plan, space, tell=False)
            begun = first_point(rough, space, begun, self.budget)
            near = minimise(rough, space, begun, self.budget, replace(self.options, start_rounds=0), errors=False)
            if not near.reason:
                begun = near.raw
        elif not self.budget.spent:
            begun = first_point(problem, space, begun, self.budget)
        return minimise(problem, space, begun, self.budget, self.options, errors=errors)

    def result(
        self, scene: FitScene, problem: FitProblem, space: ParameterSpace, best: Optimum, ends: list[Optimum],
        at_prior: float,
    ) -> FitResult:  # fmt: skip
        """Numbers with their uncertainties, and what is to be said about them."""
        rest = problem.loss_at_rest()
        reason = best.reason
        if not reason and best.loss >= rest:
            reason = (
                f"the simulated flow is no nearer to the targets than a fluid at rest ({best.loss:.3g}, {rest:.3g})"
            )
        if not reason and best.loss > at_prior * (1 + 1e-6):
            reason = f"no values explain the motion better than the initial ones ({best.loss:.3g}, {at_prior:.3g})"
        if not reason and not best.keep.any():
            reason = "the data determine none of the parameters"
        if reason:
            self.notes.append(f"{reason}: nothing was fitted")
            best = replace(best, raw=space.prior_raw, keep=np.zeros(len(best.raw), bool))
        known = estimates(
            space,
            best.raw,
            best.keep,
            best.curvature,
            also=fluctuation_error(scene),
            within=self.options.precise_within,
        )
        self._tell(space, best, known)
        spread = self._ends(space, best, ends, known)
        plan = problem.windows[0].domains
        return FitResult(
            parameters=space.fluid_parameters(best.raw, best.keep),
            estimates=known,
            loss_history=np.asarray(best.history),
            converged=best.converged and not reason,
            rollouts=self.budget.rollouts,
            notes=tuple(self.notes),
            extra={
                "loss": best.loss,
                "loss_at_prior": at_prior,
                "loss_at_rest": rest,
                "observations": best.curvature.observations,
                "windows": float(len(problem.windows)),
                "steps_per_window": float(len(plan)),
                "speed": problem.speed,
                "noise": scene.noise / scene.speed,
                "work": self.budget.work,
                "seconds": time.monotonic() - self.budget.started,
            },
            reason=reason,
            ends=spread,
        )

    def _tell(self, space: ParameterSpace, best: Optimum, known: dict[str, Estimate]) -> None:
        labels = [f.label for f in space.fitted]
        held = [label for label, keep in zip(labels, best.keep) if not keep]
        loose = [label for label, keep in zip(labels, best.keep) if keep and not known[label].identifiable]
        if self.budget.stopped_by_clock:
            self.notes.append("stopped by the clock: not reproducible")
        if not best.converged and not best.reason:
            ended = self.budget.ended_by
            more = f": {ended} ran out, more of it gives a better fit" if ended else ""
            self.notes.append(f"not converged after {self.budget.rollouts} rollouts{more}")
        if not best.solved:
            self.notes.append("some pressure solves did not reach their tolerance")
        if loose:
            self.notes.append("known loosely, fitted value used: " + ", ".join(sorted(loose)))
        if held:
            self.notes.append("not determined by the data, kept at the prior: " + ", ".join(sorted(held)))

    def _ends(
        self, space: ParameterSpace, best: Optimum, ends: list[Optimum], known: dict[str, Estimate]
    ) -> tuple[FluidParameters, ...]:
        if len(ends) < 2:
            return ()
        apart = []
        for i, f in enumerate(space.fitted):
            sigma = known[f.label].sigma
            if best.keep[i] and math.isfinite(sigma):
                slope = f.range.slope(float(best.raw[i]))
                away = max(abs(e.raw[i] - best.raw[i]) for e in ends) * slope
                apart += [f.label] if away > APART * sigma else []
        if apart:
            self.notes.append("restarts end at different values of " + ", ".join(sorted(apart)))
        return tuple(space.fluid_parameters(e.raw, e.keep) for e in ends)


def _buoyancy_prior(prior: FluidParameters, scene: FitScene) -> FluidParameters:
    """Buoyancy of a plume from its speed: smoke that rose through half its height H has v^2 = g' H."""
    height = np.ptp(np.argwhere(scene.cell_types[0] == CellType.FLUID)[:, 2]) + 1  # of the smoke, not of its box
    strength = scene.fast**2 / (height * scene.grid.spacing)
    down = np.asarray(prior.gravity)
    size = float(np.linalg.norm(down))
    down = down / size if size > 0 else np.array([0.0, 0.0, -1.0])
    return replace(prior, gravity=tuple(strength * down))
