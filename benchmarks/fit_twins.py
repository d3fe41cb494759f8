"""How well the fit finds the parameters of flows whose parameters are known, as Markdown tables.

    python benchmarks/fit_twins.py --seeds 5 --json fit_twins.json
    python benchmarks/fit_twins.py --scenes honey --seeds 2 --parts recovery

Twins (`fluidlift.synthetic.twins`): a river, a pour, honey on a slope. Every fit starts from a wrong guess; its values
are the centres of the priors.

recovery: per scene and seed, from exact velocities, and from velocities with 20 % of noise on every face where a third
  of the cells was not seen. An error is relative to the true value, that of a component to the size of its vector, that
  of a true value of 0 to the inflow's speed (fluctuation) or to 1. "inside": the truth within 1.96 sigma of the value.
  z: error in sigmas; its root mean square is 1 where sigmas are right.
restarts: the same twin from guesses at other scales; the spread of the values they end at.
large: 64^3 cells, windows of 25 steps, in a process of its own: seconds and peak memory.

Seconds depend on what else runs on the machine; everything else does not.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threaded BLAS stalls on busy machines

import numpy as np

from fluidlift.fit.optimize import fit_parameters
from fluidlift.synthetic.twins import PLANS, Twin, make_twin
from fluidlift.types import FitResult, FluidParameters

INTERVAL_WIDTH = 1.96
"""sigmas: 95 % of a Gaussian"""
COVERAGE_GOAL = 0.9
SCENES = ("river", "pour", "honey")
VECTORS = ("gravity", "inflow_velocity")


@dataclass(frozen=True)
class Condition:
    """What the fit is given."""

    name: str
    noise: float
    hidden: float
    goal: float
    """largest relative error that is wanted"""


CAN_HIDE = "observed" in inspect.signature(fit_parameters).parameters
"""whether the fit can be told which cells were seen"""
CONDITIONS = (
    Condition("exact", 0.0, 0.0, 0.02),
    Condition("20 % noise, a third hidden", 0.2, 1 / 3, 0.1) if CAN_HIDE else Condition("20 % noise", 0.2, 0.0, 0.1),
)


@dataclass(frozen=True)
class Recovery:
    """One parameter of one fit."""

    scene: str
    seed: int
    condition: str
    label: str
    truth: float
    prior: float
    value: float
    sigma: float
    error: float
    """relative"""
    identifiable: bool
    inside: bool
    z: float


@dataclass(frozen=True)
class Run:
    """One fit."""

    scene: str
    seed: int
    condition: str
    converged: bool
    rollouts: int
    seconds: float
    loss: float
    notes: tuple[str, ...]


def twin_of(scene: str, seed: int, condition: Condition, **options: Any) -> Twin:
    """The twin under a condition."""
    return make_twin(scene, seed=seed, noise=condition.noise, hidden=condition.hidden, **options)


def fit_twin(twin: Twin, start: FluidParameters | None = None, **options: Any) -> FitResult:
    """The fit to a twin, by default from its wrong guess."""
    if twin.observed is not None:
        options["observed"] = list(twin.observed)
    options = {"max_seconds": 120.0, "steps_per_frame": twin.steps_per_frame} | options
    return fit_parameters(
        twin.frames, twin.cell_types, None, twin.grid, twin.interval, start or twin.start, kind=twin.kind,
        mainstream=twin.mainstream, **options,
    )  # fmt: skip


def split(label: str) -> tuple[str, int | None]:
    """`gravity_z` to ("gravity", 2), `restitution` to ("restitution", None)."""
    name, _, axis = label.rpartition("_")
    return (name, "xyz".index(axis)) if name in VECTORS else (label, None)


def true_value(truth: FluidParameters, label: str) -> float:
    """The true number of a label."""
    name, axis = split(label)
    value = getattr(truth, name)
    return float(value if axis is None else value[axis])


def size_of(truth: FluidParameters, label: str) -> float:
    """What an error is relative to: see the module."""
    name, axis = split(label)
    value = getattr(truth, name)
    size = math.hypot(*value) if axis is not None else abs(value)
    if size == 0:
        return math.hypot(*truth.inflow_velocity) if name == "inflow_fluctuation" else 1.0
    return size


def recoveries(twin: Twin, found: FitResult, seed: int, condition: Condition) -> list[Recovery]:
    """All parameters of one fit beside their truth."""
    out = []
    for label, e in found.estimates.items():
        truth = true_value(twin.truth, label)
        off = e.value - truth
        z = off / e.sigma if e.sigma > 0 else math.inf * np.sign(off)
        error = abs(off) / size_of(twin.truth, label)
        row = (truth, e.prior, e.value, e.sigma, error, e.identifiable, bool(abs(z) <= INTERVAL_WIDTH), float(z))
        out.append(Recovery(twin.name, seed, condition.name, label, *row))
    return out


def tell(text: str) -> None:
    """Progress, beside the tables."""
    print(text, file=sys.stderr, flush=True)


def recover(scenes: Sequence[str], seeds: Sequence[int], **options: Any) -> tuple[list[Recovery], list[Run]]:
    """All fits of the first part."""
    rows, runs = [], []
    for condition in CONDITIONS:
        for scene in scenes:
            for seed in seeds:
                twin = twin_of(scene, seed, condition)
                began = time.perf_counter()
                found = fit_twin(twin, **options)
                seconds = time.perf_counter() - began
                rows += recoveries(twin, found, seed, condition)
                how = (found.converged, found.rollouts, seconds, found.extra["loss"], found.notes)
                runs.append(Run(scene, seed, condition.name, *how))
                known = [r for r in rows if (r.scene, r.seed, r.condition) == (scene, seed, condition.name)]
                worst = max((r for r in known if r.identifiable), key=lambda r: r.error, default=None)
                said = "nothing identifiable" if worst is None else f"worst {worst.label} {100 * worst.error:.2f} %"
                tell(f"{condition.name}: {scene} {seed}: {seconds:.1f} s, {found.rollouts} rollouts, {said}")
    return rows, runs


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return lines + ["| " + " | ".join(row) + " |" for row in rows] + [""]


def per_cent(share: float) -> str:
    """Of an error."""
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"


def summary(rows: Sequence[Recovery]) -> list[str]:
    """Cells of a line on some parameters: number, identifiable, median, worst, coverage, size of z."""
    known = [r for r in rows if r.identifiable]
    if not known:
        return [str(len(rows)), "0", "", "", "", ""]
    worst = max(known, key=lambda r: r.error)
    z = math.sqrt(float(np.mean([r.z**2 for r in known])))
    return [
        str(len(rows)), str(len(known)), per_cent(float(np.median([r.error for r in known]))),
        f"{per_cent(worst.error)} ({worst.label}, {worst.scene} {worst.seed})",
        f"{np.mean([r.inside for r in known]):.2f}", f"{z:.2f}",
    ]  # fmt: skip


def recovery_tables(rows: list[Recovery], runs: list[Run], every: bool) -> list[str]:
    """Totals, parameters, and (`every`) every number."""
    lines = ["## Recovery", ""]
    numbers = ["numbers", "identifiable", "median error", "worst error", "inside 95 %", "rms z"]
    body = []
    for c in CONDITIONS:
        for scene in [*dict.fromkeys(r.scene for r in rows), "all"]:
            some = [r for r in rows if r.condition == c.name and scene in (r.scene, "all")]
            mine = [r for r in runs if r.condition == c.name and scene in (r.scene, "all")]
            done = f"{sum(r.converged for r in mine)}/{len(mine)}"
            cost = [f"{np.median([r.rollouts for r in mine]):.0f}", f"{np.median([r.seconds for r in mine]):.1f}"]
            body.append([c.name, scene, *summary(some), done, *cost])
        body.append(["", "goal", "", "", "", f"< {per_cent(c.goal)}", f">= {COVERAGE_GOAL}", "1", "", "", ""])
    lines += table(["given", "scene", *numbers, "converged", "rollouts", "s"], body)
    for c in CONDITIONS:
        lines += [f"### Parameters, {c.name}", ""]
        body = []
        for label in dict.fromkeys(r.label for r in rows):
            body.append([label, *summary([r for r in rows if r.condition == c.name and r.label == label])])
        lines += table(["parameter", *numbers], body)
    if not every:
        return lines
    lines += ["### Every number", ""]
    body = [
        [
            r.condition, f"{r.scene} {r.seed}", r.label, f"{r.truth:.4g}", f"{r.prior:.4g}", f"{r.value:.4g}",
            f"{r.sigma:.2g}", per_cent(r.error), "yes" if r.identifiable else "no", "yes" if r.inside else "no",
            f"{abs(r.z):.2f}",
        ]
        for r in rows
    ]  # fmt: skip
    head = ["given", "twin", "parameter", "truth", "start", "found", "sigma", "error", "identifiable", "inside", "z"]
    return lines + table(head, body)


def starts_of(twin: Twin) -> dict[str, FluidParameters]:
    """Guesses at other scales."""
    s = twin.start
    gx, gy, gz = s.gravity
    c, d = math.cos(math.radians(10)), math.sin(math.radians(10))
    faster = {f: tuple(f * v for v in s.inflow_velocity) for f in (0.5, 2.0)}
    return {
        "as given": s,
        "inflow x 0.5": replace(s, inflow_velocity=faster[0.5]),
        "inflow x 2": replace(s, inflow_velocity=faster[2.0]),
        "viscosity / 10": replace(s, kinematic_viscosity=s.kinematic_viscosity / 10),
        "viscosity x 10": replace(s, kinematic_viscosity=s.kinematic_viscosity * 10),
        "gravity turned 10 degrees": replace(s, gravity=(gx * c - gz * d, gy, gx * d + gz * c)),
        "damping 0.05": replace(s, wall_damping=0.05),
        "damping 0.6": replace(s, wall_damping=0.6),
    }


def restart(scenes: Sequence[str], seed: int = 0) -> list[dict[str, Any]]:
    """Where the fit ends from each start, per scene and condition."""
    out = []
    for condition in CONDITIONS:
        for scene in scenes:
            twin = twin_of(scene, seed, condition)
            ends = {}
            for name, start in starts_of(twin).items():
                found = fit_twin(twin, start)
                ends[name] = {
                    "loss": found.extra["loss"], "converged": found.converged, "rollouts": found.rollouts,
                    "estimates": {k: asdict(e) for k, e in found.estimates.items()},
                }  # fmt: skip
                tell(f"{condition.name}: {scene} from {name}: loss {found.extra['loss']:.3g}")
            truth = {label: true_value(twin.truth, label) for label in next(iter(ends.values()))["estimates"]}
            sizes = {label: size_of(twin.truth, label) for label in truth}
            out.append({"scene": scene, "condition": condition.name, "ends": ends, "truth": truth, "sizes": sizes})
    return out


def restart_tables(results: list[dict[str, Any]]) -> list[str]:
    """Spread of the ends: of parameters that are identifiable from every start."""
    lines = ["## Restarts", "", "Spread: largest less smallest value over all starts, relative and in sigmas.", ""]
    losses, spreads = [], []
    for r in results:
        ends = r["ends"]
        some = [e["loss"] for e in ends.values()]
        done = sum(e["converged"] for e in ends.values())
        losses.append([r["condition"], r["scene"], str(len(ends)), str(done), f"{min(some):.3g}", f"{max(some):.3g}"])
        for label, truth in r["truth"].items():
            found = [e["estimates"][label] for e in ends.values()]
            if not all(f["identifiable"] for f in found):
                continue
            values, sigma = [f["value"] for f in found], float(np.median([f["sigma"] for f in found]))
            spread = max(values) - min(values)
            spreads.append([
                r["condition"], r["scene"], label, f"{truth:.4g}", f"{min(values):.4g}", f"{max(values):.4g}",
                per_cent(spread / r["sizes"][label]), f"{spread / sigma:.2f}",
            ])  # fmt: skip
    lines += table(["given", "scene", "starts", "converged", "lowest loss", "highest loss"], losses)
    head = ["given", "scene", "parameter", "truth", "lowest", "highest", "spread", "spread / sigma"]
    return lines + table(head, spreads)


def large(cells: int = 64) -> dict[str, Any]:
    """One fit of a river in windows of 25 steps (this process does nothing else)."""
    condition = CONDITIONS[0]
    twin = twin_of("river", 0, condition, cells=(cells,) * 3, frames=11, steps_per_frame=5)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    began = time.perf_counter()
    found = fit_twin(twin, frames_per_window=5, max_seconds=300.0)
    seconds = time.perf_counter() - began
    rows = recoveries(twin, found, 0, condition)
    return {
        "cells": cells, "fluid": int((twin.cell_types == 1).sum()), "seconds": seconds, "rollouts": found.rollouts,
        "steps": found.extra["steps_per_window"], "windows": found.extra["windows"],
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "memory_before": before,
        "converged": found.converged, "notes": list(found.notes), "rows": [asdict(r) for r in rows],
    }  # fmt: skip


def large_tables(result: dict[str, Any]) -> list[str]:
    """The fit at 64^3."""
    r = result
    head = [
        "cells",
        "fluid cells",
        "windows",
        "steps",
        "rollouts",
        "s",
        "peak MiB",
        "of it before the fit",
        "converged",
    ]
    row = [
        f"{r['cells']}^3", str(r["fluid"]), f"{r['windows']:.0f}", f"{r['steps']:.0f}", str(r["rollouts"]),
        f"{r['seconds']:.1f}", f"{r['memory']:.0f}", f"{r['memory_before']:.0f}", "yes" if r["converged"] else "no",
    ]  # fmt: skip
    lines = ["## 64^3 cells, 25 steps", "", *table(head, [row]), *(f"- {note}" for note in r["notes"]), ""]
    numbers = ["numbers", "identifiable", "median error", "worst error", "inside 95 %", "rms z"]
    return lines + table(numbers, [summary([Recovery(**row) for row in r["rows"]])])


def large_apart() -> dict[str, Any]:
    """`large` in a process of its own, so that the peak of memory is the fit's."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.json"
        subprocess.run([sys.executable, __file__, "--large-here", str(path)], check=True)
        return json.loads(path.read_text())


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=sorted(PLANS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0, help="seeds from here on")
    parser.add_argument("--parts", nargs="+", default=("recovery", "restarts", "large"))
    parser.add_argument("--every", action="store_true", help="a line for every number")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--large-here", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.large_here is not None:
        chosen.large_here.write_text(json.dumps(large()))
        return
    lines, log = [], {}
    if "recovery" in chosen.parts:
        rows, runs = recover(chosen.scenes, range(chosen.first_seed, chosen.first_seed + chosen.seeds))
        lines += recovery_tables(rows, runs, chosen.every)
        log |= {"recovery": [asdict(r) for r in rows], "runs": [asdict(r) for r in runs]}
    if "restarts" in chosen.parts:
        log["restarts"] = restart(chosen.scenes)
        lines += restart_tables(log["restarts"])
    if "large" in chosen.parts:
        log["large"] = large_apart()
        lines += large_tables(log["large"])
    print("\n".join(lines))
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(log, indent=1))


if __name__ == "__main__":
    main()
