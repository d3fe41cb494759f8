"""The Poisson equation on irregular domains."""

import numpy as np
import pytest

from fluidlift.numerics.poisson import LowRankTerm, PoissonSystem, label_components, solve

METHODS = ["multigrid", "conjugate_gradient", "jacobi"]


def box_system(shape, spacing, *, unknown=None, border_open=False, seed=None):
    """All cells unknown unless said; random face fractions with a seed."""
    rng = np.random.default_rng(seed)
    unknown = np.ones(shape, bool) if unknown is None else unknown
    weights = []
    for axis in range(3):
        face_shape = tuple(n + (a == axis) for a, n in enumerate(shape))
        w = np.ones(face_shape, np.float32) if seed is None else rng.uniform(0.05, 1, face_shape).astype(np.float32)
        if not border_open:
            np.moveaxis(w, axis, 0)[[0, -1]] = 0.0
        weights.append(w)
    return PoissonSystem(unknown, *weights, spacing)


def irregular_system(seed=3, shape=(13, 10, 9)):
    rng = np.random.default_rng(seed)
    unknown = np.zeros(shape, bool)
    unknown[1:-1, 1:-1, : shape[2] // 2] = True
    unknown &= rng.uniform(size=shape) < 0.9
    return box_system(shape, 0.1, unknown=unknown, seed=seed)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_solves_an_irregular_domain_to_its_tolerance(method):
    system = irregular_system()
    rhs = np.where(system.unknown, np.random.default_rng(0).normal(size=system.unknown.shape), 0.0)
    p, report = solve(system, rhs, method=method, tolerance=1e-6, max_iterations=5000)
    assert report.converged and report.method == method
    labels, closed = label_components(system)
    inside = (labels >= 0) & ~closed[labels]
    residual = np.where(inside, rhs - system.apply(p), 0.0)
    assert np.linalg.norm(residual) <= 1.01e-6 * np.linalg.norm(rhs)  # 1 %: p and the norm differ in closed pockets


def test_the_methods_agree():
    system = irregular_system()
    rhs = np.where(system.unknown, np.random.default_rng(0).normal(size=system.unknown.shape), 0.0)
    first, *others = [solve(system, rhs, method=m, tolerance=1e-9, max_iterations=20000)[0] for m in METHODS]
    for p in others:
        # error <= condition number (some 1e3 here) times the residual of 1e-9
        assert np.abs(p - first).max() < 1e-5 * np.abs(first).max()


@pytest.mark.parametrize("method", METHODS)
def test_a_hydrostatic_column_has_linear_pressure(method):
    shape, h = (4, 4, 8), 0.25
    unknown = np.zeros(shape, bool)
    unknown[:, :, :6] = True
    system = box_system(shape, h, unknown=unknown)
    # gravity changes the velocity of all inner vertical faces by -g dt; at the bottom wall it stays 0
    rhs = np.zeros(shape)
    rhs[:, :, 0] = 1.0 / h
    p, report = solve(system, rhs, method=method, tolerance=1e-10, max_iterations=5000)
    assert report.converged
    depth = (6 - np.arange(6)) * h
    np.testing.assert_allclose(p[:, :, :6], np.broadcast_to(depth, (4, 4, 6)), rtol=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_closed_components_lose_their_mean_and_the_report_says_so(method):
    system = box_system((6, 5, 4), 1.0)
    rhs = np.random.default_rng(1).normal(size=(6, 5, 4)) + 3.0
    p, report = solve(system, rhs, method=method, tolerance=1e-8, max_iterations=5000)
    assert report.converged and "mean" in report.advice
    np.testing.assert_allclose(system.apply(p), rhs - rhs.mean(), atol=1e-6)
    assert abs(p.mean()) < 1e-12


def test_a_thin_wall_splits_components():
    system = box_system((4, 2, 2), 1.0)
    system.weight_x[2] = 0.0
    labels, closed = label_components(system)
    assert len(closed) == 2 and closed.all() and labels[0, 0, 0] != labels[3, 0, 0]


def test_the_operator_is_symmetric_and_positive():
    system = irregular_system()
    rng = np.random.default_rng(5)
    a, b = (np.where(system.unknown, rng.normal(size=system.unknown.shape), 0.0) for _ in range(2))
    assert np.vdot(a, system.apply(b)) == pytest.approx(np.vdot(b, system.apply(a)), rel=1e-10)
    assert np.vdot(a, system.apply(a)) > 0


def test_a_right_side_that_is_not_finite_is_reported_not_solved():
    system = box_system((3, 3, 3), 1.0, border_open=True)
    rhs = np.full((3, 3, 3), np.nan)
    p, report = solve(system, rhs)
    assert not report.converged and np.isfinite(p).all() and report.advice


def test_running_out_of_iterations_is_reported():
    system = irregular_system()
    rhs = system.unknown.astype(float)
    _, report = solve(system, rhs, method="jacobi", max_iterations=2, tolerance=1e-8)
    assert not report.converged and report.iterations == 2 and report.residual > 1e-8 and "iterations" in report.advice


def dense_operator(system, terms=()):
    """A as a matrix over the unknown cells, in their order."""
    cells = np.argwhere(system.unknown)
    columns = []
    for cell in cells:
        one = np.zeros(system.unknown.shape)
        one[tuple(cell)] = 1.0
        columns.append((system.apply(one) + sum(term.apply(one) for term in terms))[system.unknown])
    return np.array(columns).T


def ghost_weights(system, rng, least=0.02):
    """Faces to known cells with the surface at a random share of a cell: weights up to 50."""
    inside = np.pad(system.unknown, 1)
    weights = []
    for axis, w in enumerate(system.weights):
        cut = [slice(1, -1)] * 3
        cut[axis] = slice(None)
        cell = np.moveaxis(inside[tuple(cut)], axis, 0)
        surface = np.moveaxis(cell[1:] != cell[:-1], 0, axis)
        weights.append(np.where(surface, w / rng.uniform(least, 1.0, w.shape), w).astype(np.float32))
    return PoissonSystem(system.unknown, *weights, system.spacing)


def body_in(system, rng, *, cells=None, mass_ratio=1.0):
    """A body whose J is random at some unknown cells and whose force per pressure is that of a few open faces."""
    if cells is None:
        candidates = np.argwhere(system.unknown)
        cells = candidates[rng.choice(len(candidates), min(30, len(candidates) // 2), replace=False)]
    values = rng.normal(size=(len(cells), 6)) / system.spacing
    root = rng.normal(size=(6, 6))
    return LowRankTerm(cells, values, (root @ root.T + np.eye(6)) / (mass_ratio * len(cells)))


@pytest.mark.parametrize("method", METHODS)
def test_weights_beyond_one_at_the_surface_solve_like_the_dense_matrix(method):
    system = ghost_weights(irregular_system(), np.random.default_rng(7))
    assert max(w.max() for w in system.weights) > 20
    labels, closed = label_components(system)
    rhs = np.where((labels >= 0) & ~closed[labels], np.random.default_rng(8).normal(size=system.unknown.shape), 0.0)
    p, report = solve(system, rhs, method=method, tolerance=1e-8, max_iterations=20000)
    exact = np.linalg.lstsq(dense_operator(system), rhs[system.unknown], rcond=1e-10)[0]
    assert report.converged
    # error <= condition number, some 1e3, times the residual of 1e-8; the weights have 6e-8
    np.testing.assert_allclose(p[system.unknown], exact, atol=1e-4 * np.abs(exact).max())


def test_weights_beyond_one_cost_no_iterations():
    system = box_system((40, 40, 40), 1.0, unknown=np.arange(40) < np.full((40, 40, 1), 31))
    rhs = np.where(system.unknown, np.random.default_rng(0).normal(size=system.unknown.shape), 0.0)
    counts = [
        solve(s, rhs, tolerance=1e-6)[1].iterations for s in (system, ghost_weights(system, np.random.default_rng(1)))
    ]
    assert counts[1] <= counts[0] + 2  # measured 6 and 6


@pytest.mark.parametrize(
    ("method", "mass_ratio"),
    [(m, r) for m in METHODS for r in (0.01, 1.0, 100.0) if (m, r) != ("jacobi", 0.01)],  # there it crawls
)
def test_bodies_that_give_way_solve_like_the_dense_matrix(method, mass_ratio):
    rng = np.random.default_rng(11)
    system = irregular_system(shape=(9, 8, 7))
    terms = [body_in(system, rng, mass_ratio=mass_ratio) for _ in range(2)]
    labels, closed = label_components(system)
    grounded = (labels >= 0) & ~closed[labels]
    terms = [LowRankTerm(t.cells[grounded[tuple(t.cells.T)]], t.values[grounded[tuple(t.cells.T)]], t.inverse_mass)
             for t in terms]  # fmt: skip
    rhs = np.where(grounded, rng.normal(size=system.unknown.shape), 0.0)
    p, report = solve(system, rhs, method=method, tolerance=1e-7, max_iterations=100000, low_rank=terms)
    matrix = dense_operator(system, terms)
    exact = np.linalg.lstsq(matrix, rhs[system.unknown], rcond=1e-12)[0]
    assert report.converged
    remainder = rhs[system.unknown] - matrix @ p[system.unknown]
    assert np.sqrt((remainder**2).sum()) <= 1.01e-7 * np.sqrt((rhs**2).sum())
    # error <= |A^-1| residual; the smallest eigenvalues belong to the liquid alone, condition some 1e3 there
    np.testing.assert_allclose(p[system.unknown], exact, atol=2e-3 * np.abs(exact).max())


@pytest.mark.parametrize("mass_ratio", [0.01, 1.0, 100.0])
def test_each_body_costs_the_solver_only_a_few_iterations(mass_ratio):
    rng = np.random.default_rng(3)
    system = box_system((24, 24, 24), 1.0 / 24, unknown=np.arange(24) < np.full((24, 24, 1), 19))
    x, y, z = np.indices(system.unknown.shape)
    near = (x - 11.5) ** 2 + (y - 11.5) ** 2 + (z - 9.5) ** 2
    shell = np.argwhere((near < 25) & (near > 12))  # the cells around a ball
    arms = (shell - [11.5, 11.5, 9.5]) * system.spacing
    normals = arms / np.sqrt((arms**2).sum(axis=1))[:, None] * system.spacing**2
    values = np.concatenate([normals, np.cross(arms, normals)], axis=1) / system.spacing**3
    mass = mass_ratio * 4.2 * (4.5 * system.spacing) ** 3
    turning = 0.4 * mass * (4.5 * system.spacing) ** 2
    body = LowRankTerm(shell, values, np.diag([1 / mass] * 3 + [1 / turning] * 3) * system.spacing**3)
    rhs = np.where(system.unknown, rng.normal(size=system.unknown.shape), 0.0)
    _, alone = solve(system, rhs)
    _, with_body = solve(system, rhs, low_rank=[body])
    assert with_body.converged
    # six directions more: conjugate gradients need at most one iteration for each
    assert with_body.iterations <= alone.iterations + 6


def piston_between(shape=(12, 6, 6)):
    """A closed box, full of liquid, cut by a wall at the middle that a body moves along x."""
    system = box_system(shape, 0.5)
    middle = shape[0] // 2
    system.weight_x[middle] = 0.0
    j, k = (a.ravel() for a in np.indices(shape[1:]))
    left = np.stack([np.full_like(j, middle - 1), j, k], axis=1)
    right = np.stack([np.full_like(j, middle), j, k], axis=1)
    values = np.zeros((2 * len(left), 6))
    values[: len(left), 0], values[len(left) :, 0] = 1.0, -1.0
    inverse_mass = np.zeros((6, 6))
    inverse_mass[0, 0] = 0.3
    return system, LowRankTerm(np.concatenate([left, right]), values, inverse_mass)


@pytest.mark.parametrize("method", METHODS)
def test_a_piston_between_two_closed_chambers_leaves_one_constant_free(method):
    system, piston = piston_between()
    rhs = np.zeros(system.unknown.shape)
    rhs[2, 1, 3], rhs[9, 4, 2] = 1.0, -1.0  # the left chamber is pumped up, the right one emptied: the piston moves
    p, report = solve(system, rhs, method=method, tolerance=1e-9, max_iterations=200000, low_rank=[piston])
    assert report.converged and not report.advice  # nothing had to be removed
    np.testing.assert_allclose(system.apply(p) + piston.apply(p), rhs, atol=1e-8)
    assert abs(p.mean()) < 1e-10 and p[:6].mean() > 0 > p[6:].mean()
    # one liter pumped is one liter that the piston makes room for
    assert (rhs - piston.apply(p))[:6].sum() == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_a_piston_against_air_leaves_no_constant_free(method):
    system, piston = piston_between()
    one_sided = LowRankTerm(piston.cells[:36], piston.values[:36], piston.inverse_mass)
    rhs = np.where(np.indices(system.unknown.shape)[0] < 6, 1.0, 0.0)
    p, report = solve(system, rhs, method=method, tolerance=1e-9, max_iterations=200000, low_rank=[one_sided])
    assert report.converged and not report.advice
    np.testing.assert_allclose(system.apply(p) + one_sided.apply(p), rhs, atol=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_a_body_afloat_in_a_closed_box_leaves_its_constant_free(method):
    system = box_system((7, 7, 7), 1.0)
    cells, values = [], []
    for axis in range(3):
        for side in (-1, 1):  # a ball of one cell: pressure 1 around it pushes as much from each side
            cell, force = [3, 3, 3], np.zeros(6)
            cell[axis] += side
            force[axis] = -side
            cells.append(cell)
            values.append(force)
    body = LowRankTerm(np.array(cells), np.array(values), 5.0 * np.eye(6))
    rhs = np.random.default_rng(0).normal(size=(7, 7, 7)) + 1.0
    p, report = solve(system, rhs, method=method, tolerance=1e-9, max_iterations=200000, low_rank=[body])
    assert report.converged and "mean" in report.advice and abs(p.mean()) < 1e-10
    np.testing.assert_allclose(system.apply(p) + body.apply(p), rhs - rhs.mean(), atol=1e-7)


def test_a_first_guess_saves_iterations_and_a_solution_needs_none():
    system = irregular_system(shape=(20, 20, 20))
    rhs = np.where(system.unknown, np.random.default_rng(0).normal(size=system.unknown.shape), 0.0)
    p, cold = solve(system, rhs, tolerance=1e-8)
    _, warm = solve(system, 1.001 * rhs, tolerance=1e-8, initial=p)
    _, again = solve(system, rhs, tolerance=1.1e-8, initial=p.astype(np.float64))
    assert warm.converged and warm.iterations < cold.iterations and again.iterations == 0
    _, single = solve(system, 1.001 * rhs, tolerance=1e-5, initial=p.astype(np.float32))
    assert single.converged


def test_the_reported_residual_is_the_true_one():
    system = irregular_system(shape=(20, 20, 20))
    rhs = np.where(system.unknown, np.random.default_rng(0).normal(size=system.unknown.shape), 0.0)
    labels, closed = label_components(system)
    rhs = np.where((labels >= 0) & ~closed[labels], rhs, 0.0)
    for tolerance in (1e-2, 1e-5, 1e-10):
        p, report = solve(system, rhs, tolerance=tolerance)
        true = np.sqrt(((rhs - system.apply(p)) ** 2).sum() / (rhs**2).sum())
        assert report.residual <= tolerance
        # h^2 times the right side is solved for the weights: rounding in another order
        assert report.residual == pytest.approx(true, rel=1e-6, abs=1e-13)


@pytest.mark.parametrize("method", METHODS)
def test_no_unknown_cell_and_a_right_side_of_zero_give_zero(method):
    empty = box_system((3, 4, 5), 1.0, unknown=np.zeros((3, 4, 5), bool))
    p, report = solve(empty, np.ones((3, 4, 5)), method=method)
    assert report.converged and not p.any()
    p, report = solve(box_system((3, 4, 5), 1.0), np.zeros((3, 4, 5), np.float32), method=method)
    assert report.converged and not p.any() and p.dtype == np.float32


def test_arguments_that_do_not_fit_are_refused():
    system = box_system((3, 4, 5), 1.0)
    with pytest.raises(ValueError, match="rhs"):
        solve(system, np.zeros((3, 4, 4)))
    with pytest.raises(ValueError, match="method"):
        solve(system, np.zeros((3, 4, 5)), method="gauss")
    with pytest.raises(ValueError, match="outside the grid"):
        solve(system, np.zeros((3, 4, 5)), low_rank=[LowRankTerm(np.array([[3, 0, 0]]), np.ones((1, 6)), np.eye(6))])
    with pytest.raises(ValueError, match="values"):
        LowRankTerm(np.zeros((2, 3), int), np.ones((1, 6)), np.eye(6))
