"""The grid half of a liquid's substep in Warp (on its CPU device): each kernel as its twin on the host."""

import importlib

import numpy as np
import pytest

pytest.importorskip("warp", reason="the GPU back end, NVIDIA Warp, is not installed")

import warp
from warp_states import DENSITY, GRID, basin, on_host, put_faces, random_velocity

from fluidlift.backends import warp_step_kernels
from fluidlift.backends.warp_forces import WarpForces
from fluidlift.backends.warp_inflow import WarpInflow
from fluidlift.backends.warp_liquid_grid import WarpOutlet, continue_velocity, deposit, lay_out
from fluidlift.backends.warp_particle_store import ParticleStore
from fluidlift.physics import boundaries, free_surface, outlet, transfer
from fluidlift.physics.boundaries import slide_along_walls
from fluidlift.physics.emitter import Supply
from fluidlift.physics.forces import add_gravity
from fluidlift.physics.guidance import Guiding, Nudging, SteadyForce
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.physics.inlet import Inlet
from fluidlift.physics.position_correction import fill_ratio
from fluidlift.types import CellType, FilmedMotion, FluidParameters


@pytest.fixture(scope="module")
def state():
    return basin()


def host_layout(state):
    surface = free_surface.liquid_surface(state.particles.positions, state.volumes, GRID, state.order, state.solids)
    holding = boundaries.liquid_cells(state.occupied, state.walls)
    own, distance = free_surface.pressure_cells(holding, surface.distance, state.walls.openings, GRID.spacing)
    types = np.where((holding == CellType.FLUID) & state.walls.buried, holding, own)
    films = (types == CellType.FLUID) & (own != CellType.FLUID)
    spray = np.float32(-free_surface.SPRAY_DEPTH * GRID.spacing)
    distance = np.where(films, np.minimum(distance, spray), distance)
    wet = (types == CellType.FLUID) | (types == CellType.INFLOW) | ((types == CellType.OUTFLOW) & state.occupied)
    return surface.distance, holding, types, distance, wet


def laid_out(state):
    r = state.region
    positions, masses = state.store.field("positions"), state.store.field("masses")
    deposit(r, positions, masses, state.ends, DENSITY)
    lay_out(r, state.counts)
    return r


def test_particles_reach_the_faces_as_on_the_host(state):
    r, store = state.region, state.store
    inputs = [store.field("positions"), *store.rows(), store.field("masses"), state.ends, r.low, r.spacing, r.shape]
    r.launch(warp_step_kernels.sum_over_particles, inputs, [r.carried, r.masses], faces=True)
    velocity, masses = transfer.particles_to_grid(state.particles, GRID, state.order)
    for ours, theirs in zip(on_host(r.masses), masses):
        np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=1e-6)
    for ours, theirs, mass in zip(on_host(r.carried), velocity.components, masses):
        np.testing.assert_allclose(ours[mass > 1e-3], theirs[mass > 1e-3], atol=2e-4)


def test_the_surface_and_the_crowds_are_where_the_host_finds_them(state):
    r = laid_out(state)
    expected = host_layout(state)[0]
    assert ((expected < 0).sum() > 100) and ((expected > 0).sum() > 100)
    np.testing.assert_allclose(r.surface.numpy(), expected, atol=2e-4 * GRID.spacing)
    ratio = fill_ratio(state.particles.positions, state.volumes, GRID, state.order, state.capacity)
    assert ratio.max() > 1.5
    np.testing.assert_allclose(r.crowd.numpy() / np.maximum(state.capacity, 0.25), ratio, atol=1e-5 * ratio.max())


def test_cells_hold_what_they_hold_on_the_host(state):
    r = laid_out(state)
    surface, holding, types, distance, wet = host_layout(state)
    assert {int(t) for t in np.unique(types)} == {int(t) for t in CellType}
    assert (holding != types).sum() > 10
    np.testing.assert_array_equal(r.holding.numpy(), holding)
    near = np.abs(surface) < 1e-5  # rounding decides there
    assert near.sum() < 3
    np.testing.assert_array_equal(r.types.numpy()[~near], types[~near])
    np.testing.assert_array_equal(r.wet.numpy()[~near] != 0, wet[~near])
    np.testing.assert_allclose(r.distance.numpy()[~near], distance[~near], atol=2e-4 * GRID.spacing)
    gaps = free_surface.surface_gaps(r.distance.numpy(), r.types.numpy())
    assert min(gap.min() for gap in gaps) < 0.5
    for ours, theirs in zip(on_host(r.gaps), gaps):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_a_velocity_goes_on_into_skin_air_and_walls_as_on_the_host(state):
    r = laid_out(state)
    velocity, carried = random_velocity(), random_velocity(2)
    _, masses = transfer.particles_to_grid(state.particles, GRID, state.order)
    put_faces(r.velocity, velocity.components)
    put_faces(r.carried, carried.components)
    put_faces(r.masses, masses)
    continue_velocity(r, r.velocity, 0.25)
    wet, holding, types = r.wet.numpy() != 0, r.holding.numpy(), r.types.numpy()
    openings = state.walls.openings
    faces = tuple(t & (o > 0) for t, o in zip(boundaries.touching_faces(wet), openings))
    skin = (holding == CellType.FLUID) & (types == CellType.EMPTY)
    assert skin.sum() > 10
    expected = free_surface.continue_velocity(velocity, carried, masses, faces, skin, openings)
    expected = slide_along_walls(expected, state.walls)
    for ours, theirs, opening in zip(on_host(r.final), expected.components, openings):
        assert (opening == 0).any()
        np.testing.assert_allclose(ours, np.where(opening == 0, 0.75 * theirs, theirs), atol=2e-6)


def test_the_columns_of_an_outlet_are_held_as_on_the_host(state):
    r = laid_out(state)
    pull, dt, start = 9.81, 0.01, np.full(GRID.shape[:2], -1.0)
    start[-1] = 5.3
    wet = r.wet.numpy() != 0
    levels = outlet.surface_heights(outlet.water_levels(wet, state.walls), r.surface.numpy(), GRID.spacing)
    heads = outlet.outlet_heads(levels, start, state.walls)
    assert heads is not None and (heads > 0).sum() > 10
    device = WarpOutlet(start, pull, r.device)
    device.find(r, dt)
    np.testing.assert_allclose(r.known.numpy(), heads * pull * dt, rtol=1e-5, atol=1e-8)
    velocity = random_velocity()
    put_faces(r.velocity, velocity.components)
    device.hold(r, r.velocity, dt)
    expected = outlet.hold_columns(velocity, heads * pull * dt, state.walls, weight=pull * GRID.spacing * dt)
    for ours, theirs in zip(on_host(r.velocity), expected.components):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def every_force():
    """One of each kind, with a memory of their own, in the order in which they act."""
    rates = tuple(np.abs(c) for c in random_velocity(4).components)
    frames = [random_velocity(seed) for seed in (6, 7, 8)]
    film = FilmedMotion(*(np.stack([f.components[a] for f in frames]) for a in range(3)), interval=0.05)
    nudging = Nudging(random_velocity(5), rates, after=0.03, gain=2.0, learning=0.1)
    return SteadyForce(random_velocity(3)), nudging, Guiding(film, rates)


@pytest.mark.parametrize("chosen", [(), (0,), (1,), (2,), (0, 1, 2)])
def test_forces_push_as_on_the_host(state, chosen):
    r, carried, gravity = state.region, random_velocity(), (0.3, 0.0, -9.81)
    _, masses = transfer.particles_to_grid(state.particles, GRID, state.order)
    put_faces(r.carried, carried.components)
    put_faces(r.masses, masses)
    ours, theirs = ([every_force()[n] for n in chosen] for _ in range(2))
    forces, box = WarpForces(ours, gravity, r.device), tuple(slice(0, n) for n in GRID.shape)
    for step in range(4):
        forces.apply(r, 0.02, 0.02 * step)
        expected = carried
        for force in theirs:
            expected = force.applied(expected, masses, box, 0.02, 0.02 * step)
        expected = add_gravity(expected, gravity, 0.02)
        for one, other in zip(on_host(r.velocity), expected.components):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=2e-6)
    for one, other in zip(ours, theirs):
        if isinstance(one, Nudging):
            assert np.abs(other.mean().u).max() > 0.1
            for mean, wanted in ((one.mean(), other.mean()), (one.behind(), other.behind())):
                for a, b in zip(mean.components, wanted.components):
                    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("profile", [None, random_velocity(5)])
def test_the_inlet_moves_faces_and_particles_as_on_the_host(state, profile):
    parameters = FluidParameters(inflow_velocity=(1.2, 0.1, -0.2), inflow_fluctuation=0.4)
    supply = Supply(InflowSchedule(((0.0, 0.5), (1.0, 2.0)), 0.2, 0.3))
    inlet = Inlet(state.walls, parameters, profile, 7, 8, supply)
    device = WarpInflow(inlet, GRID, state.region.device)
    velocity, time = random_velocity(), 0.37
    r, store = state.region, state.store
    put_faces(r.velocity, velocity.components)
    device.impose(r, r.velocity, time)
    expected = inlet.impose(velocity, time)
    assert any((e != v).any() for e, v in zip(expected.components, velocity.components))
    for ours, theirs in zip(on_host(r.velocity), expected.components):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)
    host = state.particles.velocities.copy(), state.particles.affine.copy()
    inlet.carry(state.particles.positions, *host, time)
    fields = [store.field("positions"), store.following("velocities"), store.following("affine")]
    fields[1][: store.count].assign(state.particles.velocities)
    fields[2][: store.count].assign(state.particles.affine)
    device.carry(r.regions, *fields, count=store.count, time=time)
    moved = (host[0] != state.particles.velocities).any(axis=1)
    assert moved.any() and not moved.all()
    np.testing.assert_allclose(fields[1].numpy()[: store.count], host[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(fields[2].numpy()[: store.count], host[1], atol=1e-6)


@pytest.mark.parametrize("bulk", [(1.2, 0.1, -0.2), (0.1, 0.9, 0.0), (0.0, 0.2, -0.7)])
def test_the_inlet_lacks_particles_where_it_does_on_the_host(state, bulk):
    inlet = Inlet(state.walls, FluidParameters(inflow_velocity=bulk), None, 7, 8)
    whole, device = state.whole, WarpInflow(inlet, GRID, state.region.device)
    thin = state.particles.select(np.arange(len(state.particles)) % 3 > 0)
    for step, particles in enumerate((state.particles, thin, thin.select(np.zeros(0, int)))):
        inlet.travel(0.013 * step)
        store = ParticleStore(state.region.device)
        store.upload(particles)
        store.reserve(1)
        found = device.lacking(whole, store.field("positions"), store.scratch, store.count)
        expected = inlet.missing(particles.positions, np.random.default_rng(1))
        assert len(found) > 20
        np.testing.assert_allclose(inlet.jittered(found, np.random.default_rng(1)), expected, atol=1e-6)


@pytest.mark.parametrize("name", ["surface", "layout", "velocity", "sorting", "step", "inlet", "force", "splat"])
def test_the_kernels_compile_for_a_gpu_that_is_not_here(name, tmp_path):
    module = importlib.import_module(f"fluidlift.backends.warp_{name}_kernels")
    paths = warp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    text = "".join(path.read_text() for path in paths)
    kernels = [k for k in vars(module).values() if isinstance(k, warp.Kernel) and k.module.name == module.__name__]
    assert ".target sm_90" in text and kernels and all(k.key in text for k in kernels)
