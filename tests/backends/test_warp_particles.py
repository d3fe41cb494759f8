"""The particle side in Warp (here on its CPU device) takes the same steps as the CPU kernels."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from fluidlift.backends.warp_device import warp_device
from fluidlift.errors import FluidliftError, MissingPackage
from fluidlift.physics import boundaries, transfer
from fluidlift.physics.advect_particles import displacements
from fluidlift.physics.deform import updated_deformation
from fluidlift.physics.forces import add_gravity
from fluidlift.physics.numba_particles import NumbaMover, NumbaTransfer
from fluidlift.seams import MoveRules
from fluidlift.types import Grid, Particles, Terrain, TriangleMesh

warp = pytest.importorskip("warp")

from fluidlift.backends.warp_particles import WarpMover, WarpTransfer  # noqa: E402

GRID = Grid((14, 9, 11), 0.1, (-0.4, 2.0, 0.0))
DT = 0.01


def walls():
    x = GRID.nodes() - GRID.low
    distance = 0.9 * x[..., 2] - 0.2 * x[..., 0] + 0.05 * np.sin(9 * x[..., 1]) - 0.1
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(GRID, np.float32(distance), np.array([1.0, 0, 0]), mesh)
    return boundaries.build_walls(terrain, np.zeros(GRID.shape, np.uint8), np.zeros((3, 2), bool))


def drop(n=2000, seed=0):
    """A swirling body above the bed."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(GRID.low + [0.2, 0.2, 0.5], GRID.high - [0.6, 0.2, 0.1], (n, 3)).astype(np.float32)
    at_rest = Particles.at_rest(positions, 1.0)
    spin = np.float32([[0, -2.0, 0], [2.0, 0, 0], [0, 0, 0]])
    middle = np.float32(0.5 * (GRID.low + GRID.high))
    velocities = (positions - middle) @ spin.T + np.float32([0.5, 0, -1.0])
    return replace(at_rest, velocities=velocities, affine=np.broadcast_to(spin, (n, 3, 3)).copy())


def stepped(particles, transfers, mover, solid):
    """One step without pressure: transfers, gravity, displacement, walls, deformation."""
    velocity, _ = transfers.particles_to_grid(particles, GRID)
    velocity = add_gravity(velocity, (0.0, 0.0, -9.81), DT)
    v, c = transfers.grid_to_particles(velocity, GRID, particles.positions)
    moves, _ = displacements(v, c, DT)
    return mover.moved(particles, moves, v, c, solid, MoveRules(DT, 0.3, 0.9, 2.0))


@pytest.mark.parametrize("ordered", [True, False])
def test_every_step_of_a_splash_agrees(ordered):
    solid, state = walls(), drop()
    transfers, mover = WarpTransfer("cpu", ordered=ordered), WarpMover("cpu")
    for _ in range(20):
        theirs = stepped(state, transfers, mover, solid)
        ours = stepped(state, NumbaTransfer(), NumbaMover(), solid)
        # Only the order of single-precision sums and the fusing of products differ: 2^-24 of speeds up to 4 m/s, 27
        # terms; gradients are 4 / h times that.
        np.testing.assert_allclose(theirs.velocities, ours.velocities, atol=4e-6)
        np.testing.assert_allclose(theirs.positions, ours.positions, atol=5e-7)  # one unit of 2 m, plus dt v
        np.testing.assert_allclose(theirs.affine, ours.affine, atol=4e-6 * 4 / GRID.spacing)
        np.testing.assert_allclose(theirs.deformation, ours.deformation, atol=4e-6 * 4 / GRID.spacing * DT + 1e-6)
        state = ours
    assert (np.abs(state.velocities - drop().velocities).max(axis=1) > 0.5).mean() > 0.5
    assert np.linalg.svd(state.deformation, compute_uv=False).max() > 1.2


def test_the_same_call_gives_the_same_bits():
    particles, transfers = drop(), WarpTransfer("cpu")
    first, again = (transfers.particles_to_grid(particles, GRID)[0] for _ in range(2))
    for a, b in zip(first.components, again.components):
        np.testing.assert_array_equal(a, b)


def test_the_order_by_cell_is_that_of_the_cpu():
    rng = np.random.default_rng(3)
    positions = rng.uniform(GRID.low - 0.2, GRID.high + 0.2, (3000, 3)).astype(np.float32)
    order, start = WarpTransfer("cpu").sort_by_cell(positions, GRID)
    cpu = transfer.sort_by_cell(positions, GRID)
    # coordinates are single precision here and double there: no random place lies within rounding of a cell's side
    np.testing.assert_array_equal(order, cpu.order)
    np.testing.assert_array_equal(start, cpu.start)


@pytest.mark.parametrize("limit", [1.5, 4.0])
@pytest.mark.parametrize("strength", [0.001, 0.1, 1.0])
def test_particles_deform_as_on_the_cpu(limit, strength):
    rng, particles = np.random.default_rng(4), drop(500)
    f = (np.eye(3) + 0.4 * rng.normal(size=(500, 3, 3))).astype(np.float32)
    f[0] = -f[0]  # inside out: starts again
    c, still = rng.normal(size=(500, 3, 3)).astype(np.float32), np.zeros((500, 3), np.float32)
    state = replace(particles, deformation=f)
    new = WarpMover("cpu").moved(state, still, still, c, walls(), MoveRules(strength, 0.0, 1.0, limit))
    plain = updated_deformation(f, c, strength, max_stretch=limit)
    np.testing.assert_allclose(new.deformation, plain, atol=1e-6 * limit)  # stored in single precision
    np.testing.assert_array_equal(new.affine, c)


def test_no_particles_are_no_trouble():
    none = drop(0)
    velocity, masses = WarpTransfer("cpu").particles_to_grid(none, GRID)
    assert all((c == 0).all() for c in (*velocity.components, *masses))
    v, c = WarpTransfer("cpu").grid_to_particles(velocity, GRID, none.positions)
    assert v.shape == (0, 3) and c.shape == (0, 3, 3)
    assert len(WarpMover("cpu").moved(none, v, v, c, walls(), MoveRules(DT, 0.0, 1.0, 4.0))) == 0


@pytest.mark.parametrize("mover", [NumbaMover(), WarpMover("cpu")], ids=["numba", "warp"])
def test_arguments_stay_as_they_were(mover):
    particles, solid = drop(300), walls()
    v, moves = np.full((300, 3), -2.0, np.float32), np.full((300, 3), -0.3, np.float32)
    before = [a.copy() for a in (particles.positions, particles.velocities, particles.deformation, v, moves)]
    mover.moved(particles, moves, v, particles.affine, solid, MoveRules(DT, 0.3, 0.9, 4.0))
    after = (particles.positions, particles.velocities, particles.deformation, v, moves)
    for a, b in zip(after, before):
        np.testing.assert_array_equal(a, b)


def test_a_missing_gpu_says_what_to_do():
    if warp.get_cuda_device_count() > 7:
        pytest.skip("eight GPUs here")
    with pytest.raises(FluidliftError, match=r"Warp sees .*driver"):
        warp_device("cuda:7")


def test_a_missing_package_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(MissingPackage, match=r"pip install 'fluidlift\[cuda\]'"):
        WarpTransfer("cpu")


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:x", ""])
def test_a_device_of_another_name_is_refused(name):
    with pytest.raises(ValueError, match="device"):
        warp_device(name)


KERNELS = ["warp_transfer_kernels", "warp_motion_kernels", "warp_grid_kernels"]


@pytest.mark.parametrize("module", KERNELS)
def test_kernels_compile_for_a_gpu_without_one(module, tmp_path):
    from importlib import import_module

    warp_device("cpu")
    kernels = import_module(f"fluidlift.backends.{module}")
    (file,) = warp.compile_aot_module(kernels, arch=75, module_dir=tmp_path, use_ptx=True)
    code = file.read_text()
    names = [n for n, k in vars(kernels).items() if isinstance(k, warp.Kernel)]
    assert names and all(f".entry {name}_" in code for name in names)
