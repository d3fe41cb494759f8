"""Tells what became slower: a short ladder of work, each rung as a multiple of a reference kernel on the same machine.

    python -m benchmarks.guard                    against the ratios in benchmarks/results/guard.json; exit code 1 where
                                                  something is over 10 % slower
    python -m benchmarks.guard --record           write them anew
    python -m benchmarks.guard --only step solve

    step       a substep of a dam break: particles, grid, pressure
    solve      the pressure of a thin river, to 1e-5
    gradient   five steps of the differentiable rollout, forward and backward
    splat      20,000 Gaussians at 256 px, forward and backward
    make       `fluidlift make` on half a second of the project's clip, draft

A rung and the reference (sweeps of a seven-point stencil that does not fit the cache) take turns, so that what else
runs on the machine meets both. Processor time of one thread, in rounds; the ratio is that of the two least times, as
noise only adds. What `make` starts counts with its children.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import torch
from benchmarks.report import FOLDER, put

import fluidlift

TOPIC = "guard"
FIGURE = "over the reference"
SLOWER = 0.1
"""share by which a ratio may grow: two runs on a busy machine differ by up to 0.06"""
CELLS = 128
"""of the reference along each axis: 16 MB in two arrays of float32"""
SWEEPS = 20
ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""of the environment"""

Rung = Callable[[], object]


@numba.njit(cache=True)
def _sweep(source, target):
    nx, ny, nz = source.shape
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                around = source[i - 1, j, k] + source[i + 1, j, k] + source[i, j - 1, k] + source[i, j + 1, k]
                around += source[i, j, k - 1] + source[i, j, k + 1]
                target[i, j, k] = np.float32(0.5) * source[i, j, k] + np.float32(1.0 / 12.0) * around


def reference() -> Rung:
    """The kernel that all times are told in."""
    one = np.random.default_rng(0).random((CELLS, CELLS, CELLS), np.float32)
    two = one.copy()

    def run() -> None:
        for _ in range(SWEEPS // 2):
            _sweep(one, two)
            _sweep(two, one)

    return run


def step() -> Rung:
    """A substep of a dam break that falls, always the same one."""
    from fluidlift.synthetic.tanks import dam_break

    simulator = dam_break(cells=20, width_cells=10).simulator()
    simulator.advance(0.02)
    state, dt = simulator.state(), 0.5 * simulator.parameters.time_step

    def run() -> None:
        simulator.restore(state)
        simulator.advance(dt)

    return run


def solve() -> Rung:
    """A pressure solve from zero."""
    from fluidlift.numerics.poisson import solve as poisson_solve
    from fluidlift.physics.pressure import build_system
    from fluidlift.types import CellType, Grid

    grid = Grid((128, 64, 32), 0.02)
    x, y, z = np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij")
    types = np.full(grid.shape, CellType.EMPTY, np.uint8)
    types[z < 6 + 4 * np.sin(0.1 * x) + 2] = CellType.FLUID
    types[z < 3 + 2 * np.cos(0.15 * y)] = CellType.SOLID
    system = build_system(types, None, grid)
    rhs = np.where(system.unknown, np.random.default_rng(0).normal(size=grid.shape), 0.0)
    return lambda: poisson_solve(system, rhs, tolerance=1e-5)


def gradient() -> Rung:
    """Of gravity, viscosity and inflow."""
    from rollout_gradient import SHAPES, box_with_pillar

    from fluidlift.physics.rollout import RolloutParameters, flatten, rollout
    from fluidlift.types import FaceVelocity, Grid

    n = 32
    domain, physical = box_with_pillar(n, "float32")
    start = FaceVelocity.zeros(Grid((n, n, n), 1.0 / n))
    start.u[:] = 1.0
    flat = flatten(start, torch.float32)

    def run() -> None:
        parameters = RolloutParameters.of(physical, torch.float32)
        for leaf in SHAPES:
            getattr(parameters, leaf).requires_grad_()
        (rollout(flat, domain, parameters, steps=5).velocity ** 2).mean().backward()

    return run


def splat() -> Rung:
    """A ball, its picture and its gradients."""
    from splatting import Scene, with_gradients

    from fluidlift.numerics.splatting_torch import NumbaRasterizer

    return with_gradients(NumbaRasterizer(), Scene.ball(20_000, (256, 256), "volume"))


def make() -> Rung:
    """The whole way, in a process of its own."""
    clip = Path(fluidlift.__file__).parent / "synthetic" / "data" / "demo.mp4"

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "fluidlift", "make", str(clip), "-o", f"{folder}/asset"]
            command += ["--preset", "draft", "--duration", "0.5"]
            done = subprocess.run(command, env=os.environ | ONE_THREAD, capture_output=True, text=True)
            if done.returncode not in (0, 4):  # 4: done, with warnings
                raise SystemExit(done.stderr[-1000:])

    return run


RUNGS: dict[str, tuple[Callable[[], Rung], int]] = {
    "step": (step, 9), "solve": (solve, 9), "gradient": (gradient, 9), "splat": (splat, 7), "make": (make, 2),
}  # fmt: skip
"""how each is set up, and its rounds"""


def processor_time() -> float:
    """s of this process and of the children that it waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def ratio(rung: Rung, measure: Rung, rounds: int) -> float:
    """Least time of the rung over the least of the reference; both are called once before."""
    times: dict[Rung, list[float]] = {rung: [], measure: []}
    for turn in range(rounds + 1):
        for run, taken in times.items():
            begin = processor_time()
            run()
            if turn:  # the first one compiles
                taken.append(processor_time() - begin)
    return min(times[rung]) / min(times[measure])


def before() -> dict[str, float]:
    """The recorded ratios; none where nothing was recorded."""
    path = FOLDER / f"{TOPIC}.json"
    if not path.is_file():
        return {}
    return {r["subject"]: r["value"] for r in json.loads(path.read_text(encoding="utf-8"))["records"]}


def verdict(value: float, recorded: float | None) -> str:
    """In words; empty where nothing was recorded."""
    if recorded is None:
        return "not recorded yet"
    change = value / recorded - 1.0
    return f"{abs(change):.0%} {'slower' if change > 0 else 'faster'}" + (" TOO SLOW" if change > SLOWER else "")


def main() -> int:
    """Prints each rung beside what was recorded; 1 where one became slower."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=list(RUNGS), default=list(RUNGS))
    parser.add_argument("--record", action="store_true", help="write the ratios for the next comparison")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    sys.path.insert(0, str(Path(__file__).parent))  # the other benchmarks are scripts, which find each other so
    measure, recorded, found = reference(), before(), {}
    for name in asked.only:
        prepare, rounds = RUNGS[name]
        found[name] = ratio(prepare(), measure, rounds)
        print(f"{name:9} {found[name]:9.3g}  {verdict(found[name], recorded.get(name))}", flush=True)
    if asked.record:
        rows = [{"subject": name, "figure": FIGURE, "value": round(value, 4)} for name, value in found.items()]
        put(TOPIC, rows, date=str(datetime.date.today()))
        return 0
    return int(any(value > (1.0 + SLOWER) * recorded.get(name, np.inf) for name, value in found.items()))


if __name__ == "__main__":
    sys.exit(main())
