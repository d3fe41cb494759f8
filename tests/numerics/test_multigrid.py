"""The multigrid solver: kernels against plain NumPy, symmetry, iteration counts, threads."""

import numpy as np
import pytest
from boxes import closed_box
from numba import config, get_num_threads, set_num_threads

from fluidlift.numerics import multigrid, multigrid_cycle
from fluidlift.numerics.components import closed_components
from fluidlift.numerics.multigrid_kernels import PARTS, PLANES
from fluidlift.numerics.multigrid_plain import plain_levels, plain_v_cycle
from fluidlift.numerics.poisson import PoissonSystem, label_components, solve


def open_shares(n, solid_distance):
    """Shares of the faces of the unit box outside a solid, from its signed distance at the face centres."""
    weights = closed_box((n, n, n))
    for axis, w in enumerate(weights):
        points = [(np.arange(n) + 0.5) / n] * 3
        points[axis] = np.arange(n + 1) / n
        share = np.clip(solid_distance(*np.meshgrid(*points, indexing="ij", sparse=True)) * n + 0.5, 0.0, 1.0)
        w *= np.where(share < 0.02, 0.0, share).astype(np.float32)
    return weights


def box_with_air(n):
    unknown = np.ones((n, n, n), bool)
    unknown[:, :, int(0.9 * n) :] = False
    return unknown, closed_box((n, n, n))


def pool_round_spheres(n):
    def solid(x, y, z):
        spheres = [(0.3, 0.3, 0.25, 0.17), (0.7, 0.6, 0.3, 0.2), (0.4, 0.8, 0.5, 0.15)]
        return np.minimum.reduce([np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) - r for a, b, c, r in spheres])

    x, y, z = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 3, indexing="ij", sparse=True)
    return z < 0.62 + 0.05 * np.sin(7 * x) * np.cos(9 * y), open_shares(n, solid)


def thin_river(n):
    """A sheet of 2 to 4 cells on a sloping bed, in a box that is mostly empty."""

    def bed(x, y):
        return 0.5 - 0.3 * x + 0.05 * np.sin(10 * x) * np.cos(6 * y) + (y - 0.5 - 0.15 * np.sin(5 * x)) ** 2

    x, y, z = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 3, indexing="ij", sparse=True)
    depth = (3 + np.sin(20 * x) * np.cos(17 * y)) / n
    wet = (z > bed(x, y) - 1 / n) & (z < bed(x, y) + depth) & (np.abs(y - 0.5 - 0.15 * np.sin(5 * x)) < 0.3)
    return wet, open_shares(n, lambda x, y, z: 0.9 * (z - bed(x, y)))


def sparse_spray(n):
    rng = np.random.default_rng(1)
    unknown = rng.uniform(size=(n, n, n)) < 0.03
    corners = rng.integers(2, n - 3, (n**3 // 400, 3))
    for shift in np.ndindex(2, 2, 2):
        unknown[tuple((corners + shift).T)] = True
    unknown[:, :, : n // 10] = True
    return unknown, closed_box((n, n, n))


def two_closed_chambers(n):
    """A box without air, cut in two by a thin wall, one half with a sphere in it."""
    weights = open_shares(n, lambda x, y, z: np.sqrt((x - 0.25) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.2)
    weights[0][n // 2] = 0.0
    return np.ones((n, n, n), bool), weights


DOMAINS = [box_with_air, pool_round_spheres, thin_river, sparse_spray, two_closed_chambers]


def system_of(domain, n):
    unknown, weights = domain(n)
    system = PoissonSystem(unknown, *weights, 1.0 / n)
    return PoissonSystem(unknown & (system.diagonal() > 0), *weights, 1.0 / n)


def falling(system):
    """The right side of a liquid that has fallen freely and streams sideways: smooth, the hardest kind."""
    x = np.sin(3 * np.arange(system.unknown.shape[0] + 1) * system.spacing)
    flux_x, flux_z = system.weight_x * x[:, None, None], -system.weight_z
    return np.where(system.unknown, -(np.diff(flux_x, axis=0) + np.diff(flux_z, axis=2)) / system.spacing, 0.0)


def cropped(system):
    """The unknown cells and their faces in their bounding box."""
    cut = []
    for axis in range(3):
        some = np.flatnonzero(system.unknown.any(axis=tuple(a for a in range(3) if a != axis)))
        cut.append(slice(some[0], some[-1] + 1))
    weights = []
    for axis, w in enumerate(system.weights):
        faces = list(cut)
        faces[axis] = slice(cut[axis].start, cut[axis].stop + 1)
        weights.append(np.ascontiguousarray(w[tuple(faces)]))
    return np.ascontiguousarray(system.unknown[tuple(cut)]), tuple(weights)


def cycle_of(unknown, weights, rhs, **options):
    levels = multigrid.build_levels(unknown, weights, 1.0, **options)
    levels[0].rhs[1:-1, 1:-1, 1:-1] = rhs
    multigrid.v_cycle(levels)
    return levels[0].x[1:-1, 1:-1, 1:-1].astype(np.float64)


@pytest.mark.parametrize("n", [9, 16])
@pytest.mark.parametrize("domain", DOMAINS)
def test_the_kernels_do_what_the_plain_v_cycle_does(domain, n):
    unknown, weights = cropped(system_of(domain, n))
    rhs = np.where(unknown, np.random.default_rng(0).normal(size=unknown.shape), 0.0)
    fast = cycle_of(unknown, weights, rhs)
    plain = plain_v_cycle(plain_levels(unknown, weights), rhs)
    # single precision, 6e-8, over some 100 half sweeps on all grids
    assert np.abs(fast - plain).max() < 5e-6 * np.abs(plain).max()


def test_a_box_of_one_cell_and_thin_boxes_are_cycled_as_plainly():
    rng = np.random.default_rng(0)
    for shape in [(1, 1, 1), (1, 7, 1), (30, 1, 1), (1, 1, 12), (17, 20, 1), (2, 9, 33)]:
        weights = tuple(
            rng.uniform(0.1, 1.0, tuple(n + (a == axis) for a, n in enumerate(shape))).astype(np.float32)
            for axis in range(3)
        )
        unknown, rhs = np.ones(shape, bool), rng.normal(size=shape)
        plain = plain_v_cycle(plain_levels(unknown, weights), rhs)
        np.testing.assert_allclose(cycle_of(unknown, weights, rhs), plain, atol=5e-6 * np.abs(plain).max())


@pytest.mark.parametrize("domain", DOMAINS)
def test_the_cycle_is_symmetric_and_positive(domain):
    unknown, weights = cropped(system_of(domain, 14))
    rng = np.random.default_rng(1)
    a, b = (np.where(unknown, rng.normal(size=unknown.shape), 0.0) for _ in range(2))
    from_a, from_b = cycle_of(unknown, weights, a), cycle_of(unknown, weights, b)
    scale = np.sqrt((a * from_a).sum() * (b * from_b).sum())
    assert (a * from_a).sum() > 0 and (b * from_b).sum() > 0
    assert (a * from_b).sum() == pytest.approx((b * from_a).sum(), abs=1e-5 * scale)  # single precision


def test_a_cycle_solves_what_an_added_diagonal_dominates():
    unknown = np.ones((12, 10, 8), bool)
    weights = tuple(
        np.ones(tuple(n + (a == axis) for a, n in enumerate(unknown.shape)), np.float32) for axis in range(3)
    )
    rhs = np.random.default_rng(2).normal(size=unknown.shape)
    diagonal = np.full(unknown.shape, 1e4, np.float32)
    x = cycle_of(unknown, weights, rhs, added_diagonal=diagonal)
    # two sweeps and two more leave (6 / 1e4)^4 of the couplings' part: nothing; single precision remains
    system = PoissonSystem(unknown, *weights, 1.0)
    residual = rhs - diagonal * x - system.apply(x)
    assert np.abs(residual).max() < 1e-5 * np.abs(rhs).max()


@pytest.mark.parametrize("domain", DOMAINS)
def test_iterations_hardly_grow_with_the_grid(domain):
    counts = []
    for n in (24, 96):
        system = system_of(domain, n)
        _, report = solve(system, falling(system), tolerance=1e-5)
        assert report.converged
        counts.append(report.iterations)
    # measured on grids of 16 to 128 cells: 3 to 7 without a trend; conjugate gradients alone would need 4 times as many
    # on the large grid as on the small one, Jacobi 16 times
    assert counts[0] <= 8 and counts[1] <= counts[0] + 3


def test_the_number_of_threads_and_parts_does_not_change_a_bit(monkeypatch):
    system = system_of(pool_round_spheres, 56)
    rhs = falling(system)
    monkeypatch.setattr(multigrid, "SERIAL_CELLS", 1)  # even small levels are shared
    before, results = get_num_threads(), []
    try:
        for threads in range(1, min(config.NUMBA_NUM_THREADS, 3) + 1):
            set_num_threads(threads)
            results.append(solve(system, rhs)[0])
    finally:
        set_num_threads(before)
    for parts in (2, 4):
        monkeypatch.setattr(multigrid, "get_num_threads", lambda parts=parts: parts)
        monkeypatch.setattr(multigrid, "set_num_threads", lambda threads: None)
        results.append(solve(system, rhs)[0])
    for p in results[1:]:
        np.testing.assert_array_equal(p, results[0])


def test_parts_of_the_fewest_planes_still_fit_together(monkeypatch):
    monkeypatch.setattr(multigrid, "SERIAL_CELLS", 1)
    unknown, weights = cropped(system_of(pool_round_spheres, 40))
    rhs = np.where(unknown, np.random.default_rng(0).normal(size=unknown.shape), 0.0)
    whole = cycle_of(unknown, weights, rhs)
    levels = multigrid.build_levels(unknown, weights, 1.0)
    geometry = levels[0].hierarchy.geometry
    geometry[0, PARTS] = (geometry[0, PLANES] - 2) // multigrid_cycle.LEAST_PLANES
    assert geometry[0, PARTS] >= 3
    levels[0].rhs[1:-1, 1:-1, 1:-1] = rhs
    multigrid.v_cycle(levels)
    np.testing.assert_array_equal(levels[0].x[1:-1, 1:-1, 1:-1], whole)


def test_where_the_domain_lies_in_the_grid_does_not_change_a_bit():
    system = system_of(thin_river, 24)
    rhs = falling(system)
    p, _ = solve(system, rhs)
    pad = (3, 2), (1, 6), (4, 5)
    weights = [np.pad(w, pad) for w in system.weights]
    far = PoissonSystem(np.pad(system.unknown, pad), *weights, system.spacing)
    moved, _ = solve(far, np.pad(rhs, pad))
    np.testing.assert_array_equal(moved[3:-2, 1:-6, 4:-5], p)


@pytest.mark.parametrize("seed", range(4))
def test_closed_components_are_those_of_the_plain_search(seed):
    rng = np.random.default_rng(seed)
    shape = (11, 9, 10)
    unknown = rng.uniform(size=shape) < 0.9
    weights = []
    for axis in range(3):
        w = (rng.uniform(size=tuple(n + (a == axis) for a, n in enumerate(shape))) < 0.55).astype(np.float32)
        solid = np.moveaxis(~unknown, axis, 0)
        faces = np.moveaxis(w, axis, 0)
        if seed < 3:  # walls all around the unknown cells but for some faces; seed 3: open wherever chance will
            keep = rng.uniform(size=faces[1:-1].shape) < 0.02
            faces[1:-1][(solid[1:] | solid[:-1]) & ~keep] = 0.0
            faces[[0, -1]] = 0.0
        weights.append(w)
    system = PoissonSystem(unknown, *weights, 1.0)
    labels, closed = label_components(system)
    several = np.bincount(labels[labels >= 0]) > 1
    expected = {frozenset(map(tuple, np.argwhere(labels == c))) for c in np.flatnonzero(closed & several)}
    known = ~np.pad(unknown, 1)
    beside = np.zeros(shape, bool)
    for axis, w in enumerate(weights):
        cell, out = np.moveaxis(known, axis, 0), np.moveaxis(beside, axis, 0)
        cell = cell[:, 1:-1, 1:-1]
        faces = np.moveaxis(w, axis, 0) > 0
        out |= (faces[:-1] & cell[:-2]) | (faces[1:] & cell[2:])
    found = closed_components(unknown, tuple(weights), beside & unknown)
    groups = [set() for _ in found.sizes]
    for (i, j, low, high), c in zip(found.runs, found.labels):
        groups[c] |= {(i, j, k) for k in range(low, high)}
    assert {frozenset(g) for g in groups} == expected
    assert [len(g) for g in groups] == found.sizes.tolist()
    assert seed == 3 or len(expected) > 1
