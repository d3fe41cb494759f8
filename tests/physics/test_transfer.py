"""Particle-grid transfers conserve what they should; the kernels agree with the plain formulas."""

import numpy as np
import pytest

from fluidlift.numerics.bspline import quadratic
from fluidlift.physics import transfer
from fluidlift.types import FaceVelocity, Grid, Particles

GRID = Grid((12, 9, 10), 0.2, (-1.0, 0.5, 0.1))


def cloud(n=800, seed=0, margin=2.0):
    """Random particles at least `margin` cells inside the box: all of their footprint is on the grid."""
    rng = np.random.default_rng(seed)
    low, high = GRID.low + margin * GRID.spacing, GRID.high - margin * GRID.spacing
    f32 = np.float32
    return Particles(
        rng.uniform(low, high, (n, 3)).astype(f32), rng.normal(size=(n, 3)).astype(f32),
        rng.normal(size=(n, 3, 3)).astype(f32), np.broadcast_to(np.eye(3, dtype=f32), (n, 3, 3)).copy(),
        rng.uniform(0.5, 2, n).astype(f32), np.zeros(n, np.int64), np.arange(n),
    )  # fmt: skip


def test_the_spline_is_a_partition_of_unity_with_the_moments_that_apic_needs():
    x = np.linspace(3, 5, 41)
    base, w = quadratic(x)
    offset = base[:, None] + np.arange(3) - x[:, None]
    np.testing.assert_allclose(w.sum(axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose((w * offset).sum(axis=1), 0.0, atol=1e-14)
    np.testing.assert_allclose((w * offset**2).sum(axis=1), 0.25, rtol=1e-13)


def test_the_kernel_scatters_like_the_plain_formula():
    particles = cloud(margin=0.0)
    fast, fast_mass = transfer.particles_to_grid(particles, GRID)
    plain, plain_mass = transfer.particles_to_grid_plain(particles, GRID)
    for axis in range(3):
        scale = plain_mass[axis].max()
        np.testing.assert_allclose(fast_mass[axis], plain_mass[axis], atol=1e-5 * scale)
        # velocities are compared where they are not the quotient of two roundings
        heavy = plain_mass[axis] > 1e-2 * scale
        np.testing.assert_allclose(fast.components[axis][heavy], plain.components[axis][heavy], atol=1e-3)


def test_the_kernel_gathers_like_the_plain_formula():
    rng = np.random.default_rng(1)
    velocity = FaceVelocity(*(rng.normal(size=GRID.face_shape(a)).astype(np.float32) for a in range(3)))
    positions = cloud(margin=0.0).positions
    fast, plain = (
        transfer.grid_to_particles(velocity, GRID, positions),
        transfer.grid_to_particles_plain(velocity, GRID, positions),
    )
    np.testing.assert_allclose(fast[0], plain[0], atol=1e-5)  # float32, values of order 1
    np.testing.assert_allclose(fast[1], plain[1], atol=1e-5 * 4 / GRID.spacing)


SCATTERS = [transfer.particles_to_grid, transfer.particles_to_grid_plain]


@pytest.mark.parametrize("scatter", SCATTERS)
def test_scattering_conserves_mass_and_linear_momentum(scatter):
    particles = cloud()
    velocity, masses = scatter(particles, GRID)
    m = particles.masses.astype(np.float64)
    for axis in range(3):
        # float32 sums of 800 particles
        assert masses[axis].sum(dtype=np.float64) == pytest.approx(m.sum(), rel=1e-5)
        momentum = (masses[axis].astype(np.float64) * velocity.components[axis]).sum()
        assert momentum == pytest.approx((m * particles.velocities[:, axis]).sum(), abs=1e-5 * m.sum())


def grid_angular_momentum(velocity, masses):
    total = np.zeros(3)
    for axis in range(3):
        momentum = masses[axis].astype(np.float64) * velocity.components[axis]
        total += np.cross(GRID.faces(axis), np.eye(3)[axis]).reshape(-1, 3).T @ momentum.ravel()
    return total


def particle_angular_momentum(particles):
    p = particles
    m, x, v, c = (np.float64(a) for a in (p.masses, p.positions, p.velocities, p.affine))
    own = (
        0.25
        * GRID.spacing**2
        * np.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], axis=-1)
    )
    return (m[:, None] * (np.cross(x, v) + own)).sum(axis=0)


@pytest.mark.parametrize("scatter", SCATTERS)
def test_there_and_back_conserves_angular_momentum(scatter):
    particles = cloud()
    velocity, masses = scatter(particles, GRID)
    before = particle_angular_momentum(particles)
    scale = particles.masses.sum()  # times order 1 m and 1 m/s
    np.testing.assert_allclose(grid_angular_momentum(velocity, masses), before, atol=2e-5 * scale)
    v, c = transfer.grid_to_particles(velocity, GRID, particles.positions)
    back = Particles(
        particles.positions, v, c, particles.deformation, particles.masses, particles.source, particles.ids
    )
    np.testing.assert_allclose(particle_angular_momentum(back), before, atol=2e-5 * scale)


def test_an_affine_velocity_survives_the_round_trip():
    particles = cloud(4000)
    matrix = np.random.default_rng(3).normal(size=(3, 3)).astype(np.float32)
    moving = Particles(
        particles.positions, particles.positions @ matrix.T, np.broadcast_to(matrix, (4000, 3, 3)).copy(),
        particles.deformation, particles.masses, particles.source, particles.ids,
    )  # fmt: skip
    velocity, _ = transfer.particles_to_grid(moving, GRID)
    v, c = transfer.grid_to_particles(velocity, GRID, moving.positions)
    np.testing.assert_allclose(v, moving.velocities, atol=2e-4)  # float32 quotients of small masses at the rim
    np.testing.assert_allclose(c, moving.affine, atol=2e-4 * 4 / GRID.spacing)


def test_the_result_does_not_depend_on_the_number_of_threads():
    import numba

    particles = cloud(3000)
    many, _ = transfer.particles_to_grid(particles, GRID)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one, _ = transfer.particles_to_grid(particles, GRID)
    finally:
        numba.set_num_threads(threads)
    for a, b in zip(many.components, one.components):
        np.testing.assert_array_equal(a, b)


def test_deposits_keep_the_total():
    particles = cloud(500, margin=0.0)
    order = transfer.sort_by_cell(particles.positions, GRID)
    out = transfer.deposit_to_cells(particles.positions, particles.masses, GRID, order)
    assert out.sum(dtype=np.float64) == pytest.approx(particles.masses.sum(dtype=np.float64), rel=1e-5)
