"""Rolling all windows out: residuals, their derivatives by parameter, and what that costs.

A rollout runs on one thread; rollouts run side by side. So results are the same bits for any number of workers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float
from numba.core.event import TimingListener, install_listener

from fluidlift.fit.identifiability import effective_observations
from fluidlift.fit.problem import FitProblem
from fluidlift.fit.ranges import ParameterSpace
from fluidlift.types import SolveReport

Progress = Callable[[int, int], None]
"""called with (done, total)"""
DIFFERENCE = 0.02
"""raw step of the forward differences: a few per cent, far above the 1e-5 that pressure solves leave"""
UNSEEN = ("density",)
"""parameters that no velocity shows: it scales the pressure of a single fluid and drops out of its motion"""
CHUNK = 1 << 16
"""residuals that are widened to double precision at a time"""
BACKWARD = 2.0
"""cost of a gradient beyond that of its rollout"""


def _one_thread() -> None:
    torch.set_num_threads(1)
    numba.set_num_threads(1)


@contextmanager
def single_thread() -> Iterator[None]:
    """torch and Numba alternate in short kernels here: their thread pools would wait for each other by spinning."""
    before = torch.get_num_threads(), numba.get_num_threads()
    _one_thread()
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


@dataclass
class Budget:
    """What may be spent; counts as it goes. Rollouts and work end a fit at the same point on every machine."""

    deadline: float = float("inf")
    """of `time.monotonic`, later by what `counted` saw compiled: the last resort, since where it strikes depends on the
    machine"""
    max_rollouts: int = 1_000_000
    """rollouts of one window"""
    max_work: float = float("inf")
    """cells times steps; a gradient counts as three rollouts"""
    workers: int = 1
    progress: Progress | None = None
    rollouts: int = 0
    work: float = 0.0
    stopped_by_clock: bool = False
    started: float = field(default_factory=time.monotonic)
    compilation: TimingListener = field(default_factory=TimingListener)

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Its clock stands while the block compiles kernels: the first fit of a machine ends where later ones do."""
        with install_listener("numba:compile", self.compilation):
            yield

    @property
    def ended_by(self) -> str:
        """What ran out, and the option that gives more of it; empty where something is left."""
        if self.work >= self.max_work:
            return "the work (fit.max_work)"
        if self.rollouts >= self.max_rollouts:
            return "the number of rollouts (max_rollouts)"
        return "the clock (fit.max_seconds)" if self.stopped_by_clock else ""

    @property
    def spent(self) -> bool:
        """Nothing is left."""
        if self.rollouts >= self.max_rollouts or self.work >= self.max_work:
            return True
        compiled = self.compilation.duration if self.compilation.done else 0.0
        self.stopped_by_clock |= time.monotonic() >= self.deadline + compiled
        return self.stopped_by_clock

    def count(self, problem: FitProblem, times: float = 1.0) -> None:
        """Rollouts of all windows that were made."""
        self.rollouts += round(times * len(problem.windows))
        self.work += times * problem.work

    def tell(self) -> None:
        """Report the share of the budget that is used."""
        if self.progress is not None:
            used = max(self.rollouts / self.max_rollouts, self.work / self.max_work)
            self.progress(round(100 * min(used, 1.0)), 100)

    def each(self, problem: FitProblem, task: Callable[..., Any], *arguments: Sequence[Any]) -> list[Any]:
        """The task for each set of arguments, side by side where the problem is rolled out on the CPU (a device is busy
        with one rollout), results in order."""
        if self.workers <= 1 or problem.placed:
            return [task(*a) for a in zip(*arguments)]
        with ThreadPoolExecutor(self.workers, initializer=_one_thread) as pool:
            return list(pool.map(task, *arguments))


@dataclass(frozen=True)
class Residuals:
    """Residuals of all windows at one point."""

    raw: Float[np.ndarray, " p"]
    residuals: list[Float[np.ndarray, "m 6"]]
    """per window, as the rollout gives them (single precision)"""
    guesses: list[tuple[np.ndarray, ...]]
    """potentials per window; empty where they were not kept"""
    reports: tuple[SolveReport, ...]

    @property
    def loss(self) -> float:
        """Sum of squares; inf where the rollout blew up."""
        total = float(sum(np.square(r, dtype=float).sum() for r in self.residuals))
        return total if np.isfinite(total) else float("inf")

    def solved(self, problem: FitProblem) -> bool:
        """All pressure solves that have a tolerance reached it."""
        return problem.options.fixed_work or all(r.converged for r in self.reports)

    def observations(self, problem: FitProblem) -> float:
        """Effective number of observations, from the magnitude terms."""
        fields, masks = [], []
        for window, found in zip(problem.windows, self.residuals):
            shape, row = window.domains[0].shape, 0
            for cells, weights in zip(window.cells, window.masks):
                at, n = cells.numpy(), len(cells)
                count = int(np.prod(shape))
                dense, mask = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
                dense[at], mask[at] = found[row : row + n, 3:], weights.numpy()
                fields.append(dense.reshape(*shape, 3))
                masks.append(mask.reshape(shape))
                row += n
        return effective_observations(fields, masks)


@dataclass(frozen=True)
class Jacobian:
    """d residuals / d raw, and the products that a step needs."""

    columns: list[Float[np.ndarray, "p n"]]
    """float32, per window; n residuals in the order of `Residuals.residuals`, flattened. Most of a fit's memory: empty
    where only the products are known"""
    normal: Float[np.ndarray, "p p"]
    """J^T J"""
    slope: Float[np.ndarray, " p"]
    """J^T r"""


def evaluate(
    problem: FitProblem,
    space: ParameterSpace,
    raw: Float[np.ndarray, " p"],
    budget: Budget,
    guesses: Sequence[Sequence[np.ndarray]] | None = None,
) -> Residuals:
    """Roll all windows out."""
    rows = budget.each(problem, lambda w: _rolled(problem, space, raw, w, guesses), list(range(len(problem.windows))))
    budget.count(problem)
    found, potentials, reports = zip(*rows)
    return Residuals(np.array(raw, float), list(found), list(potentials), sum(reports, ()))


def losses(
    problem: FitProblem, space: ParameterSpace, points: Sequence[Float[np.ndarray, " p"]], budget: Budget
) -> list[float]:
    """The loss at several points, side by side; inf or NaN where the rollout blew up."""

    def one(point: int, window: int) -> float:
        found, _, _ = _rolled(problem, space, points[point], window, None)
        return float(np.square(found, dtype=float).sum())

    n = len(problem.windows)
    found = budget.each(problem, one, [p for p in range(len(points)) for _ in range(n)], list(range(n)) * len(points))
    budget.count(problem, len(points))
    return [sum(found[p * n : (p + 1) * n]) for p in range(len(points))]


def _rolled(
    problem: FitProblem,
    space: ParameterSpace,
    raw: Float[np.ndarray, " p"],
    window: int,
    guesses: Sequence[Sequence[np.ndarray]] | None,
) -> tuple[np.ndarray, tuple[np.ndarray, ...], tuple[SolveReport, ...]]:
    """Residuals, potentials and reports of one window."""
    with torch.no_grad():
        parameters = space.physical(torch.as_tensor(raw, dtype=torch.float32))
        run = problem.roll(window, parameters, None if guesses is None else guesses[window])
        return problem.residual(window, run).numpy(), run.potentials, run.reports


def products(columns: list[np.ndarray], residuals: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """J^T J and J^T r, summed in double precision, `CHUNK` residuals at a time."""
    p = columns[0].shape[0]
    normal, slope = np.zeros((p, p)), np.zeros(p)
    for c, r in zip(columns, residuals):
        flat = r.ravel()
        for part in chunks(flat.size):
            wide, rest = c[:, part].astype(float), flat[part].astype(float)
            for i in range(p):
                slope[i] += float((wide[i] * rest).sum())
                for j in range(i, p):
                    normal[i, j] += float((wide[i] * wide[j]).sum())
    return np.triu(normal) + np.triu(normal, 1).T, slope


def chunks(size: int) -> list[slice]:
    """Slices of `CHUNK` that cover a size."""
    return [slice(begin, begin + CHUNK) for begin in range(0, size, CHUNK)]


def jacobian(
    problem: FitProblem, space: ParameterSpace, base: Residuals, budget: Budget, reuse: Jacobian | None = None
) -> Jacobian | None:
    """By forward differences; None where the budget is spent. The columns of `reuse` are overwritten.

    A dozen global parameters against many thousand residuals: one rollout per parameter, started from the pressures
    of the base rollout, costs less than one adjoint per residual or than carrying tangents. What is `UNSEEN` needs
    none: its derivatives are 0.
    """
    if budget.spent:
        return None
    # towards the prior, where the rollout is least likely to break down
    h = np.where(base.raw <= space.prior_raw, DIFFERENCE, -DIFFERENCE)
    columns = [np.empty((len(h), r.size), np.float32) for r in base.residuals] if reuse is None else reuse.columns
    acting = [p for p, f in enumerate(space.fitted) if f.name not in UNSEEN]

    def one(p: int, w: int) -> None:
        there, _, _ = _rolled(problem, space, base.raw + np.where(np.arange(len(h)) == p, h, 0.0), w, base.guesses)
        columns[w][p] = (there.ravel() - base.residuals[w].ravel()) / h[p]

    n = len(problem.windows)
    budget.each(problem, one, [p for p in acting for _ in range(n)], list(range(n)) * len(acting))
    budget.count(problem, len(acting))
    for p in range(len(h)):
        # where the rollout breaks down there is no derivative to be had: the variable stays
        if p not in acting or not all(np.isfinite(c[p]).all() for c in columns):
            for c in columns:
                c[p] = 0
    return Jacobian(columns, *products(columns, base.residuals))
