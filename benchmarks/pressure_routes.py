"""How a fit converges with each way through the pressure solve (paper: `percnn_str_fit`, `percnnresult`).

    python benchmarks/pressure_routes.py --figure routes.png --json routes.json
    python benchmarks/pressure_routes.py --iterations 8 --batches 1 --sizes 16

A twin is made with the implicit rollout: a channel with bed, banks and a rock that speeds up, under parameters that the
fit then looks for from a wrong start. Three parts:

* stencil: the recurrent convolution (PeRCNN) is fitted to pressures of a rollout with the wrong parameters, as the
  paper does, and validated on pressures that it has not seen, beside Jacobi's sweeps.
* convergence: Adam on 1, 2 and 4 windows per iteration with each route, and Levenberg-Marquardt with the implicit
  one. The loss is that of each route's own rollout over all windows; the parameter error is against the truth, in raw
  units and relative to the start. "recorded" routes are the paper's form, which torch differentiates sub-step by
  sub-step.
* gradients: d (kinetic energy) / d (inflow) of a rollout, time of value and gradient, and what is kept for `backward`.

Seconds are wall time of one thread, the untimed evaluation of the curves left out. Prints Markdown tables.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

# small arrays, three libraries in turn: their thread pools would wait for each other
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

from fluidlift.fit.methods import Budget, levenberg_marquardt
from fluidlift.fit.problem import FitProblem, build_problem, build_scene, plan_windows
from fluidlift.fit.ranges import ParameterSpace, parameter_space
from fluidlift.numerics.recurrent_stencil_fit import StencilFit, StencilValidation, fit_stencil, validate
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import RolloutParameters, rollout
from fluidlift.physics.rollout_domain import RolloutDomain, prepare_domain
from fluidlift.physics.rollout_pressure import RolloutOptions, sample_pressure_problems
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid

INTERVAL = 0.04
STEPS_PER_FRAME = 2
DOWNSTREAM = np.array([1.0, 0.0, 0.0])
TRUTH = FluidParameters(
    kinematic_viscosity=8e-3, gravity=(1.5, 0.2, -9.0), inflow_velocity=(1.0, 0.1, 0.0), outflow_velocity=1.1,
    wall_damping=0.3, time_step=INTERVAL / STEPS_PER_FRAME,
)  # fmt: skip
WRONG = FluidParameters(
    kinematic_viscosity=1e-3, gravity=(0.0, 0.0, -9.81), inflow_velocity=(0.5, 0.0, 0.0), outflow_velocity=0.5,
    wall_damping=0.1, time_step=INTERVAL / STEPS_PER_FRAME,
)  # fmt: skip
FREE = ("kinematic_viscosity", "gravity", "inflow_velocity", "outflow_velocity", "wall_damping")
LABELS = {
    "recurrent_unrolled": "PeRCNN, recorded", "recurrent": "PeRCNN, self-adjoint", "unrolled": "Jacobi, recorded",
    "jacobi": "Jacobi, self-adjoint", "implicit": "implicit (analytic)",
}  # fmt: skip
COLOURS = {
    "recurrent_unrolled": "#c1440e", "recurrent": "#e8963d", "unrolled": "#3b6ea5", "jacobi": "#8fb8de",
    "implicit": "#2e8b57", "lm": "#111111",
}  # fmt: skip
STYLES: dict[int, Any] = {1: ":", 2: "--", 4: "-"}
TWINS = {"recurrent_unrolled": "recurrent", "unrolled": "jacobi"}
"""routes of the same numbers that keep no record"""


@dataclass
class Run:
    """One fit: curves over iterations, the start included."""

    route: str
    method: str
    batch: int
    seconds: list[float]
    losses: list[float]
    errors: list[float]
    """of the parameters"""


def channel(shape: tuple[int, int, int]) -> np.ndarray:
    """Cell types: bed, two banks, a rock, water to three quarters, an inlet and an outlet."""
    nx, ny, nz = shape
    depth = (3 * nz) // 4
    types = np.full(shape, CellType.EMPTY, np.uint8)
    types[:, :, :depth] = CellType.FLUID
    types[:, :, 0] = CellType.SOLID
    types[:, 0], types[:, -1] = CellType.SOLID, CellType.SOLID
    types[nx // 2 : nx // 2 + max(nx // 10, 2), ny // 3 : ny // 2, : depth // 2 + 1] = CellType.SOLID
    types[0][types[0] == CellType.FLUID] = CellType.INFLOW
    types[-1][types[-1] == CellType.FLUID] = CellType.OUTFLOW
    return types


def twin(types: np.ndarray, grid: Grid, frames: int) -> tuple[RolloutDomain, list[FaceVelocity]]:
    """The truth: frames of the channel, made with the implicit route."""
    domain = prepare_domain(types, build_system(types, None, grid), mainstream=DOWNSTREAM, sweeps=5)
    state, found = FaceVelocity.zeros(grid), []
    state.u[:] = 0.5
    for _ in range(frames):
        found.append(advance(domain, state, TRUTH, STEPS_PER_FRAME)[0])
        state = found[-1]
    return domain, found


def advance(
    domain: RolloutDomain, state: FaceVelocity, parameters: FluidParameters, steps: int
) -> tuple[FaceVelocity, tuple[np.ndarray, ...]]:
    """A rollout without gradients: the last velocity and the potentials of all steps."""
    with torch.no_grad():
        result = rollout(
            state, domain, RolloutParameters.of(parameters), steps=steps, options=RolloutOptions(tolerance=1e-6)
        )
    return FaceVelocity(*(c.numpy().copy() for c in result.faces())), result.potentials


def learn_stencil(
    domain: RolloutDomain, start: FaceVelocity, sub_steps: int, iterations: int
) -> tuple[StencilFit, StencilValidation, float]:
    """The recurrent convolution from the pressures of the initial parameters; seconds of the fit."""
    _, potentials = advance(domain, start, WRONG, 8)
    learn, check = (sample_pressure_problems([domain] * 4, potentials[first::2], seed=first) for first in (0, 1))
    began = time.perf_counter()
    fit = fit_stencil(learn, sub_steps=sub_steps, iterations=iterations)
    return fit, validate(fit.stencil, check), time.perf_counter() - began


def raw_truth(space: ParameterSpace) -> np.ndarray:
    """The truth in the optimiser's units."""
    values = TRUTH.to_dict()
    return np.array(
        [f.range.raw(values[f.name] if f.component is None else values[f.name][f.component]) for f in space.fitted]
    )


def parameter_error(space: ParameterSpace, raw: np.ndarray) -> float:
    """Distance from the truth over that of the start, raw."""
    truth = raw_truth(space)
    return float(np.sqrt(np.square(raw - truth).sum() / np.square(space.prior_raw - truth).sum()))


def whole_loss(problem: FitProblem, space: ParameterSpace, raw: torch.Tensor) -> float:
    """Over all windows, on the route without a record."""
    quick = TWINS.get(problem.options.projection, problem.options.projection)
    problem = replace(problem, options=replace(problem.options, projection=quick))
    with torch.no_grad():
        return sum(float(problem.loss(i, problem.roll(i, space.physical(raw)))) for i in range(len(problem.windows)))


def run_adam(
    problem: FitProblem, space: ParameterSpace, batch: int, *, iterations: int, rate: float, most_seconds: float
) -> Run:
    """Adam on the analytic gradient of `batch` windows at a time, in random order."""
    raw = torch.tensor(space.prior_raw, dtype=torch.float32, requires_grad=True)
    optimizer, rng = torch.optim.Adam([raw], lr=rate), np.random.default_rng(0)
    run = Run(problem.options.projection, "adam", batch, [0.0], [whole_loss(problem, space, raw)], [1.0])
    order: list[int] = []
    for iteration in range(iterations):
        began = time.perf_counter()
        if len(order) < batch:
            order += [int(i) for i in rng.permutation(len(problem.windows))]
        pick, order = order[:batch], order[batch:]
        optimizer.param_groups[0]["lr"] = rate * (1 - 0.8 * iteration / iterations)
        optimizer.zero_grad()
        for i in pick:
            problem.loss(i, problem.roll(i, space.physical(raw))).backward()
        optimizer.step()
        run.seconds.append(run.seconds[-1] + time.perf_counter() - began)
        run.losses.append(whole_loss(problem, space, raw))
        run.errors.append(parameter_error(space, raw.detach().double().numpy()))
        if run.seconds[-1] > most_seconds:
            break
    return run


def run_levenberg_marquardt(problem: FitProblem, space: ParameterSpace, most: int) -> Run:
    """Ended after 1, 2, ... iterations: what each costs from the start."""
    start = torch.as_tensor(space.prior_raw, dtype=torch.float32)
    run = Run("implicit", "lm", len(problem.windows), [0.0], [whole_loss(problem, space, start)], [1.0])
    for count in range(1, most + 1):
        budget = Budget(deadline=float("inf"), max_rollouts=10**6)
        began = time.perf_counter()
        found = levenberg_marquardt(problem, space, space.prior_raw, budget, max_iterations=count)
        run.seconds.append(time.perf_counter() - began)
        run.losses.append(found.loss)
        run.errors.append(parameter_error(space, found.raw))
        if found.converged:
            break
    return run


def gradients(size: int, sub_steps: int, steps: int = 4) -> list[dict[str, Any]]:
    """Inflow gradient, time and record of each route on a cube of `size` cells."""
    grid = Grid((size, size, size), 1.0 / size)
    types = channel(grid.shape)
    domain = prepare_domain(types, build_system(types, None, grid), mainstream=DOWNSTREAM)
    start = FaceVelocity.zeros(grid)
    start.u[:] = 0.5
    # a cell per step at the inflow's speed
    physical = replace(TRUTH, time_step=1.0 / size)
    stencil, _, _ = learn_stencil(domain, start, sub_steps, 60)
    truth, rows = 0.0, []
    for route in ("implicit", *LABELS):
        exact = not rows and truth == 0.0
        options = RolloutOptions(route, tolerance=1e-9 if exact else 1e-5, sweeps=sub_steps, stencil=stencil.stencil)
        found, seconds, kept = _timed_gradient(domain, start, physical, options, steps)
        if exact:
            truth = found
            continue
        rows.append({"size": size, "route": route, "ratio": found / truth, "seconds": seconds, "kept_mb": kept / 2**20})
    return rows


def _timed_gradient(
    domain: RolloutDomain, start: FaceVelocity, physical: FluidParameters, options: RolloutOptions, steps: int
) -> tuple[float, float, int]:
    inside = torch.from_numpy(domain.dynamic)
    times, kept, slope = [], 0, 0.0
    for _ in range(3):
        kept = 0

        def count(tensor: torch.Tensor) -> torch.Tensor:
            nonlocal kept
            kept += tensor.numel() * tensor.element_size()
            return tensor

        speed = torch.tensor(physical.inflow_velocity, dtype=torch.float32).requires_grad_()
        parameters = replace(RolloutParameters.of(physical), inflow_velocity=speed)
        began = time.perf_counter()
        with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
            moved = rollout(start, domain, parameters, steps=steps, options=options).velocity
            energy = (moved[inside] ** 2).mean()
        energy.backward()
        times.append(time.perf_counter() - began)
        assert speed.grad is not None
        slope = float(speed.grad[0])
    return slope, statistics.median(times), kept


def draw(runs: Sequence[Run], fit: StencilFit, validation: StencilValidation, path: Path) -> None:
    """Convergence over iterations and seconds, and the fit of the stencil."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 8), dpi=110)
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 3)
    drawn = {run.route for run in runs}
    for row, quantity in enumerate(("losses", "errors")):
        for column, over in enumerate(("iterations", "seconds")):
            axes = panels[row][column]
            for run in runs:
                lm = run.method == "lm"
                if over == "iterations" and TWINS.get(run.route) in drawn:
                    continue  # the curve of its twin
                values = getattr(run, quantity)
                # the start has no place on a logarithmic axis of time
                first = 0 if over == "iterations" else 1
                places = range(len(values)) if over == "iterations" else run.seconds[1:]
                style: dict[str, Any] = {
                    "color": COLOURS["lm" if lm else run.route],
                    "linestyle": "-" if lm else STYLES.get(run.batch, "-"),
                }
                marker: dict[str, Any] = {"marker": "o", "markersize": 3} if lm else {}
                axes.plot(places, values[first:], linewidth=1.4, **style, **marker)
            axes.set_yscale("log")
            if over == "seconds":
                axes.set_xscale("log")
            axes.set_xlabel(over)
            axes.set_ylabel("loss" if row == 0 else "parameter error / start")
            axes.grid(alpha=0.3)
    _legend(panels[0][0], runs)
    axes = panels[0][2]
    axes.plot(fit.errors, color=COLOURS["recurrent_unrolled"])
    axes.set(yscale="log", xlabel="iterations", ylabel="relative error of the pressure", title="fit of the convolution")
    axes.grid(alpha=0.3)
    axes = panels[1][2]
    axes.plot(validation.sub_steps, validation.curve, color=COLOURS["recurrent_unrolled"], label="fitted convolution")
    axes.plot(validation.sub_steps, validation.jacobi_curve, color=COLOURS["unrolled"], label="Jacobi")
    axes.axvline(fit.stencil.sub_steps, color="#888888", linewidth=0.8)
    axes.set(yscale="log", xlabel="sub-steps", ylabel="relative error of the pressure", title="validation")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path)


def _legend(axes: Any, runs: Sequence[Run]) -> None:
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], color=COLOURS[r], label=LABELS[r]) for r in LABELS if any(x.route == r for x in runs)]
    batches = sorted({r.batch for r in runs if r.method == "adam"})
    lines += [Line2D([], [], color="#555555", linestyle=STYLES.get(b, "-"), label=f"batch {b}") for b in batches]
    lines.append(Line2D([], [], color=COLOURS["lm"], marker="o", markersize=3, label="LM, implicit"))
    axes.legend(handles=lines, fontsize=7)


def convergence_table(runs: Sequence[Run]) -> str:
    """Markdown."""
    lines = [
        "| route | method | windows per iteration | ms per iteration | iterations | loss / start "
        "| parameter error / start | iterations, seconds to a tenth of the error |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in runs:
        n = len(r.losses) - 1
        reached = next((i for i, e in enumerate(r.errors) if e < 0.1), None)
        when = "not reached" if reached is None else f"{reached}, {r.seconds[reached]:.1f} s"
        lines.append(
            f"| {LABELS[r.route]} | {r.method} | {r.batch} | {1e3 * r.seconds[-1] / n:.0f} | {n} "
            f"| {r.losses[-1] / r.losses[0]:.2g} | {r.errors[-1]:.3f} | {when} |"
        )
    return "\n".join(lines)


def gradient_table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown."""
    lines = ["| cells | route | inflow gradient / converged one | ms | MB kept |", "|---|---|---|---|---|"]
    for r in rows:
        figures = f"{r['ratio']:.3f} | {1e3 * r['seconds']:.0f} | {r['kept_mb']:.1f}"
        lines.append(f"| {r['size']}^3 | {LABELS[r['route']]} | {figures} |")
    return "\n".join(lines)


def parsed() -> argparse.Namespace:
    """The command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--shape", type=int, nargs=3, default=(24, 14, 10), help="cells of the twin")
    p.add_argument("--batches", type=int, nargs="*", default=(1, 2, 4), help="windows per iteration")
    p.add_argument("--routes", nargs="*", default=tuple(LABELS), choices=tuple(LABELS))
    p.add_argument("--iterations", type=int, default=80, help="of Adam")
    p.add_argument("--rate", type=float, default=0.15, help="first step of Adam, raw units")
    p.add_argument("--seconds", type=float, default=45.0, help="at most, per fit")
    p.add_argument("--sub-steps", type=int, default=100, help="of one pressure solve")
    p.add_argument("--sizes", type=int, nargs="*", default=(32,), help="cells across, of the gradients")
    p.add_argument("--figure", type=Path, help="PNG")
    p.add_argument("--json", type=Path)
    return p.parse_args()


def main() -> None:
    """Run, print, draw."""
    args = parsed()
    torch.set_num_threads(1)
    nx, ny, nz = args.shape
    grid = Grid((nx, ny, nz), 2.4 / nx)
    types = channel(grid.shape)
    domain, frames = twin(types, grid, 9)
    fit, validation, seconds = learn_stencil(domain, frames[0], args.sub_steps, 60)
    print(
        f"stencil of {args.sub_steps} sub-steps, fitted in {seconds:.1f} s: error of unseen pressures "
        f"{validation.errors.max():.2g}, Jacobi {validation.jacobi_errors.max():.2g}; residuals "
        f"{validation.residuals.max():.2g} and {validation.jacobi_residuals.max():.2g}; "
        f"accepted: {validation.accepted} {validation.advice}\n"
    )
    scene = build_scene(frames, [types] * len(frames), None, grid, kind="stream", mainstream=DOWNSTREAM)
    plan = plan_windows(scene, INTERVAL, windows=4, steps_per_frame=STEPS_PER_FRAME, frames=2)
    space = parameter_space(WRONG, free=FREE, speed=scene.speed, spacing=grid.spacing)
    runs = []
    for route in args.routes:
        options = RolloutOptions(route, sweeps=args.sub_steps, stencil=fit.stencil)
        problem = build_problem(scene, plan, options=options)
        warm = problem.loss(0, problem.roll(0, space.physical(torch.tensor(space.prior_raw, dtype=torch.float32))))
        assert torch.isfinite(warm)
        for batch in args.batches:
            limits = {"iterations": args.iterations, "rate": args.rate, "most_seconds": args.seconds}
            runs.append(run_adam(problem, space, batch, **limits))
    runs.append(run_levenberg_marquardt(build_problem(scene, plan), space, 12))
    print(convergence_table(runs) + "\n")
    rows = [row for size in args.sizes for row in gradients(size, args.sub_steps)]
    print(gradient_table(rows))
    if args.figure:
        draw(runs, fit, validation, args.figure)
    if args.json:
        stencil = {k: np.asarray(v).tolist() for k, v in vars(fit.stencil).items()}
        checked = {k: np.asarray(v).tolist() for k, v in vars(validation).items()} | {"accepted": validation.accepted}
        whole = {"runs": [asdict(r) for r in runs], "gradients": rows, "stencil": stencil, "validation": checked}
        whole["stencil_errors"] = fit.errors.tolist()
        args.json.write_text(json.dumps(whole, indent=1))


if __name__ == "__main__":
    main()
