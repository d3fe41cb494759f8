"""Deformation of particles and Gaussians."""

import numpy as np
import pytest

from fluidlift.physics.deform import (
    deform_gaussians,
    deformed_covariances,
    updated_deformation,
    updated_deformation_plain,
)
from fluidlift.types import Gaussians, Particles, matrix_from_quat


def random_gaussians(n=200, seed=0):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    return Gaussians(
        rng.normal(size=(n, 3)), q / np.linalg.norm(q, axis=1, keepdims=True), rng.uniform(0.01, 0.04, (n, 3)),
        rng.uniform(size=n), rng.normal(size=(n, 4, 3)),
    )  # fmt: skip


def particles_of(gaussians, deformation, source=None):
    p = Particles.at_rest(gaussians.means, 1.0, np.arange(len(gaussians)) if source is None else source)
    return Particles(p.positions, p.velocities, p.affine, np.float32(deformation), p.masses, p.source, p.ids)


UPDATES = [updated_deformation, updated_deformation_plain]


@pytest.mark.parametrize("update", UPDATES)
def test_rotation_keeps_the_stretches(update):
    spin = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 0]], np.float32)
    f = np.eye(3, dtype=np.float32)[None]
    for _ in range(200):
        f = update(f, spin[None], 0.01)
    # each step (1 + dt W) stretches by 1 + dt^2/2 before the determinant is repaired; 200 steps leave about 1 %
    np.testing.assert_allclose(np.linalg.svd(f[0], compute_uv=False), 1.0, atol=0.02)
    assert np.arctan2(f[0, 1, 0], f[0, 0, 0]) == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize("update", UPDATES)
def test_volume_is_kept_and_stretch_is_limited(update):
    rng = np.random.default_rng(0)
    f = np.broadcast_to(np.eye(3, dtype=np.float32), (50, 3, 3)).copy()
    c = rng.normal(size=(50, 3, 3)).astype(np.float32)
    for _ in range(300):
        f = np.float32(update(f, c, 0.02, max_stretch=3.0))
    s = np.linalg.svd(f, compute_uv=False)
    assert s.max() < 3.0 * 1.001 and s.min() > 1 / 3.0 / 1.001 and s.max() > 2.9


@pytest.mark.parametrize("strength", [0.001, 0.05, 1.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_kernel_updates_like_the_plain_formula(strength, seed):
    rng = np.random.default_rng(seed)
    f = (np.eye(3) + 0.3 * rng.normal(size=(400, 3, 3))).astype(np.float32)
    if strength < 0.01:  # as in a run: determinants near 1
        f = np.float32(updated_deformation_plain(f, np.zeros_like(f), 1.0))
    c = rng.normal(size=(400, 3, 3)).astype(np.float32)
    for limit in (1.5, 4.0):
        np.testing.assert_allclose(
            updated_deformation(f, c, strength, max_stretch=limit),
            updated_deformation_plain(f, c, strength, max_stretch=limit),
            atol=1e-4,  # float32 F; near-equal singular values are stable in the product
        )


def test_inside_out_particles_start_again():
    f = np.diag([1.0, 1.0, -1.0]).astype(np.float32)[None]
    np.testing.assert_array_equal(updated_deformation(f, np.zeros_like(f), 0.1)[0], np.eye(3))


def test_gaussians_follow_the_deformation():
    rest = random_gaussians()
    f = (np.eye(3) + 0.2 * np.random.default_rng(2).normal(size=(200, 3, 3))).astype(np.float32)
    deformed = deform_gaussians(rest, particles_of(rest, f))
    truth = f @ rest.covariances() @ np.swapaxes(f, 1, 2)
    # float32 squares of 4 cm
    np.testing.assert_allclose(deformed.covariances(), truth, atol=2e-6 * 40)
    np.testing.assert_allclose(np.linalg.norm(deformed.quats, axis=1), 1.0, atol=1e-5)


def test_rotating_a_gaussian_rotates_its_covariance():
    rest = random_gaussians()
    q = np.random.default_rng(4).normal(size=(200, 4))
    turn = matrix_from_quat(q)
    deformed = deform_gaussians(rest, particles_of(rest, turn))
    np.testing.assert_allclose(
        np.sort(deformed.scales, axis=1), np.sort(rest.scales, axis=1), rtol=1e-3
    )  # float32 squares


def test_needles_become_spheres_of_the_same_volume():
    rest = Gaussians.isotropic(np.zeros((1, 3)), 0.1, np.full((1, 3), 0.5))
    f = np.diag([20.0, 0.2, 0.25])[None]
    deformed = deform_gaussians(rest, particles_of(rest, f), max_stretch=5.0)
    np.testing.assert_allclose(deformed.scales, 0.1, rtol=1e-5)
    plain = deformed_covariances(rest.covariances(), f, max_ratio=5.0)
    np.testing.assert_allclose(plain[0], 0.01 * np.eye(3), atol=1e-7)


def test_broken_deformations_give_the_rest_gaussian_its_size():
    rest = random_gaussians(3)
    f = np.broadcast_to(np.eye(3), (3, 3, 3)).copy()
    f[1] = np.nan
    f[2] = 0.0
    deformed = deform_gaussians(rest, particles_of(rest, f))
    assert np.isfinite(deformed.scales).all() and np.isfinite(deformed.quats).all() and (deformed.scales > 0).all()
    assert deformed.scales[1].prod() == pytest.approx(rest.scales[1].prod(), rel=1e-4)


def test_looks_come_from_the_source():
    rest = random_gaussians(5)
    source = np.array([4, 0, 0, 2, 1])
    deformed = deform_gaussians(rest, particles_of(rest, np.broadcast_to(np.eye(3), (5, 3, 3)), source))
    np.testing.assert_array_equal(deformed.opacities, rest.opacities[source])
    np.testing.assert_array_equal(deformed.sh, rest.sh[source])


def test_a_source_outside_the_rest_gaussians_is_refused():
    rest = random_gaussians(2)
    with pytest.raises(ValueError, match="source"):
        deform_gaussians(rest, particles_of(rest, np.broadcast_to(np.eye(3), (2, 3, 3)), np.array([0, 2])))
