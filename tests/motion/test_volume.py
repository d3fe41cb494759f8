"""The volume velocity on channels and boxes that can be written down."""

from __future__ import annotations

import numpy as np
import pytest
from channels import channel

from fluidlift.errors import InputRejected
from fluidlift.motion.volume import DOUBT, VolumeOptions, VolumeSolver, _change, volume_velocity
from fluidlift.types import CellType, FaceVelocity, Grid, SurfaceMotion


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
    leaky, other = volume_velocity(
        surface, None, types, grid, kind="plume", options=VolumeOptions(surface_mobility=1.0, balanced=False)
    )
    assert abs(report.flux_surface) < 0.5 * abs(other.flux_surface)
    assert report.flux_in == pytest.approx(report.flux_out + report.flux_surface, rel=1e-2)
    assert np.abs(kept.w[5:25, :, 6]).mean() < np.abs(leaky.w[5:25, :, 6]).mean()


def discharge(v: FaceVelocity, grid: Grid) -> np.ndarray:
    """m^3/s through the cross-sections between the cells of a channel along x."""
    return v.u[1:-1].sum(axis=(1, 2)) * grid.spacing**2


def uneven(surface: SurfaceMotion, share: float, seed: int = 0) -> SurfaceMotion:
    """The same with smooth errors along the stream, of a share of the speed."""
    waves = np.random.default_rng(seed).normal(0.0, share / np.sqrt(2), 4)
    x = surface.points[:, 0] / surface.points[:, 0].max()
    error = sum(a * np.sin(np.pi * (k + 1) * x) for k, a in enumerate(waves))
    return SurfaceMotion(surface.points, surface.velocities * (1.0 + error[:, None]), surface.observed)


def test_the_same_discharge_passes_every_cross_section_of_a_steady_stream() -> None:
    types, grid = channel(40)
    surface = uneven(surface_of(grid, 0.59, [0.8, 0, 0]), 0.3, seed=3)
    v, report = volume_velocity(surface, None, types, grid, kind="plume")
    q = discharge(v, grid)
    assert np.ptp(q) > 0.2 * q.mean()  # as the samples have it: a surface of smoke is no barrier
    v, report = volume_velocity(surface, None, types, grid, kind="stream")
    q = discharge(v, grid)
    # the leak takes up at most 1 / (1 + 1 / CLOSED_SURFACE) = 1/5 of the slowest of these errors, some 20 % of Q
    assert np.ptp(q) < 0.04 * q.mean()
    assert report.flux_in == pytest.approx(report.flux_out, rel=0.04)
    assert report.divergence_max < 1e-3


def test_the_steps_of_a_falling_surface_do_not_leak() -> None:
    # depth falls from 6 to 3 cells along 36: a step each 12 cells, fluid passes through their fronts
    types, grid = channel(36, 6, 9, 6)
    height = 6 - np.arange(36) // 12
    for i, n in enumerate(height):
        types[i, :, 1 + n :] = CellType.EMPTY
    surface = surface_of(grid, 0.0, [0.8, 0, 0])
    surface.points[:, 2] = 0.1 * (height[grid.cell_of(surface.points)[:, 0]] + 0.9)
    _, report = volume_velocity(surface, None, types, grid, kind="stream")
    leaky = VolumeOptions(surface_mobility=0.02, balanced=False, even=True)
    _, other = volume_velocity(surface, None, types, grid, kind="stream", options=leaky)
    assert abs(report.flux_surface) < 0.05 * report.flux_out
    assert abs(other.flux_surface) > 0.2 * abs(other.flux_out)


def test_a_section_in_the_shade_follows_the_discharge_of_those_that_were_seen() -> None:
    types, grid = channel(40)
    surface = surface_of(grid, 0.59, [0.8, 0, 0])
    shade = surface.points[:, 0] < 1.2
    surface.velocities[shade] *= 0.4
    observed = SurfaceMotion(surface.points, surface.velocities, ~shade)
    v, report = volume_velocity(observed, None, types, grid, kind="stream")
    bright, _ = volume_velocity(surface_of(grid, 0.59, [0.8, 0, 0]), None, types, grid, kind="stream")
    unaware = VolumeOptions(even=True)
    blind, _ = volume_velocity(observed, None, types, grid, kind="stream", options=unaware)
    q, right, even = (float(discharge(f, grid)[:5].mean()) for f in (v, bright, blind))
    # inverse variances: the seen 70 % weigh 0.04 + 0.01 against 0.04 + 0.25, so the shade takes 7 % of 60 % off
    assert q > 0.9 * right
    assert even < 0.87 * right
    assert report.change_observed < 0.2


def test_in_and_outlet_go_on_as_the_fluid_beside_them() -> None:
    types, grid = channel(30)
    surface = uneven(surface_of(grid, 0.59, [0.8, 0, 0]), 0.3, seed=1)
    v, _ = volume_velocity(surface, None, types, grid, kind="stream")
    speed = v.at_centers()[:, :, 1:6, 0].mean(axis=(1, 2))
    assert speed[0] == pytest.approx(speed[1], rel=0.02) and speed[-1] == pytest.approx(speed[-2], rel=0.02)


def test_a_vessel_that_fills_lets_its_surface_rise() -> None:
    types, grid = channel(20)
    types[-1] = CellType.SOLID
    surface = surface_of(grid, 0.59, [0.3, 0, 0])
    v, report = volume_velocity(surface, None, types, grid, kind="stream")
    assert report.flux_out == 0.0 and report.flux_in > 0.0
    assert report.flux_surface == pytest.approx(report.flux_in, rel=1e-3)
    assert (v.w[2:-1, :, 6].mean(axis=1) > 0).all()  # it rises everywhere
    closed = VolumeOptions(surface_mobility=1e-4)
    _, stuck = volume_velocity(surface, None, types, grid, kind="stream", options=closed)
    assert stuck.flux_in < 0.5 * report.flux_in


def test_the_log_law_carries_less_than_a_thin_layer_and_smoke_knows_neither() -> None:
    types, grid = channel(20, 8, 12, 9)
    surface = surface_of(grid, 0.99, [0.8, 0, 0])
    thin, log, film = (
        volume_velocity(surface, None, types, grid, kind="stream", wall=wall)[1].flux_out
        for wall in ("cubic", "log", "film")
    )
    # 0.85 of the surface speed in the mean over depth, 2/3 for a film; a column's own top cell keeps what was seen
    assert thin > log > film
    assert log / 0.576 == pytest.approx(0.86, abs=0.03) and film / 0.576 == pytest.approx(0.69, abs=0.03)
    plume, _ = volume_velocity(surface, None, types, grid, kind="plume", wall="log")
    same, _ = volume_velocity(surface, None, types, grid, kind="plume")
    assert (plume.u == same.u).all()
    with pytest.raises(ValueError, match="wall"):
        volume_velocity(surface, None, types, grid, kind="stream", wall="brick")


def test_a_stream_too_slow_for_its_slope_drags_through_its_depth_like_a_viscous_film() -> None:
    types, grid = channel(36, 6, 9, 6)
    height = 6 - np.arange(36) // 12  # one in twelve
    for i, n in enumerate(height):
        types[i, :, 1 + n :] = CellType.EMPTY
    surface = surface_of(grid, 0.0, [1.0, 0, 0])
    surface.points[:, 2] = 0.1 * (height[grid.cell_of(surface.points)[:, 0]] + 0.9)

    def share(speed: float, wall: str = "cubic") -> float:
        motion = SurfaceMotion(surface.points, speed * surface.velocities, surface.observed)
        _, report = volume_velocity(motion, None, types, grid, kind="stream", wall=wall)
        return report.flux_out / speed

    # the shear velocity of this depth and slope is 0.4 m/s: 0.2 m/s is half of it, 2 m/s five times that
    assert share(0.2) == pytest.approx(share(0.2, "film"), rel=1e-3)
    assert share(2.0) > 1.2 * share(0.2)  # a thin layer carries 0.95 of the surface speed, a film 2/3
    assert share(2.0) > share(0.6) > share(0.2)  # by degrees


def test_a_slow_stream_whose_slope_may_be_an_error_keeps_its_speed_through_its_depth() -> None:
    # one section, 0.2 m/s, falls by one in twelve: as it stands a film, whose mean is 2/3 of the surface's speed;
    # level within one standard error of one in ten, a river, whose mean is 0.85 of it and more
    types, grid = channel(36, 6, 9, 6)
    height = 6 - np.arange(36) // 12
    for i, n in enumerate(height):
        types[i, :, 1 + n :] = CellType.EMPTY
    surface = surface_of(grid, 0.0, [0.2, 0, 0])
    surface.points[:, 2] = 0.1 * (height[grid.cell_of(surface.points)[:, 0]] + 0.9)
    known, unknown = (
        volume_velocity(surface, None, types, grid, kind="stream", slope_error=error)[1] for error in (0.0, 0.1)
    )
    assert known.viscous == 1.0 and unknown.viscous == 0.0
    assert unknown.flux_out > 1.2 * known.flux_out


def test_an_outlet_that_is_too_small_lets_the_surface_yield_before_it_speeds_up() -> None:
    types, grid = channel(30)
    types[28:, :, 4:] = CellType.EMPTY
    types[28:, :, 1:3] = CellType.SOLID  # one cell in five is left at the end
    types[28:-1, :, 3], types[-1, :, 3] = CellType.FLUID, CellType.OUTFLOW
    surface = surface_of(grid, 0.59, [0.8, 0, 0])
    surface.points[surface.points[:, 0] > 2.8, 2] = 0.39
    _, report = volume_velocity(surface, None, types, grid, kind="stream")
    closed = VolumeOptions(surface_mobility=1e-4)
    _, fast = volume_velocity(surface, None, types, grid, kind="stream", options=closed)
    area = 8 * 0.01
    assert fast.flux_out / area > 1.2 * DOUBT * 0.8
    assert report.flux_out / area <= DOUBT * 0.8 * 1.001  # float32 sums
    assert report.divergence_max < 1e-3
    assert report.change_observed < fast.change_observed
    assert report.flux_in > report.flux_out


def test_a_stream_takes_in_no_more_than_its_ends_agree_on() -> None:
    types, grid = channel(30)
    types[28:, :, 4:] = CellType.EMPTY
    types[28:, :, 1:3] = CellType.SOLID  # one cell in five is left at the end
    types[28:-1, :, 3], types[-1, :, 3] = CellType.FLUID, CellType.OUTFLOW
    surface = surface_of(grid, 0.59, [0.8, 0, 0])
    surface.points[surface.points[:, 0] > 2.8, 2] = 0.39
    surface.velocities[surface.points[:, 0] < 0.4] *= 5.0  # a jet strikes the stream there
    _, closed = volume_velocity(
        surface, None, types, grid, kind="stream", options=VolumeOptions(surface_mobility=0.25 * 5 / 28**2)
    )  # fmt: skip
    _, report = volume_velocity(surface, None, types, grid, kind="stream")
    assert report.flux_out < closed.flux_out
    share = report.flux_out / closed.flux_out
    # 28 of the 30 cells hold fluid, which makes the leak of the closed surface that of the solver to some percent
    assert share < 0.9
    assert report.flux_in == pytest.approx(np.sqrt(share) * closed.flux_in, rel=0.02)


def test_an_outlet_takes_nothing_in() -> None:
    types, grid = channel(30)
    surface = surface_of(grid, 0.59, [-0.8, 0, 0])
    surface.observed[:] = False
    _, report = volume_velocity(surface, None, types, grid, kind="stream", mainstream=np.array([1.0, 0, 0]))
    # held at 0; float32 sums over 40 faces
    assert report.flux_out == pytest.approx(0.0, abs=1e-6)
    assert report.flux_in == pytest.approx(0.0, abs=1e-6)
    assert report.divergence_max < 1e-3


def test_what_enters_a_fall_at_its_rim_runs_as_the_surface_beside_it() -> None:
    nx, ny, nz = 8, 8, 20
    grid = Grid((nx, ny, nz), 0.1, (0.0, 0.0, 0.0))
    types = np.full(grid.shape, CellType.EMPTY, np.uint8)
    types[0], types[1:4], types[1:4, :, 0] = CellType.SOLID, CellType.FLUID, CellType.OUTFLOW
    types[1:4, 0, 1:] = CellType.INFLOW  # the curtain is fed along one of its edges
    y, z = np.meshgrid(0.1 * np.arange(1, ny) + 0.05, 0.1 * np.arange(1, nz) + 0.05)
    points = np.stack([np.full(y.size, 0.35), y.ravel(), z.ravel()], axis=1)
    falling = np.stack([np.zeros(y.size), np.full(y.size, 0.2), -np.sqrt(2 * 9.81 * (2.2 - z.ravel()))], axis=1)
    v, report = volume_velocity(
        SurfaceMotion(points, falling, np.ones(len(points), bool)), None, types, grid, kind="fall",
        mainstream=np.array([0.0, 0.0, -1.0]),
    )  # fmt: skip
    entering = v.at_centers()[types == CellType.INFLOW].mean(axis=0)
    seen = falling.mean(axis=0)
    assert 0.0 <= entering[1] <= 1.01 * seen[1]  # no more sideways than seen; 1 % for float32 and interpolation
    assert entering[1] / -entering[2] < 1.5 * seen[1] / -seen[2]  # walls slow the fall more than the drift
    assert report.flux_in >= 0.0


def test_the_change_of_what_stood_still_is_one_at_most() -> None:
    grid = Grid((4, 4, 4), 0.1)
    still, moved = FaceVelocity.zeros(grid), FaceVelocity.zeros(grid)
    still.u[:], moved.u[:] = 1e-6, 0.5
    everywhere = np.ones(grid.shape, bool)
    assert _change(still, moved, everywhere) == 1.0
    assert _change(moved, still, everywhere) == pytest.approx(1.0, rel=1e-5)
    assert _change(still, still, everywhere) == 0.0


def test_a_solver_gives_each_frame_what_a_single_call_gives() -> None:
    types, grid = channel(20)
    solver = VolumeSolver(None, types, grid, kind="pour", mainstream=np.array([1.0, 0, 0]))
    for seed in (0, 1, 0):
        surface = uneven(surface_of(grid, 0.59, [0.8, 0.1, 0]), 0.2, seed)
        v, _ = solver.velocity(surface)
        alone, _ = volume_velocity(surface, None, types, grid, kind="pour", mainstream=np.array([1.0, 0, 0]))
        assert all((a == b).all() for a, b in zip(v.components, alone.components))


def test_frames_with_independent_errors_have_nearly_the_same_discharge() -> None:
    types, grid = channel(40)
    solver = VolumeSolver(None, types, grid, kind="stream")
    seen, found = [], []
    for seed in range(6):
        surface = uneven(surface_of(grid, 0.59, [0.8, 0, 0]), 0.2, seed)
        middle = np.abs(surface.points[:, 0] - 2.0) < 0.2
        seen.append(surface.velocities[middle, 0].mean() / 0.8)
        v, _ = solver.velocity(surface)
        found.append(float(discharge(v, grid)[19]))
    # the discharge is a mean over the length of the stream: errors of half its length and less average out
    assert np.std(found) / np.mean(found) < 0.6 * np.std(seen)


def test_wrong_input_is_named() -> None:
    types, grid = channel()
    surface = surface_of(grid, 0.59, [0.8, 0, 0])
    with pytest.raises(ValueError, match="cell types"):
        volume_velocity(surface, None, types[1:], grid, kind="stream")
    with pytest.raises(ValueError, match="without fluid"):
        volume_velocity(surface, None, np.zeros_like(types), grid, kind="stream")
    with pytest.raises(InputRejected, match="lava"):
        volume_velocity(surface, None, types, grid, kind="lava")
    far = SurfaceMotion(np.array([[0.55, 0.35, 8.0]]), np.zeros((1, 3)), np.ones(1, bool))
    with pytest.raises(ValueError, match="no surface sample"):
        volume_velocity(far, None, types, grid, kind="stream")
