"""The Poisson equation on irregular domains."""

import numpy as np
import pytest

from fluidlift.numerics.poisson import PoissonSystem, label_components, solve

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
