"""Particles that live on a Warp device: kept in the order of their cells, taken out, let in, split and merged."""

from dataclasses import fields

import numpy as np
import pytest

pytest.importorskip("warp", reason="the GPU back end, NVIDIA Warp, is not installed")

import warp
from warp_states import DENSITY, GRID, basin, on_host

from fluidlift.backends import warp_sorting_kernels, warp_step_kernels
from fluidlift.backends.warp_device import warp_device
from fluidlift.backends.warp_particle_store import LANES, ParticleStore
from fluidlift.physics import outlet, transfer
from fluidlift.physics.advect_particles import leaving
from fluidlift.physics.position_correction import limited_moves
from fluidlift.types import CellType, FaceVelocity, Particles


def loose(n=2500, seed=3):
    """Particles in no order."""
    rng = np.random.default_rng(seed)
    particles = Particles.at_rest(rng.uniform(GRID.low, GRID.high, (n, 3)).astype(np.float32), 1.0, np.arange(n) % 5)
    particles.velocities[:] = rng.normal(0, 1, (n, 3))
    particles.affine[:] = rng.normal(0, 1, (n, 3, 3))
    particles.masses[:] = rng.uniform(0.5, 2.0, n)
    return particles


def require_same(ours, theirs):
    for field in fields(Particles):
        np.testing.assert_array_equal(getattr(ours, field.name), getattr(theirs, field.name), err_msg=field.name)


def stored(particles):
    store = ParticleStore(warp_device("cpu"))
    store.upload(particles)
    return store


def test_what_goes_up_comes_down_also_when_more_join():
    particles = loose()
    store = stored(particles.select(np.arange(100)))
    require_same(store.download(), particles.select(np.arange(100)))
    store.append(particles.select(np.arange(100, 2500)))
    require_same(store.download(), particles)
    assert store.capacity >= 2500


def test_the_order_of_ids_is_that_of_the_host():
    particles = loose()
    particles.ids[:] = np.random.default_rng(1).permutation(2500) + 2**40
    store = stored(particles)
    require_same(store.download(by_id=True), particles.select(np.argsort(particles.ids)))
    require_same(store.download(), particles)


def test_the_order_of_cells_is_that_of_the_host():
    particles = loose()
    store, order = stored(particles), transfer.sort_by_cell(particles.positions, GRID)
    counts, ends = store.sort(GRID)
    require_same(store.download(), transfer.select_particles(particles, order.order))
    np.testing.assert_array_equal(counts.numpy(), np.diff(order.start))
    np.testing.assert_array_equal(ends.numpy(), order.start[1:])


@pytest.mark.parametrize("sort", [False, True])
def test_particles_that_are_gone_leave_no_gap(sort):
    particles, rng = loose(), np.random.default_rng(0)
    store, gone = stored(particles), rng.uniform(size=2500) < 0.3
    store.gone[:2500].assign(gone.astype(np.uint8))
    expected = particles.select(~gone)
    if sort:
        store.sort(GRID, store.gone, int(gone.sum()))
        expected = expected.select(transfer.sort_by_cell(expected.positions, GRID).order)
    else:
        store.keep(store.gone, int(gone.sum()))
    assert store.count == len(expected)
    require_same(store.download(), expected)


def test_what_a_report_says_is_counted_on_the_device():
    particles = loose()
    store = stored(particles)
    assert store.mass() == pytest.approx(particles.masses.sum(dtype=np.float64), rel=1e-12)
    assert store.filled_cells(GRID) == len(np.unique(GRID.cell_of(particles.positions), axis=0))


def test_the_summary_and_the_verdict_are_those_of_numpy():
    particles = loose()
    store = stored(particles)
    low, high, speed = store.summary()
    np.testing.assert_array_equal(low, particles.positions.min(axis=0))
    np.testing.assert_array_equal(high, particles.positions.max(axis=0))
    assert speed == pytest.approx(np.linalg.norm(particles.velocities, axis=1).max(), rel=1e-6)
    moves, gone = particles.velocities.copy(), np.arange(2500) % 3 == 0
    store.moves[:2500].assign(moves)
    store.gone[:2500].assign(gone.astype(np.uint8))
    assert store.judged(store.moves, store.gone) == (float(np.abs(moves).max()), int(gone.sum()))
    moves[LANES + 7, 1] = np.nan
    store.moves[:2500].assign(moves)
    assert np.isnan(store.judged(store.moves, store.gone)[0])


def test_what_leaves_and_what_is_surplus_is_what_the_host_takes_out():
    state = basin()
    store, walls, rng = state.store, state.walls, np.random.default_rng(2)
    before = state.particles.positions
    after = (before + rng.normal(0, 0.08, before.shape)).astype(np.float32)
    mainstream = np.array([1.0, 0.2, 0.0])
    expected = leaving(before, after, walls, mainstream)
    store.following("positions")[: store.count].assign(after)
    store.gone.zero_()
    place = [warp.vec3d(*GRID.low), warp.vec3d(*GRID.high), GRID.spacing]
    inputs = [store.field("positions"), store.following("positions"), state.region.regions, *place]
    inputs += [warp.vec3d(*mainstream), store.gone]
    warp.launch(warp_step_kernels.mark_leaving, store.count, inputs, device="cpu")
    assert 10 < expected.sum() < 0.5 * len(expected)
    np.testing.assert_array_equal(store.gone.numpy()[: store.count] != 0, expected)
    full = 0.15 * DENSITY * GRID.spacing**3
    more = outlet.surplus(state.particles.masses, state.order, walls.regions == CellType.OUTFLOW, full)
    assert more.sum() > 10
    inputs = [state.region.regions, state.ends, store.field("masses"), full, store.scratch, store.gone]
    warp.launch(warp_sorting_kernels.mark_surplus, GRID.shape, inputs, device="cpu")
    np.testing.assert_array_equal(store.gone.numpy()[: store.count] != 0, expected | more)


def test_a_displacement_on_faces_moves_particles_as_on_the_host():
    state, rng = basin(), np.random.default_rng(4)
    components = [rng.normal(0, 0.02, GRID.face_shape(a)).astype(np.float32) for a in range(3)]
    field = FaceVelocity(*components)
    r, store = state.region, state.store
    for name, values in zip("xyz", components):
        getattr(r.field, name).assign(values)
    store.total.zero_()
    inputs = [store.field("positions"), r.low, r.spacing, r.field, 0.03, store.total]
    warp.launch(warp_step_kernels.add_spread, store.count, inputs, device="cpu")
    expected = limited_moves(field, GRID, state.particles.positions, 0.03, state.order)
    np.testing.assert_allclose(store.total.numpy()[: store.count], expected, atol=1e-6)
    assert on_host(r.field)[0].shape == GRID.face_shape(0)
