"""Particle-grid transfers conserve what they should; the kernels agree with the plain formulas."""

import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from fluidlift.numerics.bspline import quadratic
from fluidlift.physics import transfer
from fluidlift.types import FaceVelocity, Grid, Particles

GRID = Grid((12, 9, 10), 0.2, (-1.0, 0.5, 0.1))
GRIDS = [GRID, Grid((5, 17, 4), 0.03, (10.0, -2.0, 0.0)), Grid((3, 2, 9), 1.5), Grid((1, 1, 1), 0.1)]
STATES = [(grid, seed) for grid in GRIDS for seed in range(3)]


def cloud(n=800, seed=0, margin=2.0, grid=GRID):
    """Random particles at least `margin` cells inside the box: from 2 on all of their footprint is on the grid."""
    rng = np.random.default_rng(seed)
    low, high = grid.low + margin * grid.spacing, grid.high - margin * grid.spacing
    f32 = np.float32
    return Particles(
        rng.uniform(low, high, (n, 3)).astype(f32), rng.normal(size=(n, 3)).astype(f32),
        rng.normal(size=(n, 3, 3)).astype(f32), np.broadcast_to(np.eye(3, dtype=f32), (n, 3, 3)).copy(),
        rng.uniform(0.5, 2, n).astype(f32), np.zeros(n, np.int64), np.arange(n),
    )  # fmt: skip


def random_velocity(grid, seed):
    rng = np.random.default_rng(seed)
    return FaceVelocity(*(rng.normal(size=grid.face_shape(a)).astype(np.float32) for a in range(3)))


def warp_transfer(ordered):
    pytest.importorskip("warp")
    from fluidlift.backends.warp_particles import WarpTransfer

    return WarpTransfer("cpu", ordered=ordered)


SCATTERS = {
    "numba": transfer.particles_to_grid,
    "torch": transfer.particles_to_grid_plain,
    "torch float32": partial(transfer.particles_to_grid_plain, dtype="float32"),
    "warp": lambda particles, grid: warp_transfer(ordered=True).particles_to_grid(particles, grid),
    "warp atomic": lambda particles, grid: warp_transfer(ordered=False).particles_to_grid(particles, grid),
}
GATHERS = {
    "numba": transfer.grid_to_particles,
    "torch": transfer.grid_to_particles_plain,
    "torch float32": partial(transfer.grid_to_particles_plain, dtype="float32"),
    "warp": lambda velocity, grid, positions: warp_transfer(ordered=True).grid_to_particles(velocity, grid, positions),
}
every_scatter = pytest.mark.parametrize("scatter", SCATTERS.values(), ids=SCATTERS.keys())
every_gather = pytest.mark.parametrize("gather", GATHERS.values(), ids=GATHERS.keys())


def test_the_spline_is_a_partition_of_unity_with_the_moments_that_apic_needs():
    x = np.linspace(3, 5, 41)
    base, w = quadratic(x)
    offset = base[:, None] + np.arange(3) - x[:, None]
    np.testing.assert_allclose(w.sum(axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose((w * offset).sum(axis=1), 0.0, atol=1e-14)
    np.testing.assert_allclose((w * offset**2).sum(axis=1), 0.25, rtol=1e-13)


def spline(r):
    r = np.abs(r)
    return np.where(r < 0.5, 0.75 - r**2, np.where(r < 1.5, 0.5 * (1.5 - r) ** 2, 0.0))


def test_the_plain_transfers_are_their_definitions():
    particles, velocity = cloud(6, margin=0.0), random_velocity(GRID, 1)
    scattered, masses = transfer.particles_to_grid_plain(particles, GRID)
    v, c = transfer.grid_to_particles_plain(velocity, GRID, cloud(6).positions)
    for axis in range(3):
        for p in range(6):
            offset = GRID.faces(axis) - cloud(6).positions[p]
            weighted = velocity.components[axis] * spline(offset / GRID.spacing).prod(axis=-1)
            assert v[p, axis] == pytest.approx(weighted.sum(), abs=1e-12)
            moment = 4 / GRID.spacing**2 * (weighted[..., None] * offset).sum(axis=(0, 1, 2))
            np.testing.assert_allclose(c[p, axis], moment, atol=1e-11)
        mass = momentum = 0.0
        for p in range(6):
            offset = GRID.faces(axis) - particles.positions[p].astype(np.float64)
            weight = spline(offset / GRID.spacing).prod(axis=-1) * particles.masses[p]
            mass = mass + weight
            momentum = momentum + weight * (particles.velocities[p, axis] + offset @ particles.affine[p, axis])
        np.testing.assert_allclose(masses[axis], mass, atol=1e-12)
        np.testing.assert_allclose(masses[axis] * scattered.components[axis], momentum, atol=1e-12)


@every_scatter
@pytest.mark.parametrize(("grid", "seed"), STATES, ids=lambda v: str(getattr(v, "shape", v)))
def test_every_scatter_is_the_plain_formula(scatter, grid, seed):
    particles = cloud(40 * min(grid.cells, 30), seed, 0.0, grid)
    velocity, masses = scatter(particles, grid)
    plain, plain_masses = transfer.particles_to_grid_plain(particles, grid)
    # A coordinate x / h is rounded to 2^-24 of the largest, distance from the origin included; weights have slopes up
    # to 1 per cell. A sum of single-precision numbers of one sign adds as much again.
    cells = max(np.abs([grid.low, grid.high]).max() / grid.spacing, 1.0)
    rounding = 4 * cells * 2.0**-24
    for axis in range(3):
        heaviest = plain_masses[axis].max()
        np.testing.assert_allclose(masses[axis], plain_masses[axis], atol=(rounding + 2e-6) * heaviest)
        # momenta: speeds of a particle at its faces reach 5 + 10 h, and both signs cancel
        fastest = 5 + 10 * grid.spacing
        momentum = masses[axis].astype(np.float64) * velocity.components[axis]
        plain_momentum = plain_masses[axis] * plain.components[axis]
        np.testing.assert_allclose(momentum, plain_momentum, atol=(rounding + 2e-6) * heaviest * fastest)
        empty = plain_masses[axis] == 0
        assert (velocity.components[axis][empty] == 0).all()


@every_gather
@pytest.mark.parametrize(("grid", "seed"), STATES, ids=lambda v: str(getattr(v, "shape", v)))
def test_every_gather_is_the_plain_formula(gather, grid, seed):
    velocity = random_velocity(grid, seed)
    # also outside the box, near and far
    positions = cloud(300, seed, margin=-3.0, grid=grid).positions
    v, c = gather(velocity, grid, positions)
    plain_v, plain_c = transfer.grid_to_particles_plain(velocity, grid, positions)
    # rounding of coordinates as for the scatter; neighbouring values differ by up to 6
    cells = max(np.abs([grid.low, grid.high]).max() / grid.spacing, 1.0) + 3
    rounding = 4 * cells * 2.0**-24 * 6 + 1e-6
    np.testing.assert_allclose(v, plain_v, atol=rounding)
    np.testing.assert_allclose(c, plain_c, atol=rounding * 4 / grid.spacing)


@every_scatter
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


@every_scatter
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


def test_particles_without_a_place_reach_no_face_and_break_nothing():
    particles = cloud(5)
    particles.positions[:4] = [[np.nan, 1, 1], [1e30, 1, 1], [-1e30, np.inf, 1], GRID.low - 1.01 * GRID.spacing]
    _, masses = transfer.particles_to_grid(particles, GRID)
    for mass in masses:
        assert mass.sum() == pytest.approx(particles.masses[4], rel=1e-6)
    velocity = random_velocity(GRID, 0)
    v, _ = transfer.grid_to_particles(velocity, GRID, particles.positions)
    # far along x beyond the box: the outer face's value
    plain, _ = transfer.grid_to_particles_plain(velocity, GRID, np.float32([[100, 1, 1]]))
    np.testing.assert_allclose(v[1], plain[0], atol=1e-5)


def test_no_particles_make_an_empty_grid():
    none = cloud(0)
    for scatter in (transfer.particles_to_grid, transfer.particles_to_grid_plain):
        velocity, masses = scatter(none, GRID)
        assert all((c == 0).all() for c in (*velocity.components, *masses))
    v, c = transfer.grid_to_particles(random_velocity(GRID, 0), GRID, none.positions)
    assert v.shape == (0, 3) and c.shape == (0, 3, 3)


def test_selected_particles_are_those_of_the_index():
    particles, index = cloud(500), np.random.default_rng(0).permutation(500)[:321]
    fast, plain = transfer.select_particles(particles, index), particles.select(index)
    for name in ("positions", "velocities", "affine", "deformation", "masses", "source", "ids"):
        np.testing.assert_array_equal(getattr(fast, name), getattr(plain, name))


@pytest.mark.parametrize("grid", GRIDS, ids=lambda g: str(g.shape))
def test_deposits_keep_the_total_and_the_centre_of_mass(grid):
    particles = cloud(500, margin=0.5, grid=grid)  # between the outer cell centres
    order = transfer.sort_by_cell(particles.positions, grid)
    out = transfer.deposit_to_cells(particles.positions, particles.masses, grid, order).astype(np.float64)
    m = particles.masses.astype(np.float64)
    assert out.sum() == pytest.approx(m.sum(), rel=1e-5)  # float32 sums of 500
    middle = (out[..., None] * (grid.centers() - grid.low)).sum(axis=(0, 1, 2)) / m.sum()
    truth = (m[:, None] * (particles.positions - grid.low)).sum(axis=0) / m.sum()
    # coordinates are rounded as for the scatter
    cells = np.abs([grid.low, grid.high]).max() / grid.spacing
    np.testing.assert_allclose(middle, truth, atol=(4 * cells * 2.0**-24 + 1e-5) * grid.spacing)


def test_deposits_outside_the_centres_stay_in_the_outer_cells():
    particles = cloud(500, margin=0.0)
    order = transfer.sort_by_cell(particles.positions, GRID)
    out = transfer.deposit_to_cells(particles.positions, particles.masses, GRID, order)
    assert out.sum(dtype=np.float64) == pytest.approx(particles.masses.sum(dtype=np.float64), rel=1e-5)


def test_the_transfers_load_torch_only_for_their_twins():
    code = "import sys, fluidlift.physics.transfer; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0
