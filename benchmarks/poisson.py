"""Times of the pressure solve on irregular domains, beside SciPy and PyAMG where they are installed.

    python benchmarks/poisson.py --sizes 64 128 --repeats 5
    python benchmarks/poisson.py --sizes 64 --domains thin_river --peers ours

Every solver gets the same right side and goes to the same relative residual, 1e-5; the true residual is computed from
the sparse matrix in double precision. Times are medians of warm runs, in ms. Ours builds its levels in every solve:
`set-up` is that share of the total. `from a guess` starts from the solution of a right side that differs by a tenth.
The domains are those of tests/numerics/test_multigrid.py. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threaded BLAS stalls SciPy on busy machines

import numba
import numpy as np
from scipy import sparse
from scipy.sparse import linalg

from fluidlift.numerics import multigrid
from fluidlift.numerics.poisson import PoissonSystem, solve

ROOT = Path(__file__).resolve().parent.parent
TOLERANCE = 1e-5
SLOW = 5.0
"""s, of a solve that is not repeated"""
MOST_ITERATIONS = 2000


@dataclass(frozen=True)
class Problem:
    """One linear system, as cells and as a sparse matrix."""

    name: str
    system: PoissonSystem
    rhs: np.ndarray
    matrix: sparse.csr_matrix

    @property
    def b(self) -> np.ndarray:
        """The right side at the unknown cells."""
        return self.rhs[self.system.unknown]

    def residual(self, x: np.ndarray) -> float:
        """|b - A x| / |b|."""
        return float(np.sqrt(np.square(self.b - self.matrix @ x).sum() / np.square(self.b).sum()))


@dataclass(frozen=True)
class Result:
    """One line of the table; times in s."""

    solver: str
    threads: int
    setup: float
    total: float
    iterations: int
    residual: float


def domains() -> Any:
    """The test module that defines them."""
    path = ROOT / "tests" / "numerics" / "test_multigrid.py"
    spec = importlib.util.spec_from_file_location("multigrid_domains", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def matrix_of(system: PoissonSystem) -> sparse.csr_matrix:
    """A over the unknown cells."""
    index = np.full(system.unknown.shape, -1)
    index[system.unknown] = np.arange(np.count_nonzero(system.unknown))
    rows, columns, values = [], [], []
    for axis, w in enumerate(system.weights):
        low, high = np.moveaxis(index, axis, 0)[:-1], np.moveaxis(index, axis, 0)[1:]
        face = np.moveaxis(w, axis, 0)[1:-1].astype(np.float64)
        joined = (low >= 0) & (high >= 0) & (face > 0)
        rows += [low[joined], high[joined]]
        columns += [high[joined], low[joined]]
        values += [-face[joined] / system.spacing**2] * 2
    n = int(index.max()) + 1
    off = sparse.coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n))
    return (off + sparse.diags(system.diagonal()[system.unknown])).tocsr()


def median(run: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Median time (s) of warm runs, and what the last gave; one run where that is slow."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        out = run()
        times.append(time.perf_counter() - begin)
        if times[0] > SLOW:
            break
    return float(np.median(times)), out


def ours(problem: Problem, repeats: int, threads: int) -> Iterator[Result]:
    """The solver of `numerics.poisson`."""
    numba.set_num_threads(threads)
    system, rhs = problem.system, problem.rhs

    def setup() -> None:
        box = multigrid.bounding_box(system.unknown)
        assert box is not None
        multigrid.assemble(system.unknown, system.weights, box)

    solve(system, rhs)  # compiles
    setup_time, _ = median(setup, repeats)
    total, (p, report) = median(lambda: solve(system, rhs, tolerance=TOLERANCE), repeats)
    true = problem.residual(p[system.unknown])
    yield Result("ours", threads, setup_time, total, report.iterations, true)
    noise = np.random.default_rng(0).normal(size=rhs.shape) * system.unknown
    other = rhs + 0.1 * noise * np.sqrt(np.square(rhs).sum() / np.square(noise).sum())
    guess, _ = solve(system, other, tolerance=TOLERANCE)
    total, (p, report) = median(lambda: solve(system, rhs, tolerance=TOLERANCE, initial=guess), repeats)
    yield Result(
        "ours from a guess", threads, setup_time, total, report.iterations, problem.residual(p[system.unknown])
    )


def _conjugate_gradients(
    problem: Problem, repeats: int, name: str, setup: Callable[[], linalg.LinearOperator | None]
) -> Result:
    setup_time, preconditioner = median(setup, repeats)
    iterations = 0

    def count(_: np.ndarray) -> None:
        nonlocal iterations
        iterations += 1

    def run() -> np.ndarray:
        nonlocal iterations
        iterations = 0
        x, _ = linalg.cg(
            problem.matrix, problem.b, rtol=TOLERANCE, atol=0.0, maxiter=MOST_ITERATIONS, M=preconditioner,
            callback=count,
        )  # fmt: skip
        return x

    time_of_run, x = median(run, repeats)
    return Result(name, 1, setup_time, setup_time + time_of_run, iterations, problem.residual(x))


def scipy_peers(problem: Problem, repeats: int, ilu_cells: int) -> Iterator[Result]:
    """Conjugate gradients of SciPy, which have one thread."""
    a = problem.matrix
    yield _conjugate_gradients(problem, repeats, "SciPy CG", lambda: None)
    inverse = 1.0 / a.diagonal()
    jacobi = linalg.LinearOperator(a.shape, lambda v: inverse * v)
    yield _conjugate_gradients(problem, repeats, "SciPy CG, Jacobi", lambda: jacobi)
    if len(inverse) > ilu_cells:
        print(f"not run: SciPy CG with ILU on {len(inverse)} cells (--ilu-cells)", file=sys.stderr)
        return

    def factorise() -> linalg.LinearOperator:
        # natural order without pivots: of what was tried, this alone keeps it near enough to symmetric
        factors = linalg.spilu(
            a.tocsc(), drop_tol=1e-2, fill_factor=5, permc_spec="NATURAL", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )  # fmt: skip
        return linalg.LinearOperator(a.shape, factors.solve)

    yield _conjugate_gradients(problem, repeats, "SciPy CG, ILU", factorise)


def pyamg_peers(problem: Problem, repeats: int) -> Iterator[Result]:
    """Conjugate gradients preconditioned by algebraic multigrid."""
    import pyamg  # pyright: ignore[reportMissingImports]

    for name, build in (
        ("PyAMG Ruge-Stuben", pyamg.ruge_stuben_solver),
        ("PyAMG smoothed aggregation", pyamg.smoothed_aggregation_solver),
    ):

        def setup(build: Callable[..., Any] = build) -> linalg.LinearOperator:
            return build(problem.matrix).aspreconditioner()

        yield _conjugate_gradients(problem, repeats, name, setup)


def results_of(problem: Problem, options: argparse.Namespace) -> Iterator[Result]:
    """All solvers that were asked for and are there."""
    if "ours" in options.peers:
        for threads in options.threads:
            yield from ours(problem, options.repeats, threads)
    if "scipy" in options.peers:
        yield from scipy_peers(problem, options.repeats, options.ilu_cells)
    if "pyamg" in options.peers and importlib.util.find_spec("pyamg"):
        yield from pyamg_peers(problem, options.repeats)


def main() -> int:
    """Run and print."""
    module = domains()
    names = [d.__name__ for d in module.DOMAINS if d is not module.two_closed_chambers]  # that one is singular
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128], help="cells along each side of the box")
    parser.add_argument("--repeats", type=int, default=5, help="warm runs of which the median is taken")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="threads of ours")
    parser.add_argument("--domains", nargs="+", choices=names, default=names)
    parser.add_argument("--peers", nargs="+", choices=["ours", "scipy", "pyamg"], default=["ours", "scipy", "pyamg"])
    parser.add_argument("--ilu-cells", type=int, default=200000, help="largest system that is factorised by ILU")
    options = parser.parse_args()
    options.threads = [n for n in options.threads if n <= numba.config.NUMBA_NUM_THREADS]
    if "pyamg" in options.peers and not importlib.util.find_spec("pyamg"):
        print("missing: pyamg (pip install pyamg)", file=sys.stderr)
    print("| domain | grid | cells | solver | threads | set-up | total | iterations | true residual |")
    print("|---|---|---|---|---|---|---|---|---|")
    for size in options.sizes:
        for name in options.domains:
            system = module.system_of(getattr(module, name), size)
            problem = Problem(name, system, module.falling(system), matrix_of(system))
            for r in results_of(problem, options):
                print(
                    f"| {name.replace('_', ' ')} | {size}^3 | {len(problem.b)} | {r.solver} | {r.threads} "
                    f"| {1e3 * r.setup:.1f} | {1e3 * r.total:.1f} | {r.iterations} | {r.residual:.1e} |",
                    flush=True,
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())
