"""The Gaussians that particles on a Warp device carry: those of `deform_gaussians`, on Warp's CPU device."""

import numpy as np
import pytest

pytest.importorskip("warp", reason="the GPU back end, NVIDIA Warp, is not installed")

import torch
import warp

from fluidlift.backends import warp_splat_kernels
from fluidlift.backends.warp_device import warp_device
from fluidlift.backends.warp_liquid import WarpLiquids
from fluidlift.backends.warp_particle_store import ParticleStore
from fluidlift.backends.warp_splats import WarpSplats
from fluidlift.physics.deform import deform_gaussians
from fluidlift.physics.numba_particles import ParticleWork
from fluidlift.synthetic import tanks
from fluidlift.types import Gaussians, Particles, matrix_from_quat

DEVICE = "cpu"
"""of Warp; "cuda" for the same tests on a GPU"""
SINGLE = 2.0**-24
"""rounding of a number that is kept in single precision, relative"""


def gaussians(n=400, seed=0):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    scales = rng.uniform(0.004, 0.04, (n, 3))
    return Gaussians(rng.normal(size=(n, 3)), q, scales, rng.uniform(size=n), rng.normal(size=(n, 4, 3)))


def carrying(deformation, rest=400, seed=1):
    """Particles in no order of ids, each with a rest Gaussian of its own choice."""
    rng, n = np.random.default_rng(seed), len(deformation)
    at = Particles.at_rest(rng.normal(size=(n, 3)).astype(np.float32), 1.0, rng.integers(0, rest, n))
    at.deformation[:] = deformation
    at.ids[:] = 7 + 3 * rng.permutation(n)
    return at


def stirred(n=600, strength=0.4, seed=2):
    return (np.eye(3) + strength * np.random.default_rng(seed).normal(size=(n, 3, 3))).astype(np.float32)


def on_device(rest, particles, *, max_stretch=12.0, max_size=np.inf, by_id=False):
    """(splats, as Gaussians with the looks of their sources)."""
    store = ParticleStore(warp_device(DEVICE))
    store.upload(particles)
    found = WarpSplats(rest, warp_device(DEVICE)).carried(
        store.arrays(by_id=by_id), store.count, max_stretch=max_stretch, max_size=max_size
    )
    source = found.source.numpy()
    looks = rest.opacities[source], rest.sh[source]
    return found, Gaussians(found.means.numpy(), found.quats.numpy(), found.scales.numpy(), *looks)


def require_same_splats(ours, theirs):
    """The same places, sizes and covariances. Axes may be others where two sizes are the same.

    Both find the axes in double precision, to angles of 1e-9, and round quaternions and sizes to single: each component
    of a rotation is off by a few roundings, each covariance by as many of its largest.
    """
    np.testing.assert_array_equal(ours.means, theirs.means)
    np.testing.assert_array_equal(ours.opacities, theirs.opacities)
    np.testing.assert_array_equal(ours.sh, theirs.sh)
    np.testing.assert_allclose(np.linalg.norm(ours.quats, axis=1), 1.0, atol=4 * SINGLE)
    np.testing.assert_allclose(np.sort(ours.scales, axis=1), np.sort(theirs.scales, axis=1), rtol=4 * SINGLE)
    largest = theirs.scales.max(axis=1)[:, None, None].astype(np.float64) ** 2
    apart = covariances(ours) - covariances(theirs)
    assert (np.abs(apart) <= 24 * SINGLE * largest).all()


def covariances(splats):
    """In double precision, so that what is compared are the splats."""
    r = matrix_from_quat(splats.quats.astype(np.float64)) * splats.scales.astype(np.float64)[:, None, :]
    return r @ np.swapaxes(r, 1, 2)


@pytest.mark.parametrize("strength", [0.0, 1e-4, 0.05, 0.4])
def test_the_splats_are_those_of_the_host(strength):
    rest, particles = gaussians(), carrying(stirred(strength=strength))
    _, ours = on_device(rest, particles)
    require_same_splats(ours, deform_gaussians(rest, particles))


def test_round_splats_stay_round():
    rest = Gaussians.isotropic(np.zeros((5, 3)), 0.1, np.full((5, 3), 0.5))
    still = carrying(np.broadcast_to(np.eye(3), (5, 3, 3)), rest=5)
    _, ours = on_device(rest, still)
    np.testing.assert_allclose(ours.scales, 0.1, rtol=4 * SINGLE)
    np.testing.assert_array_equal(ours.quats, deform_gaussians(rest, still).quats)


def test_a_rotation_turns_and_does_not_stretch():
    rest = gaussians()
    q = np.random.default_rng(5).normal(size=(300, 4))
    turn = matrix_from_quat(q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)
    particles = carrying(turn)
    _, ours = on_device(rest, particles)
    before = np.sort(rest.scales[particles.source], axis=1)
    np.testing.assert_allclose(np.sort(ours.scales, axis=1), before, rtol=2e-6)  # of rotations in single precision
    require_same_splats(ours, deform_gaussians(rest, particles))


def test_a_reflection_leaves_a_proper_rotation():
    rest, mirror = gaussians(), np.diag([1.0, 1.0, -1.0]).astype(np.float32)
    particles = carrying(stirred() @ mirror)
    assert (np.linalg.det(particles.deformation) < 0).mean() > 0.5
    _, ours = on_device(rest, particles)
    np.testing.assert_allclose(np.linalg.det(matrix_from_quat(ours.quats)), 1.0, atol=1e-6)
    require_same_splats(ours, deform_gaussians(rest, particles))


@warp.kernel
def turned(matrices: warp.array(dtype=warp.mat33d), quats: warp.array(dtype=warp.vec4d)):
    """The quaternion of each rotation."""
    p = warp.tid()
    quats[p] = warp_splat_kernels.quaternion(matrices[p])


def test_every_rotation_has_its_quaternion():
    q = np.random.default_rng(6).normal(size=(400, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    assert (np.bincount(np.abs(q).argmax(axis=1)) > 50).all()  # each of the four is the largest of some
    device = warp_device(DEVICE)
    matrices = warp.array(matrix_from_quat(q), dtype=warp.mat33d, device=device)
    found = warp.empty(400, dtype=warp.vec4d, device=device)
    warp.launch(turned, 400, [matrices, found], device=device)
    ours = found.numpy()
    np.testing.assert_allclose(ours * np.sign((ours * q).sum(axis=1, keepdims=True)), q, atol=1e-12)


def test_an_axis_is_at_least_a_thousandth_of_the_mean_one():
    rest = Gaussians.isotropic(np.zeros((1, 3)), 0.1, np.full((1, 3), 0.5))
    _, ours = on_device(rest, carrying(np.diag([1.0, 1.0, 1e-5])[None], rest=1), max_stretch=1e4)
    mean = np.cbrt(0.1 * 0.1 * 1e-6)
    np.testing.assert_allclose(np.sort(ours.scales[0]), [1e-3 * mean, 0.1, 0.1], rtol=1e-6)


@pytest.mark.parametrize("flat", ["line", "plane", "point"])
def test_what_was_pressed_flat_keeps_the_thinnest_axis_that_is_allowed(flat):
    rest, f = gaussians(), stirred()
    f[:, 2] = {"plane": f[:, 1], "line": f[:, 0], "point": 0.0}[flat]
    if flat != "plane":
        f[:, 1] = f[:, 0] if flat == "line" else 0.0
    f[:, 0] *= 0.0 if flat == "point" else 1.0
    particles = carrying(f)
    _, ours = on_device(rest, particles, max_stretch=1e4)
    theirs = deform_gaussians(rest, particles, max_stretch=1e4)
    assert np.isfinite(ours.quats).all() and (ours.scales > 0).all()
    # an axis of no length is what rounding leaves of it: as good as none beside the others
    largest = theirs.scales.max(axis=1)[:, None, None].astype(np.float64) ** 2
    assert (np.abs(covariances(ours) - covariances(theirs)) <= 1e-5 * largest).all()


def test_needles_become_spheres_of_the_same_volume():
    rest, particles = gaussians(), carrying(stirred())
    _, ours = on_device(rest, particles, max_stretch=1.5)
    theirs = deform_gaussians(rest, particles, max_stretch=1.5)
    spheres = np.ptp(theirs.scales, axis=1) == 0
    assert 50 < spheres.sum() < 550
    np.testing.assert_array_equal(np.ptp(ours.scales, axis=1) == 0, spheres)
    np.testing.assert_array_equal(ours.quats[spheres], np.tile(np.float32([1, 0, 0, 0]), (spheres.sum(), 1)))
    require_same_splats(ours, theirs)


def test_none_is_larger_than_the_largest():
    rest, particles = gaussians(), carrying(stirred())
    _, ours = on_device(rest, particles, max_size=0.02)
    assert ours.scales.max() == np.float32(0.02) and (ours.scales < 0.02).any()
    require_same_splats(ours, deform_gaussians(rest, particles, max_size=0.02))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_deformation_that_is_not_finite_gives_the_rest_gaussian_its_size(value):
    rest, f = gaussians(), stirred()
    f[::7, 1, 2] = value
    particles = carrying(f)
    _, ours = on_device(rest, particles)
    assert np.isfinite(ours.quats).all() and np.isfinite(ours.scales).all()
    volume = rest.scales[particles.source[::7]].astype(np.float64).prod(axis=1)
    np.testing.assert_allclose(ours.scales[::7].astype(np.float64).prod(axis=1), volume, rtol=1e-5)
    require_same_splats(ours, deform_gaussians(rest, particles))


def test_the_order_is_the_present_one_or_that_of_the_ids():
    rest, particles = gaussians(), carrying(stirred())
    _, ours = on_device(rest, particles)
    np.testing.assert_array_equal(ours.means, particles.positions)
    sorted_ = particles.select(np.argsort(particles.ids))
    _, ours = on_device(rest, particles, by_id=True)
    require_same_splats(ours, deform_gaussians(rest, sorted_))


def test_a_source_outside_the_rest_gaussians_is_refused():
    rest = gaussians(5)
    for wrong in (5, -1):
        particles = carrying(stirred(8), rest=5)
        particles.source[3] = wrong
        with pytest.raises(ValueError, match="source"):
            on_device(rest, particles)


def test_no_particles_carry_no_splats():
    found, ours = on_device(gaussians(), carrying(stirred(0)))
    assert len(ours) == 0 and torch.from_dlpack(found.means).shape == (0, 3)


def test_torch_takes_the_arrays_as_they_are():
    found, _ = on_device(gaussians(), carrying(stirred()))
    for name, columns in (("means", (3,)), ("quats", (4,)), ("scales", (3,)), ("source", ())):
        array = getattr(found, name)
        tensor = torch.from_dlpack(array)
        assert tensor.shape == (600, *columns) and tensor.is_contiguous()
        assert tensor.data_ptr() == array.ptr
        np.testing.assert_array_equal(tensor.cpu().numpy(), array.numpy())


def flowing():
    """A channel into which particles come and out of which they go."""
    tank = tanks.river(cells=24)
    n = len(tank.particles)
    looks = gaussians(n)
    return tank, Gaussians(tank.particles.positions, looks.quats, looks.scales, looks.opacities, looks.sh)


def test_particles_that_came_and_went_are_deformed_as_on_the_host():
    tank, rest = flowing()
    simulator = tank.simulator(work=ParticleWork(liquid=WarpLiquids(DEVICE)))
    assert simulator.on_host_because == ""
    came = went = 0
    for _ in range(4):
        report = simulator.advance(2.0 * simulator.parameters.time_step)
        came, went = came + report.emitted, went + report.removed
    assert came > 20 and went > 20
    particles = simulator.particles
    theirs = deform_gaussians(rest, particles, max_stretch=3.0, max_size=0.05)
    assert np.abs(theirs.scales - rest.scales[particles.source]).max() > 1e-4
    require_same_splats(simulator.deformed(rest, particles, max_stretch=3.0, max_size=0.05), theirs)


def test_splats_that_are_held_stay_as_they_were_while_the_liquid_moves_on():
    tank, rest = flowing()
    simulator = tank.simulator(work=ParticleWork(liquid=WarpLiquids(DEVICE)))
    simulator.advance(simulator.parameters.time_step)
    held = simulator.splats(rest)
    before = [getattr(held, name).numpy().copy() for name in ("means", "quats", "scales", "source")]
    simulator.advance(2.0 * simulator.parameters.time_step)
    for name, values in zip(("means", "quats", "scales", "source"), before):
        np.testing.assert_array_equal(getattr(held, name).numpy(), values)
    assert np.abs(simulator.splats(rest).means.numpy()[:100] - before[0][:100]).max() > 1e-6
    assert tank.simulator().splats(rest) is None


def test_particles_of_another_state_are_refused():
    tank, rest = flowing()
    simulator = tank.simulator(work=ParticleWork(liquid=WarpLiquids(DEVICE)))
    with pytest.raises(ValueError, match="present state"):
        simulator.deformed(rest, simulator.particles.select(np.arange(10)))
