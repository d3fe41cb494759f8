"""The volume velocity on channels and boxes that can be written down."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.motion.volume import (
    constraint_projection,
    faces_from_centers,
    harmonic_extension,
    splat_surface,
    target_sequence,
    volume_velocity,
    weighted_projection,
)
from fluidlift.physics.pressure import build_system, divergence, project
from fluidlift.types import CellType, FaceVelocity, Grid, PinholeCamera, PixelFlow, SurfaceMotion


def channel(nx: int = 20, ny: int = 8, nz: int = 8, depth: int = 5) -> tuple[np.ndarray, Grid]:
    """A straight channel along x: solid below, air above, in- and outflow at its ends, walls at its sides."""
    grid = Grid((nx, ny, nz), 0.1)
    types = np.full(grid.shape, CellType.EMPTY, np.uint8)
    types[:, :, 0] = CellType.SOLID
    types[:, :, 1 : depth + 1] = CellType.FLUID
    types[0, :, 1 : depth + 1] = CellType.INFLOW
    types[-1, :, 1 : depth + 1] = CellType.OUTFLOW
    return types, grid


def surface_of(grid: Grid, height: float, velocity: list[float], seen: float = 1.0) -> SurfaceMotion:
    """Samples of the surface z = height, four per cell, over a share of the channel's length."""
    high = grid.high
    x, y = np.meshgrid(np.arange(0.025, seen * high[0], 0.05), np.arange(0.025, high[1], 0.05), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=-1)
    return SurfaceMotion(points, np.tile(velocity, (len(points), 1)), np.ones(len(points), bool))


def test_uniform_flow_through_a_channel_without_drag_is_uniform_everywhere() -> None:
    types, grid = channel()
    v, report = volume_velocity(surface_of(grid, 0.59, [0.8, 0, 0]), None, types, grid, kind="plume")
    fluid = types == CellType.FLUID
    assert np.abs(v.at_centers()[fluid] - [0.8, 0, 0]).max() < 1e-3
    assert report.solve.converged and report.divergence_max < 1e-3
    # 0.8 m/s through 5 x 8 cells of 0.01 m^2
    assert report.flux_in == pytest.approx(0.32, rel=1e-3) and report.flux_out == pytest.approx(0.32, rel=1e-3)
    assert abs(report.flux_surface) < 1e-3


def test_a_stream_is_slower_beside_its_bed_and_runs_with_the_mainstream_there() -> None:
    types, grid = channel()
    surface = surface_of(grid, 0.59, [0.8, 0.2, 0])
    v, report = volume_velocity(surface, None, types, grid, kind="pour", mainstream=np.array([1.0, 0, 0]))
    middle = v.at_centers()[10, 4]
    speed = middle[1:6, 0]
    assert (np.diff(speed) > 0).all()  # grows from the bed to the surface
    assert 0.2 < speed[0] / speed[-1] < 0.6  # 0.37 at half a cell by the profile
    assert report.divergence_max < 1e-3


def test_what_is_not_seen_is_continued_downstream() -> None:
    types, grid = channel()
    v, _ = volume_velocity(surface_of(grid, 0.59, [0.8, 0, 0], seen=0.4), None, types, grid, kind="plume")
    end = v.at_centers()[15:19, :, 1:6, 0]
    assert np.abs(end - 0.8).max() < 0.02


def test_an_obstacle_is_flowed_around_without_leaks() -> None:
    types, grid = channel(24, 12, 6, 4)
    types[10:13, 4:8, 1:6] = CellType.SOLID
    v, report = volume_velocity(surface_of(grid, 0.49, [0.5, 0, 0]), None, types, grid, kind="stream")
    assert report.divergence_max < 2e-3
    solid = types == CellType.SOLID
    assert (v.u[1:-1][solid[1:] | solid[:-1]] == 0).all() and (
        v.w[:, :, 1:-1][solid[..., 1:] | solid[..., :-1]] == 0
    ).all()
    beside, before = v.u[12, [1, 10], 1:5].mean(), v.u[5, 1:11, 1:5].mean()
    assert beside > before  # narrower, so faster


def test_the_free_surface_is_kept_where_a_projection_with_air_pressure_would_leak() -> None:
    # flow that is twice as fast at the far end cannot be divergence-free in a channel of one depth
    types, grid = channel(30)
    surface = surface_of(grid, 0.59, [0.0, 0.0, 0.0])
    surface.velocities[:, 0] = 0.5 + surface.points[:, 0] / grid.high[0] * 0.5
    kept, report = volume_velocity(surface, None, types, grid, kind="plume")
    leaky, other = volume_velocity(surface, None, types, grid, kind="plume", surface_mobility=1.0, seen_mobility=1.0)
    assert abs(report.flux_surface) < 0.5 * abs(other.flux_surface)
    assert report.flux_in == pytest.approx(report.flux_out + report.flux_surface, rel=1e-2)
    assert np.abs(kept.w[5:25, :, 6]).mean() < np.abs(leaky.w[5:25, :, 6]).mean()


def test_samples_go_to_the_nearest_fluid_cell_and_far_ones_nowhere() -> None:
    types, grid = channel()
    carrying = types == CellType.FLUID
    points = np.array([[0.55, 0.35, 0.68], [0.55, 0.35, 0.1 + 8.0], [1.55, 0.35, 0.55]])
    motion = SurfaceMotion(points, np.array([[1.0, 0, 0], [9.0, 0, 0], [3.0, 0, 0]]), np.ones(3, bool))
    values, seen = splat_surface(motion, carrying, grid)
    assert np.argwhere(seen).tolist() == [[5, 3, 5], [15, 3, 5]]
    assert np.allclose(values[5, 3, 5], [1, 0, 0]) and np.allclose(values[15, 3, 5], [3, 0, 0])
    with pytest.raises(ValueError, match="no surface sample"):
        far = SurfaceMotion(points[1:2], np.zeros((1, 3)), np.ones(1, bool))
        volume_velocity(far, None, types, grid, kind="stream")


def test_filled_samples_count_less_than_observed_ones() -> None:
    types, grid = channel()
    at = np.array([[0.55, 0.35, 0.55]] * 2)
    motion = SurfaceMotion(at, np.array([[1.0, 0, 0], [2.0, 0, 0]]), np.array([True, False]))
    values, _ = splat_surface(motion, types == CellType.FLUID, grid)
    assert values[5, 3, 5, 0] == pytest.approx((1.0 + 0.25 * 2.0) / 1.25)


def test_the_extension_is_harmonic_and_keeps_what_is_known() -> None:
    shape = (12, 4, 3)
    known = np.zeros(shape, bool)
    known[0], known[-1] = True, True
    values = np.zeros((*shape, 1), np.float32)
    values[-1] = 11.0
    f = harmonic_extension(values, known, np.ones(shape, bool), 0.1, tolerance=1e-6)
    assert np.abs(f[..., 0] - np.arange(12)[:, None, None]).max() < 1e-3  # linear between two planes
    apart = np.ones(shape, bool)
    apart[6] = False  # the far part is known only at its end
    f = harmonic_extension(values, known, apart, 0.1, tolerance=1e-6)
    assert np.abs(f[:6]).max() < 1e-4 and np.abs(f[7:] - 11.0).max() < 1e-3
    known[-1] = False  # and now not at all
    f = harmonic_extension(values, known, apart, 0.1)
    assert np.abs(f[7:]).max() == 0.0


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


def test_targets_of_a_steady_river_are_steady_and_have_its_speed() -> None:
    types, grid = channel(20, 10, 6, 3)
    camera = PinholeCamera.looking((1.0, 0.5, 3.0), (1.0, 0.5, 0.4), 45.0, (64, 48), up=(0.0, 1.0, 0.0))
    rays = camera.rays(camera.pixel_grid())
    depth = (0.4 - camera.position[2]) / rays[..., 2]
    points = camera.unproject(camera.pixel_grid(), depth)
    mask = grid.contains(points.reshape(-1, 3) - [0, 0, 0.01]).reshape(depth.shape)
    moved, _ = camera.project(points + np.array([0.5, 0, 0]) * 0.04)
    rng = np.random.default_rng(0)
    d = (moved - camera.pixel_grid())[None] + rng.normal(0, 0.1, (8, 48, 64, 2))
    flow = PixelFlow(d.astype(np.float32), np.full((8, 48, 64), 0.9, np.float16))
    targets = list(
        target_sequence(flow, mask, depth, camera, None, types, grid, 0.04, kind="plume", frames=range(2, 5), window=5)
    )
    assert len(targets) == 3
    fluid = types == CellType.FLUID
    for v, report in targets:
        assert report.divergence_max < 1e-2
        assert abs(v.at_centers()[fluid][:, 0].mean() - 0.5) < 0.02
    step = np.abs(targets[1][0].u - targets[0][0].u).mean()
    assert step < 0.02  # noise of 0.1 px is 0.1 m/s here; five frames, cells of some 6 px and the overlap even it out


def test_wrong_input_is_named() -> None:
    types, grid = channel()
    surface = surface_of(grid, 0.59, [0.8, 0, 0])
    with pytest.raises(ValueError, match="cell types"):
        volume_velocity(surface, None, types[1:], grid, kind="stream")
    with pytest.raises(ValueError, match="without fluid"):
        volume_velocity(surface, None, np.zeros_like(types), grid, kind="stream")
    with pytest.raises(ValueError, match="lava"):
        volume_velocity(surface, None, types, grid, kind="lava")
