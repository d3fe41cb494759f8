"""The grid side in Warp (here on its CPU device)."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.linalg import spsolve

pytest.importorskip("warp")

from fluidlift.backends.warp_grid import WarpPoissonSolver

H = 0.07


def vessel(shape, seed, *, lid=False):
    """Liquid round a ball in a closed box, partly open faces; with a lid there is no air. One connected body."""
    rng = np.random.default_rng(seed)
    x, y, z = np.meshgrid(*[(np.arange(n) + 0.5) / n for n in shape], indexing="ij")
    solid = (x - 0.5) ** 2 + (y - 0.4) ** 2 + (z - 0.3) ** 2 < 0.04
    unknown = ~solid if lid else ~solid & (z < 0.7)
    weights = []
    for axis in range(3):
        faces = tuple(n + (a == axis) for a, n in enumerate(shape))
        w = rng.uniform(0.2, 1.0, faces).astype(np.float32)
        along, inside = np.moveaxis(w, axis, 0), np.moveaxis(solid, axis, 0)
        along[0] = along[-1] = 0.0
        along[1:][inside] = 0.0
        along[:-1][inside] = 0.0
        weights.append(w)
    rhs = np.where(unknown, rng.normal(size=shape), 0.0)
    if lid:  # no air anywhere: only a mean of zero can be met
        rhs[unknown] -= rhs[unknown].mean()
    return unknown, tuple(weights), rhs


def matrix(unknown, weights) -> csr_matrix:
    """A = -div(w grad .) of the unknown cells in their order, in double precision."""
    number = np.full(tuple(n + 2 for n in unknown.shape), -1)
    inner = (slice(1, -1),) * 3
    number[inner][unknown] = np.arange(unknown.sum())
    rows, columns, entries = [], [], []
    for axis, w in enumerate(weights):
        w = np.moveaxis(w.astype(np.float64), axis, 0) / H**2
        inner = [slice(1, -1)] * 3
        inner[axis] = slice(None)
        cells = np.moveaxis(number[tuple(inner)], axis, 0)
        low, high = cells[:-1], cells[1:]
        for here, there in ((low, high), (high, low)):
            own, both = here >= 0, (here >= 0) & (there >= 0)
            rows += [here[own], here[both]]
            columns += [here[own], there[both]]
            entries += [w[own], -w[both]]
    n = int(unknown.sum())
    return coo_matrix((np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n)).tocsr()


@pytest.mark.parametrize("lid", [False, True], ids=["free surface", "closed"])
@pytest.mark.parametrize(("shape", "seed"), [((16, 16, 16), 0), ((21, 13, 9), 1), ((5, 30, 6), 2)])
def test_the_pressure_is_that_of_a_direct_solve(shape, seed, lid):
    unknown, weights, rhs = vessel(shape, seed, lid=lid)
    start = np.where(unknown, np.random.default_rng(seed).normal(size=shape), 0.0)
    p, iterations, residual = WarpPoissonSolver("cpu").solve(
        unknown, weights, H, rhs, initial=start, tolerance=1e-8, max_iterations=60
    )
    assert residual <= 1e-8 and iterations <= 15  # a factor of 4 per iteration, whatever the grid
    assert (p[~unknown] == 0).all()
    a, b, x = matrix(unknown, weights), rhs[unknown], p[unknown]
    # the entries of the solver's matrix are rounded to single precision
    rounding = 2.0**-23 * np.sqrt(np.square(a.diagonal() * x).sum())
    assert np.sqrt(np.square(a @ x - b).sum()) <= 1e-8 * np.sqrt(np.square(b).sum()) + rounding
    if lid:  # a free constant: the first pressure is held
        truth = np.concatenate([[0.0], spsolve(a[1:, 1:].tocsc(), b[1:])])
        x, truth = x - x.mean(), truth - truth.mean()
    else:
        truth = spsolve(a.tocsc(), b)
    # rounding of the entries times a condition number of a few hundred
    np.testing.assert_allclose(x, truth, atol=2.0**-23 * 400 * np.abs(truth).max())


def test_few_iterations_suffice_on_a_larger_grid():
    unknown, weights, rhs = vessel((48, 40, 44), 3)
    _, iterations, residual = WarpPoissonSolver("cpu").solve(
        unknown, weights, H, rhs, initial=np.zeros_like(rhs), tolerance=1e-6, max_iterations=100
    )
    # the smoother alone takes 76
    assert residual <= 1e-6 and iterations <= 14


def test_the_limit_of_iterations_is_kept_and_the_residual_is_true():
    unknown, weights, rhs = vessel((16, 16, 16), 0)
    p, iterations, residual = WarpPoissonSolver("cpu").solve(
        unknown, weights, H, rhs, initial=0 * rhs, tolerance=1e-12, max_iterations=2
    )
    true = np.sqrt(np.square(rhs[unknown] - matrix(unknown, weights) @ p[unknown]).sum() / np.square(rhs).sum())
    # the matrices differ by roundings, far below a residual of this size
    assert iterations == 2 and residual == pytest.approx(true, rel=1e-3) and residual > 1e-6


def test_nothing_unknown_and_nothing_wanted_is_nothing():
    unknown, weights, rhs = vessel((6, 5, 7), 0)
    solver = WarpPoissonSolver("cpu")
    for cells, wanted in ((np.zeros_like(unknown), rhs), (unknown, 0 * rhs)):
        p, iterations, residual = solver.solve(
            cells, weights, H, wanted, initial=0 * rhs, tolerance=1e-6, max_iterations=9
        )
        assert (p == 0).all() and iterations == 0 and residual == 0.0
