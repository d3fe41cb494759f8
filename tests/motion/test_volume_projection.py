"""Projections: the weighted one, the plain one, and the paper's own iteration."""

from __future__ import annotations

import numpy as np
import pytest
from channels import channel

from fluidlift.motion.volume_projection import (
    agreed_limits,
    balance_surface,
    constraint_projection,
    continue_through_ends,
    end_faces,
    face_mobility,
    faces_from_centers,
    flux_through,
    mouths_of,
    outward_openings,
    passed_through,
    weighted_projection,
)
from fluidlift.physics.pressure import build_system, divergence, project
from fluidlift.types import CellType, FaceVelocity, Grid


def test_faces_take_the_fluid_side_at_the_rim() -> None:
    carrying = np.zeros((3, 1, 1), bool)
    carrying[:2] = True
    centers = np.zeros((3, 1, 1, 3), np.float32)
    centers[:, 0, 0, 0] = [1.0, 3.0, 99.0]
    assert faces_from_centers(centers, carrying).u[:, 0, 0].tolist() == [1.0, 2.0, 3.0, 0.0]


def random_velocity(grid: Grid, seed: int = 0) -> FaceVelocity:
    rng = np.random.default_rng(seed)
    return FaceVelocity(*(rng.standard_normal(grid.face_shape(a)).astype(np.float32) for a in range(3)))


def test_the_papers_constraint_iteration_converges_to_the_poisson_solution() -> None:
    types, grid = channel(8, 6, 6, 4)
    system = build_system(types, None, grid)
    v = random_velocity(grid)
    exact, _, report = project(v, system, tolerance=1e-7)
    assert report.converged
    errors = []
    for iterations in (10, 100, 1000):
        plain = constraint_projection(v, system, iterations=iterations, epsilon=0.05)
        open_faces = [o > 0 for o in system.openings]
        gaps = [np.abs(a - b)[o] for a, b, o in zip(plain.components, exact.components, open_faces)]
        errors.append(max(float(g.max()) for g in gaps))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-3  # Jacobi: the slowest mode of this box loses 2 % a sweep
    assert np.abs(divergence(plain, grid, system)).max() < 1e-2


def test_the_relaxation_keeps_a_closed_box_stable() -> None:
    grid = Grid((6, 6, 6), 0.1)
    system = build_system(np.full(grid.shape, CellType.FLUID, np.uint8), None, grid)
    v = random_velocity(grid, 2)
    damped = constraint_projection(v, system, iterations=400, epsilon=0.1)
    stuck = constraint_projection(v, system, iterations=400, epsilon=0.0)
    start = np.abs(divergence(v, grid, system)).max()
    assert np.abs(divergence(damped, grid, system)).max() < 1e-3 * start
    assert np.abs(divergence(stuck, grid, system)).max() > np.abs(divergence(damped, grid, system)).max()


def test_equal_mobility_is_the_plain_projection_and_none_keeps_the_face() -> None:
    types, grid = channel(8, 6, 6, 4)
    system = build_system(types, None, grid)
    v = random_velocity(grid, 1)
    one = tuple(np.ones(grid.face_shape(a), np.float32) for a in range(3))
    same, _ = weighted_projection(v, system, one, tolerance=1e-6)
    plain, _, _ = project(v, system, tolerance=1e-6)
    for a, b in zip(same.components, plain.components):
        assert np.abs(a - b).max() < 1e-4
    held = tuple(m.copy() for m in one)
    held[0][4, 3, 3] = 0.0
    out, report = weighted_projection(v, system, held, tolerance=1e-6)
    assert report.converged and out.u[4, 3, 3] == v.u[4, 3, 3]
    assert np.abs(divergence(out, grid, system)).max() < 1e-3 * np.abs(divergence(v, grid, system)).max()


def test_the_weighted_projection_is_the_least_squares_solution() -> None:
    # plain twin: minimise sum m |d|^2 with C (v + d) = 0 on the faces that may move, by the normal equations
    types, grid = channel(5, 3, 4, 2)
    system = build_system(np.where(types == CellType.INFLOW, CellType.OUTFLOW, types), None, grid)
    v = random_velocity(grid, 3)
    rng = np.random.default_rng(4)
    mobility = tuple(rng.uniform(0.01, 1.0, grid.face_shape(a)).astype(np.float32) for a in range(3))
    found, report = weighted_projection(v, system, mobility, tolerance=1e-8)
    assert report.converged
    cells = np.argwhere(system.unknown)
    free = [np.argwhere(w > 0) for w in system.weights]
    column = {(a, *f): k for k, (a, f) in enumerate((a, tuple(f)) for a in range(3) for f in free[a])}
    rows, start = np.zeros((len(cells), len(column))), np.zeros(len(cells))
    for row, cell in enumerate(cells):
        for a in range(3):
            for side in (0, 1):
                face = cell.copy()
                face[a] += side
                sign = 2 * side - 1
                start[row] += sign * v.components[a][tuple(face)] * system.openings[a][tuple(face)]
                if (a, *face) in column:
                    rows[row, column[(a, *face)]] = sign
    inverse = np.concatenate([mobility[a][tuple(free[a].T)] for a in range(3)]).astype(float)
    change = inverse * (rows.T @ np.linalg.solve(rows * inverse @ rows.T, -start))
    for a in range(3):
        at = tuple(free[a].T)
        wanted = v.components[a][at] + change[[column[(a, *f)] for f in map(tuple, free[a])]]
        assert np.abs(found.components[a][at] - wanted).max() < 1e-5  # float32 faces


def test_what_was_observed_resists_most_and_the_surface_as_told() -> None:
    types, grid = channel(6, 3, 6, 3)
    seen = np.zeros(grid.shape, bool)
    seen[:, :, 3] = True
    confidence = np.zeros(grid.shape, np.float32)
    confidence[:3] = 1.0
    leak = np.full(grid.shape, 0.01, np.float32)
    leak[4:] = 0.5
    u, _, w = face_mobility(types, seen, confidence, leak)
    observed, below, filled, made_up = u[2, 1, 3], u[2, 1, 2], u[5, 1, 3], u[5, 1, 2]
    assert observed < below < filled < made_up == pytest.approx(1.0)
    # 0.1 against 0.5 of the speed
    assert filled / observed == pytest.approx(25.0, rel=1e-4)
    assert w[2, 1, 4] == pytest.approx(0.01 * below, rel=1e-4) and w[4, 1, 4] == pytest.approx(0.5, rel=1e-4)


def test_only_bodies_with_two_wide_ends_are_passed_through() -> None:
    types, grid = channel(16, 12, 8, 4)
    types[:, 5:7] = CellType.SOLID  # two channels side by side
    types[-1, 7:] = CellType.SOLID  # the second has no outlet
    inside = passed_through(types, build_system(types, None, grid).openings)
    fluid = types == CellType.FLUID
    assert (inside[:, :5] == fluid[:, :5]).all() and not inside[:, 5:].any()  # 1 in the one, 0 in the other
    types[0, :5] = CellType.SOLID
    types[0, 2, 1] = CellType.INFLOW  # one face of twenty
    assert not passed_through(types, build_system(types, None, grid).openings).any()
    types[0, :5, 1] = CellType.INFLOW
    types[0, 0, 2] = CellType.INFLOW
    types[0, 1, 2] = CellType.INFLOW  # seven of twenty
    half = passed_through(types, build_system(types, None, grid).openings)[:, :5]
    assert half[fluid[:, :5]] == pytest.approx((7 / 20 - 0.25) / 0.25)


def staircase(steps: int = 4, run: int = 3) -> tuple[np.ndarray, Grid, np.ndarray]:
    """A surface that falls by one cell in every `run`, and the heights of its columns."""
    grid = Grid((steps * run, 4, steps + 4), 0.1)
    height = steps + 2 - np.arange(steps * run) // run
    types = np.full(grid.shape, CellType.EMPTY, np.uint8)
    for i, n in enumerate(height):
        types[i, :, :n] = CellType.FLUID
    return types, grid, height


def surface_flux(v: FaceVelocity, types: np.ndarray, grid: Grid) -> float:
    """m^3/s out of the fluid into air."""
    fluid, air = types == CellType.FLUID, types == CellType.EMPTY
    total = 0.0
    for axis, c in enumerate(v.components):
        f, e = np.moveaxis(fluid, axis, 0), np.moveaxis(air, axis, 0)
        inner = np.moveaxis(c, axis, 0)[1:-1]
        total += float((inner * (f[:-1] & e[1:]) - inner * (e[:-1] & f[1:])).sum())
    return total * grid.spacing**2


def test_balance_leaves_no_net_flux_and_keeps_flow_along_a_surface() -> None:
    types, grid, _ = staircase()
    fluid = types == CellType.FLUID
    openings = build_system(types, None, grid).openings
    along = np.zeros((*grid.shape, 3), np.float32)
    along[..., 0], along[..., 2] = 0.9, -0.3  # parallel to the mean slope of 1 in 3
    v = faces_from_centers(along, fluid)
    kept = balance_surface(v, types, openings)
    # the last step is cut off by the end of the box, hence not 0
    assert np.sqrt(np.mean((kept.w - v.w)[v.w != 0] ** 2)) < 0.1
    noisy = FaceVelocity(*(c + n for c, n in zip(v.components, random_velocity(grid, 5).components)))
    before = surface_flux(noisy, types, grid)
    after = surface_flux(balance_surface(noisy, types, openings), types, grid)
    assert abs(after) < 1e-5 * abs(before) + 1e-6  # float32 sums
    same = balance_surface(noisy, types, openings)
    inner = fluid[1:] & fluid[:-1]
    assert (same.u[1:-1][inner] == noisy.u[1:-1][inner]).all()  # only faces towards air change


def test_ends_take_what_flows_beside_them() -> None:
    types, grid = channel(8, 3, 5, 2)
    v = FaceVelocity(*(np.zeros(grid.face_shape(a), np.float32) for a in range(3)))
    v.u[1:-1, :, 1] = 2.0
    v.u[1:-1, :, 2] = 3.0
    out = continue_through_ends(v, end_faces(types))
    assert (out.u[[0, -1], :, 1] == 2.0).all() and (out.u[[0, -1], :, 2] == 3.0).all()
    assert (out.u[1:-1] == v.u[1:-1]).all() and (out.w[:, :, 0] == 0).all()


def test_fluxes_out_of_the_fluid_count_positive_at_both_ends() -> None:
    types, grid = channel(10, 3, 5, 2)
    system = build_system(types, None, grid)
    v = FaceVelocity(*(np.zeros(grid.face_shape(a), np.float32) for a in range(3)))
    v.u[...] = 2.0
    inlet, outlet = mouths_of(types, system, reach=0.2)
    assert inlet.area == outlet.area == 6.0
    assert flux_through(v, inlet.outward) == -12.0 and flux_through(v, outlet.outward) == 12.0
    assert inlet.near[:3, :, 1:3].all() and not inlet.near[3:].any()  # two cells on, at the height of the fluid
    assert outlet.near[7:, :, 1:3].all() and not outlet.near[:7].any()
    assert flux_through(v, outward_openings(types, CellType.EMPTY, system.openings)) == 0.0  # along the surface


def test_two_ends_that_disagree_meet_at_the_geometric_mean() -> None:
    types, grid = channel()
    system = build_system(types, None, grid)
    mouths = mouths_of(types, system, 0.2)
    v = FaceVelocity.zeros(grid)
    v.u[:] = 1.0
    carried = mouths[0].area
    assert agreed_limits(v, mouths, [2 * carried, 3 * carried]) == [2 * carried, 3 * carried]
    limits = agreed_limits(v, mouths, [2 * carried, 0.25 * carried])
    assert limits == pytest.approx([0.5 * carried, 0.25 * carried])
