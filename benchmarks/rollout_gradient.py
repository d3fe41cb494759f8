"""Times the gradient of a rollout next to its rivals, and writes Markdown tables.

    python benchmarks/rollout_gradient.py --peers PEERS --rounds 5 --json rollout.json
    python benchmarks/rollout_gradient.py --cells 32 --rivals implicit phiflow

The scene: a box with a pillar, inflow on the left, outflow on the right, a quarter of air above; ten steps; the
gradient of the mean squared velocity with respect to gravity, viscosity and inflow velocity. Rivals:
  implicit     multigrid to 1e-5, implicit gradient (the default); implicit2: the same on two threads
  jacobi       100 sweeps and as many for the gradient, nothing stored
  slices       the same sweeps in torch operations on shifted slices, recorded by torch
  conv3d       the same sweeps as recurrent convolutions, recorded by torch: the form of the paper
  phiflow      PEERS/phiflow, a virtual environment with phiflow and torch; conjugate gradients to 1e-5
Every measurement is a process of its own, warmed up by one step: times are medians of its repeats, memory is its
high-water mark above what it held after that step. Rounds go through all rivals in turn; figures are medians over
rounds, ratios medians of the ratios within a round.

"error" is that of the gradient in single precision at the working tolerance, next to the same program in double
precision at 1e-10: the largest of gravity, viscosity and inflow. Jacobi's sweeps are judged as what they are, a fixed
number; how far they are from the solved pressure is the last column.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from peers.phiflow_rollout import peak, reset_peak
from peers.runner import SCRIPTS, machine, programs, show

Scene = dict[str, Any]
RIVALS = {
    "implicit": ("fluidlift, implicit multigrid, 1 thread", 1),
    "implicit2": ("fluidlift, implicit multigrid, 2 threads", 2),
    "jacobi": ("fluidlift, 100 Jacobi sweeps, 1 thread", 1),
    "slices": ("torch, 100 sweeps recorded, slices", 2),
    "conv3d": ("torch, 100 sweeps recorded, conv3d", 2),
    "phiflow": ("PhiFlow on torch, CG to 1e-5", 2),
}
GET_PHIFLOW = "phiflow is missing. Get it: python -m venv {0}/phiflow && {0}/phiflow/bin/pip install phiflow torch"
SHAPES = {"gravity": 3, "kinematic_viscosity": 1, "inflow_velocity": 3}


def box_with_pillar(n: int, dtype: str) -> tuple[Any, Any]:
    """The layout of n^3 cells over 1 m, and its physical parameters (Courant number 0.5)."""
    import numpy as np

    from fluidlift.physics.pressure import build_system
    from fluidlift.physics.rollout_domain import prepare_domain
    from fluidlift.types import CellType, FluidParameters, Grid

    grid, half, r = Grid((n, n, n), 1.0 / n), n // 2, n // 12
    types = np.full(grid.shape, CellType.FLUID, np.uint8)
    types[:, :, 0], types[:, 0], types[:, -1] = CellType.SOLID, CellType.SOLID, CellType.SOLID
    types[:, :, -n // 4 :] = CellType.EMPTY
    types[half - r : half + r, half - r : half + r, :half] = CellType.SOLID
    types[0][types[0] == CellType.FLUID] = CellType.INFLOW
    types[-1][types[-1] == CellType.FLUID] = CellType.OUTFLOW
    system, x = build_system(types, None, grid), np.array([1.0, 0.0, 0.0])
    physical = FluidParameters(
        kinematic_viscosity=5e-3, gravity=(1.0, 0.0, -9.81), inflow_velocity=(1.0, 0.0, 0.0), outflow_velocity=1.0,
        wall_damping=0.2, time_step=0.5 / n,
    )  # fmt: skip
    return prepare_domain(types, system, mainstream=x, sweeps=5, dtype=np.dtype(dtype).type), physical


def recorded_sweeps(rhs: Any, system: Any, how: str, sweeps: int = 100) -> Any:
    """Jacobi's sweeps from zero, relaxed by 0.9, in torch operations that torch records."""
    import numpy as np
    import torch
    from torch.nn import functional

    kind = rhs.dtype
    diagonal = torch.from_numpy(system.diagonal()).to(kind)
    step = torch.where(diagonal > 0, 0.9 / diagonal.clamp(min=1e-30), 0)
    b = rhs.reshape(system.unknown.shape)
    scale = 1.0 / float(system.spacing) ** 2
    x, y, z = (torch.from_numpy(np.asarray(w)).to(kind) * scale for w in system.weights)
    star = torch.zeros((1, 1, 3, 3, 3), dtype=kind)
    for place in ((0, 1, 1), (2, 1, 1), (1, 0, 1), (1, 2, 1), (1, 1, 0), (1, 1, 2)):
        star[0, 0][place] = scale
    q = torch.zeros_like(b)
    for _ in range(sweeps):
        if how == "conv3d":  # all faces between unknown cells are open here
            around = functional.conv3d(q[None, None], star, padding=1)[0, 0]
        else:
            p = functional.pad(q, (1,) * 6)
            around = x[1:] * p[2:, 1:-1, 1:-1] + x[:-1] * p[:-2, 1:-1, 1:-1]
            around = around + y[:, 1:] * p[1:-1, 2:, 1:-1] + y[:, :-1] * p[1:-1, :-2, 1:-1]
            around = around + z[:, :, 1:] * p[1:-1, 1:-1, 2:] + z[:, :, :-1] * p[1:-1, 1:-1, :-2]
        q = q + step * (b + around - diagonal * q)
    return q.reshape(-1)


def recorded_rollout(velocity: Any, domain: Any, parameters: Any, steps: int, how: str) -> Any:
    """The rollout with torch's own advection and recorded sweeps; the rest as ours."""
    from fluidlift.physics.rollout import explicit_terms_plain
    from fluidlift.physics.rollout_operators import apply_linear, implicit_diffusion, set_outflow

    p = parameters
    for _ in range(steps):
        velocity = apply_linear(velocity, domain.extrapolation)
        velocity = explicit_terms_plain(velocity, domain, p, None, "plain")
        velocity = implicit_diffusion(velocity, domain, p.kinematic_viscosity, p.wall_damping, p.time_step)
        velocity = set_outflow(velocity, domain, p.outflow_velocity)
        q = recorded_sweeps(-apply_linear(velocity, domain.divergence), domain.system, how)
        velocity = velocity - apply_linear(q, domain.gradient)
    return apply_linear(velocity, domain.extrapolation)


def measure(scene: Scene) -> dict[str, Any]:
    """What a process of its own prints."""
    import numba
    import torch

    from fluidlift.physics.rollout import RolloutParameters, flatten, rollout
    from fluidlift.physics.rollout_pressure import RolloutOptions
    from fluidlift.types import FaceVelocity, Grid

    n, method = scene["cells"], scene["method"].rstrip("2")
    steps = 1 if scene["repeats"] else scene["steps"]
    torch.set_num_threads(scene["threads"])
    numba.set_num_threads(scene["threads"])
    double = scene.get("precision", 32) == 64
    kind = torch.float64 if double else torch.float32
    domain, physical = box_with_pillar(n, "float64" if double else "float32")
    projection = method if method == "jacobi" else "implicit"
    options = RolloutOptions(projection=projection, tolerance=scene.get("tolerance", 1e-5), sweeps=100)
    start = FaceVelocity.zeros(Grid((n, n, n), 1.0 / n))
    start.u[:] = 1.0
    flat = flatten(start, kind)
    domain.lists  # noqa: B018 built here, not in the first gradient
    forward, backward, used = [], [], 0.0
    for turn in range(scene["repeats"] + 1):
        if turn == 1:  # what one step leaves behind is the program, not the rollout
            used, steps = reset_peak(), scene["steps"]
        p = RolloutParameters.of(physical, kind)
        leaves = [getattr(p, name).requires_grad_() for name in SHAPES]
        began = time.perf_counter()
        if method in ("slices", "conv3d"):
            final = recorded_rollout(flat, domain, p, steps, method)
        else:
            every = scene.get("checkpoint_every")
            final = rollout(flat, domain, p, steps=steps, options=options, checkpoint_every=every).velocity
        loss = (final**2).mean()
        middle = time.perf_counter()
        loss.backward()
        forward.append(middle - began)
        backward.append(time.perf_counter() - middle)
    kept = max(scene["repeats"], 1)
    gradient = [float(x) for leaf in leaves for x in leaf.grad.reshape(-1)]
    return {"forward": forward[-kept:], "backward": backward[-kept:], "peak_mb": peak() - used, "loss": float(loss),
            "gradient": gradient}  # fmt: skip


def run(scene: Scene, peers: Path) -> dict[str, Any]:
    """A measurement in a process of its own; {"error": ...} where it fails."""
    command = [sys.executable, __file__, "--child", json.dumps(scene)]
    if scene["method"] == "phiflow":
        found = programs(peers)
        if "phiflow" not in found:
            return {"error": "missing"}
        command = [*found["phiflow"], "-W", "ignore", str(SCRIPTS / "phiflow_rollout.py"), json.dumps(scene)]
    threads = str(scene["threads"])
    env = dict(os.environ, NUMBA_NUM_THREADS=threads, OMP_NUM_THREADS=threads, OPENBLAS_NUM_THREADS=threads)
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if not lines:
        last = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
        return {"error": last[:120]}
    result = json.loads(lines[-1])
    for key in ("forward", "backward"):
        result[key] = statistics.median(result[key])
    result["total"] = result["forward"] + result["backward"]
    print(f"  {scene['cells']}^3 {scene['method']}: {result['total']:.3f} s", file=sys.stderr, flush=True)
    return result


def distance(gradient: list[float], reference: list[float]) -> float:
    """The largest relative difference among gravity, viscosity and inflow."""
    worst, begin = 0.0, 0
    for size in SHAPES.values():
        a, b = gradient[begin : begin + size], reference[begin : begin + size]
        norm = sum(y * y for y in b) ** 0.5
        worst = max(worst, sum((x - y) ** 2 for x, y in zip(a, b)) ** 0.5 / norm)
        begin += size
    return worst


def table(heading: str, columns: list[str], rows: list[list[str]]) -> list[str]:
    """Markdown."""
    lines = [f"### {heading}", "", "| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows), ""]


def compare(cells: int, given: argparse.Namespace, log: list[dict[str, Any]]) -> list[str]:
    """All rivals at one size."""
    scenes = {
        r: {"cells": cells, "steps": given.steps, "method": r, "threads": RIVALS[r][1], "repeats": given.repeats}
        for r in given.rivals
        if r != "conv3d" or cells <= given.largest_conv3d
    }
    runs: dict[str, list[dict[str, Any]]] = {r: [] for r in scenes}
    for _ in range(given.rounds):
        for r, scene in scenes.items():
            runs[r].append(run(scene, given.peers))
            log.append({"scene": scene, "result": runs[r][-1]})
    exact: dict[str, list[float]] = {}
    if cells <= given.largest_reference:
        for r in {"implicit", "jacobi", "phiflow"} & set(scenes) | {"implicit"}:
            base = scenes.get(r, {"cells": cells, "steps": given.steps, "method": r, "threads": 1})
            found = run(base | {"precision": 64, "tolerance": 1e-10, "repeats": 0}, given.peers)
            if "gradient" in found:
                exact[r] = found["gradient"]
            log.append({"scene": base | {"reference": True}, "result": found})
    rows = [_row(r, runs, exact) for r in scenes]
    columns = ["", "forward s", "backward s", "gradient s", "over implicit", "MB", "MB over implicit", "error",
               "from the solved gradient"]  # fmt: skip
    return table(f"{cells}^3, {given.steps} steps", columns, rows)


def _row(name: str, runs: dict[str, list[dict[str, Any]]], exact: dict[str, list[float]]) -> list[str]:
    label = RIVALS[name][0]
    good = [r for r in runs[name] if "total" in r]
    if not good:
        return [label, runs[name][0].get("error", ""), *[""] * 7]
    ours = runs.get("implicit", [])

    def middle(key: str) -> float:
        return statistics.median(r[key] for r in good)

    def over(key: str) -> str:
        ratios = [a[key] / b[key] for a, b in zip(runs[name], ours) if key in a and key in b and b[key] > 0]
        return show(statistics.median(ratios)) if ratios else ""

    family = {"implicit2": "implicit", "slices": "jacobi", "conv3d": "jacobi"}.get(name, name)
    error = f"{distance(good[-1]['gradient'], exact[family]):.1e}" if family in exact else ""
    solved = f"{distance(good[-1]['gradient'], exact['implicit']):.1e}" if "implicit" in exact else ""
    return [label, show(middle("forward")), show(middle("backward")), show(middle("total")), over("total"),
            show(middle("peak_mb")), over("peak_mb"), error, "" if name == "phiflow" else solved]  # fmt: skip


def checkpoint_memory(given: argparse.Namespace, log: list[dict[str, Any]]) -> list[str]:
    """A long rollout with and without checkpoints."""
    rows = []
    cells = max(given.cells)
    for every in (None, 5):
        scene = {"cells": cells, "steps": 25, "method": "implicit", "threads": 1, "repeats": 1}
        scene["checkpoint_every"] = every
        result = run(scene, given.peers)
        log.append({"scene": scene, "result": result})
        rows.append([str(every or "none"), *(show(result.get(k)) for k in ("total", "peak_mb"))])
    return table(f"Checkpoints, {cells}^3, 25 steps", ["checkpoint every", "gradient s", "MB"], rows)


def surrogate_table(cells: int = 20, steps: int = 4) -> list[str]:
    """How far both gradients of advection are from central differences of the rollout, by Courant number."""
    from dataclasses import replace

    import torch

    from fluidlift.physics.rollout import RolloutParameters, rollout
    from fluidlift.physics.rollout_pressure import RolloutOptions

    domain, physical = box_with_pillar(cells, "float64")
    names = ("inflow_velocity", "gravity")
    solved = RolloutOptions(tolerance=1e-12)
    rows = []
    for courant in (0.1, 0.25, 0.5, 1.0, 2.0):
        base = RolloutParameters.of(replace(physical, time_step=courant / cells), torch.float64)
        rest = torch.zeros(domain.offsets[3], dtype=torch.float64)
        begin = rollout(rest, domain, base, steps=5, options=solved).velocity.detach()

        def loss(parameters: Any, options: Any, begin: Any = begin) -> Any:
            return (rollout(begin, domain, parameters, steps=steps, options=options).velocity ** 2).mean()

        row = [f"{courant:g}"]
        for gradient in ("exact", "upwind"):
            leaves = {name: getattr(base, name).clone().requires_grad_() for name in names}
            loss(replace(base, **leaves), replace(solved, advection_gradient=gradient)).backward()
            for name in names:
                e = torch.zeros(3, dtype=torch.float64)
                e[0] = 1e-5
                ends = [
                    float(loss(replace(base, **{name: getattr(base, name) + s * e}), solved)) for s in (-1, 1)
                ]  # fmt: skip
                row.append(f"{abs(float(leaves[name].grad[0]) / ((ends[1] - ends[0]) / 2e-5) - 1):.1e}")
        rows.append(row)
    columns = ["Courant number", "exact: inflow", "exact: gravity", "upwind: inflow", "upwind: gravity"]
    return table(f"Off central differences, {cells}^3, {steps} steps", columns, rows)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--peers", type=Path, default=Path("peers"), help="folder of the peers' environments")
    parser.add_argument("--cells", type=int, nargs="*", default=[32, 48, 64])
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=3, help="gradients per process, after one of a single step")
    parser.add_argument("--rivals", nargs="*", choices=list(RIVALS), default=list(RIVALS))
    parser.add_argument("--largest-conv3d", type=int, default=48, help="cells; beyond, it needs some 14 GB")
    parser.add_argument("--largest-reference", type=int, default=32, help="cells up to which gradients are judged")
    parser.add_argument("--json", type=Path, help="writes every figure here")
    given = parser.parse_args()
    if given.child:
        print(json.dumps(measure(json.loads(given.child))))
        return 0
    given.peers = given.peers.absolute()
    if "phiflow" in given.rivals and "phiflow" not in programs(given.peers):
        print(GET_PHIFLOW.format(given.peers), file=sys.stderr)
    log: list[dict[str, Any]] = []
    lines = [f"{machine()}; medians of {given.rounds} rounds.", ""]
    for cells in given.cells:
        lines += compare(cells, given, log)
    lines += checkpoint_memory(given, log) + surrogate_table() + [f"At the end: {machine()}."]
    print("\n".join(lines))
    if given.json:
        given.json.write_text(json.dumps(log, indent=1), encoding="utf-8")
    return int(any("error" in entry["result"] for entry in log if entry["scene"]["method"] != "phiflow"))


if __name__ == "__main__":
    sys.exit(main())
