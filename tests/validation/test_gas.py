"""Physics of the gas simulator."""

import numpy as np
import pytest

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.gas import GasSimulator
from fluidlift.physics.maccormack import advect_maccormack
from fluidlift.physics.pressure import divergence
from fluidlift.physics.stepping import SimulationSettings
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles

H = 0.1
AIR = FluidParameters(density=1.2, kinematic_viscosity=1.5e-5, time_step=0.04)


def nobody():
    return Particles.at_rest(np.zeros((0, 3)), 1.0)


def test_smoke_rises_and_air_does_not_move_without_it(scene):
    grid = Grid((12, 12, 20), H)
    body = scene.body(grid, lambda p: np.linalg.norm(p - [0.6, 0.6, 0.5], axis=1) < 0.25)
    still = GasSimulator(grid, scene.terrain(grid), AIR, body, cell_types=scene.cells(grid), buoyancy=0.0)
    rising = GasSimulator(grid, scene.terrain(grid), AIR, body, cell_types=scene.cells(grid), buoyancy=2.0)
    start = rising.particles.positions.mean(axis=0)
    still.advance(0.6)
    report = rising.advance(0.6)
    assert np.abs(still.velocity.w).max() == 0.0
    moved = rising.particles.positions.mean(axis=0) - start
    # a sphere in its own density gains at most b t^2 / 2 = 0.36 m; the added mass of the air around it takes a third
    assert 0.1 < moved[2] < 0.36 and np.abs(moved[:2]).max() < 0.02
    assert all(r.converged for r in report.pressure)


def test_air_is_free_of_divergence_and_does_not_enter_the_ground_or_a_rock(scene):
    grid = Grid((12, 12, 16), H)
    distance = np.minimum(
        np.linalg.norm(grid.nodes() - np.array([0.6, 0.6, 0.8]), axis=-1) - 0.25, grid.nodes()[..., 2] - 0.12
    )
    terrain = scene.terrain(grid, distance)
    types = scene.cells(grid)
    types[4:8, 4:8, :3] = CellType.INFLOW
    simulator = GasSimulator(
        grid, terrain, FluidParameters(density=1.2, inflow_velocity=(0, 0, 1.0), inflow_fluctuation=0.2), nobody(),
        cell_types=types, buoyancy=1.0,
    )  # fmt: skip
    for _ in range(8):
        report = simulator.advance(0.1)
        inside = sample_nodes(terrain.signed_distance, grid, simulator.particles.positions) < 0
        assert not inside.any()
    left = np.abs(divergence(simulator.velocity, grid, simulator._system)).max() * H
    assert left < 1e-3 * report.max_speed  # tolerance 1e-5 of the divergence before, which is some ten times speed / h
    # the smoke has met the rock, whose foot is at 0.55 m, and passes it
    assert report.n_particles > 300 and simulator.particles.positions[:, 2].max() > 0.65


def test_a_uniform_wind_carries_smoke_unchanged(scene):
    grid = Grid((24, 8, 8), H)
    wind = FaceVelocity.zeros(grid)
    wind.u[:] = 1.0
    body = scene.body(grid, lambda p: np.linalg.norm(p - [0.5, 0.4, 0.4], axis=1) < 0.2)
    simulator = GasSimulator(
        grid, scene.terrain(grid), AIR, body, cell_types=scene.cells(grid), buoyancy=0.0, velocity=wind
    )
    start = simulator.particles.positions
    simulator.advance(0.8)
    # uniform flow is an exact solution; float32 sums over some 10 steps
    np.testing.assert_allclose(simulator.particles.positions - start, np.tile([0.8, 0, 0], (len(start), 1)), atol=1e-3)
    np.testing.assert_allclose(simulator.particles.deformation, np.tile(np.eye(3), (len(start), 1, 1)), atol=1e-3)


def test_advection_converges_with_second_order_in_space():
    errors = []
    for n in (16, 32):
        grid = Grid((n, n, 2), 1.0 / n)
        wave = np.sin(2 * np.pi * grid.faces(1)[..., 0])
        velocity = FaceVelocity.zeros(grid)
        velocity.u[:] = 0.5
        velocity.v[:] = wave
        dt, steps = 0.5 / n, n // 4
        for _ in range(steps):
            moved = advect_maccormack(velocity, grid, dt)
            velocity = FaceVelocity(velocity.u, moved.v, velocity.w)
        truth = np.sin(2 * np.pi * (grid.faces(1)[..., 0] - 0.5 * dt * steps))
        inner = slice(n // 4, -n // 4)  # away from the sides of the box, where the nearest value continues
        errors.append(np.abs(velocity.v - truth)[inner, inner].mean())
    # the limiter clips crests and keeps the order of the mean error just below two; first order would halve it
    assert errors[1] < errors[0] / 2.8


def test_smoke_leaves_through_the_top_and_is_removed(scene):
    grid = Grid((6, 6, 8), H)
    wind = FaceVelocity.zeros(grid)
    types = scene.cells(grid)
    types[:, :, 0] = CellType.INFLOW
    parameters = FluidParameters(density=1.2, inflow_velocity=(0, 0, 2.0), time_step=0.04)
    simulator = GasSimulator(
        grid, scene.terrain(grid), parameters, nobody(), cell_types=types, buoyancy=0.0, velocity=wind
    )
    removed = sum(simulator.advance(0.1).removed for _ in range(8))
    assert removed > 500 and simulator.grid.contains(simulator.particles.positions).all()


def test_a_wide_source_is_thinned_out_and_brings_as_much_smoke_as_without(scene):
    grid = Grid((10, 10, 16), H)
    types = scene.cells(grid)
    types[1:-1, 1:-1, :2] = CellType.INFLOW
    parameters = FluidParameters(density=1.2, inflow_velocity=(0, 0, 1.0), time_step=0.04)
    whole, thinned = (
        GasSimulator(grid, scene.terrain(grid), parameters, nobody(), cell_types=types, buoyancy=1.0) for _ in range(2)
    )
    thinned.most = 2000
    for _ in range(10):
        counts = [s.advance(0.2).n_particles for s in (whole, thinned)]
        assert counts[1] <= 2 * 2000
    assert counts[0] > 5000
    mass = [s.particles.masses.sum() for s in (whole, thinned)]
    assert mass[1] == pytest.approx(mass[0], rel=0.05)  # their noise is 1.4 %
    rises = [s.velocity.w[2:-2, 2:-2, 4:].mean() for s in (whole, thinned)]
    assert rises[1] == pytest.approx(rises[0], rel=0.02)
    inside = thinned._inlet.beside(thinned.particles.positions)
    assert (thinned.particles.masses[~inside] > 1.5 * whole.particles.masses[0]).mean() > 0.5


def test_an_initial_velocity_that_is_not_finite_is_refused(scene):
    grid = Grid((4, 4, 4), H)
    wind = FaceVelocity.zeros(grid)
    wind.u[0, 0, 0] = np.inf
    with pytest.raises(ValueError, match="finite"):
        GasSimulator(
            grid, scene.terrain(grid), AIR, nobody(), cell_types=scene.cells(grid), buoyancy=0.0, velocity=wind
        )


def wind_over(scene, grid, speed, smoke):
    """Smoke in the lower part of a box, at one speed (m/s), and wind in its upper half."""
    wind = FaceVelocity.zeros(grid)
    wind.u[:, :, grid.shape[2] // 2 :] = speed
    wind.u[:, :, : grid.shape[2] // 2] = smoke
    body = scene.body(grid, lambda p: p[:, 2] < 0.4 * grid.high[2])
    parameters = FluidParameters(density=1.2, time_step=0.1)
    return GasSimulator(
        grid, scene.terrain(grid), parameters, body, cell_types=scene.cells(grid), buoyancy=0.0, velocity=wind
    )


def test_substeps_are_those_of_the_smoke_where_air_beside_it_is_not_much_faster(scene):
    grid = Grid((12, 6, 12), H)
    # 0.4 cells of smoke a frame; air crosses 2.2 cells, and 4.5 of which each substep takes 2.5 at most
    assert wind_over(scene, grid, 2.2, 0.4).advance(0.1).substeps == 1
    assert wind_over(scene, grid, 4.5, 0.4).advance(0.1).substeps == 2
    simulator = wind_over(scene, grid, 2.2, 1.4)
    simulator.advance(0.1)  # particles are at rest before it
    assert simulator.advance(0.1).substeps == 3


def test_air_that_is_continued_into_the_ground_does_not_count(scene):
    grid = Grid((12, 6, 12), H)
    simulator = wind_over(scene, grid, 1.0, 1.0)
    velocity = FaceVelocity(*(c.copy() for c in simulator.velocity.components))
    closed = simulator._walls.openings[2] == 0
    assert closed.any()
    velocity.w[closed] = 50.0
    assert simulator._fastest_air(velocity) == simulator._fastest_air(simulator.velocity) < 2.0


def test_smoke_that_nobody_looks_at_moves_as_smoke_that_is_shown(scene):
    grid = Grid((10, 10, 14), H)
    body = scene.body(grid, lambda p: np.linalg.norm(p - [0.5, 0.5, 0.4], axis=1) < 0.25)
    shown, bare = (
        GasSimulator(
            grid, scene.terrain(grid), AIR, body, cell_types=scene.cells(grid), buoyancy=2.0,
            settings=SimulationSettings(deform=deform),
        )
        for deform in (True, False)
    )  # fmt: skip
    for simulator in (shown, bare):
        simulator.advance(0.4)
    np.testing.assert_array_equal(shown.particles.positions, bare.particles.positions)
    assert np.abs(shown.particles.deformation - np.eye(3)).max() > 0.05
    np.testing.assert_array_equal(bare.particles.deformation, np.tile(np.eye(3), (len(bare.particles), 1, 1)))
