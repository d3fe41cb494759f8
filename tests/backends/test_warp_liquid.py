"""A liquid whose whole substep is done by Warp (on its CPU device): the same liquid as on the host."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("warp", reason="the GPU back end, NVIDIA Warp, is not installed")

from fluidlift.backends.warp_liquid import WarpLiquid, WarpLiquids
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.physics.apic import SimulationSettings
from fluidlift.physics.emitter import Emitter, Supply
from fluidlift.physics.guidance import BodyForce, SteadyForce
from fluidlift.physics.inflow_schedule import InletPath
from fluidlift.physics.numba_particles import ParticleWork
from fluidlift.physics.rigid_body import RigidBody
from fluidlift.synthetic import tanks
from fluidlift.synthetic.filling import inside, terrain_of
from fluidlift.types import FaceVelocity, Grid


def on_device(tank, **options):
    simulator = tank.simulator(work=ParticleWork(liquid=WarpLiquids("cpu")), **options)
    assert simulator.on_host_because == ""
    return simulator


def dam():
    """Large enough that the viscosity of water is lost on its cells."""
    return tanks.dam_break(cells=8, width_cells=4, base=1.0)


def river():
    tank = tanks.river(cells=24)
    return replace(tank, parameters=replace(tank.parameters, inflow_fluctuation=0.2, wall_damping=0.5))


def tilted_pool():
    """Water at rest in a box whose floor and sides are turned by 20 degrees against the grid."""
    grid, angle = Grid((16, 6, 16), 0.1), np.radians(20.0)
    middle = np.array([0.8, 0.3, 0.8])
    axes = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])

    def solid(points):
        local = (points - middle) @ axes.T
        return np.minimum(0.5 - np.abs(local[..., 0]), local[..., 2] + 0.45)

    positions = inside(grid, lambda points: np.maximum(points[..., 2] - 0.85, -solid(points)), seed=1)
    fill = len(positions) * (0.5 * grid.spacing) ** 3
    terrain = terrain_of(grid, solid, (1.0, 0.0, 0.0))
    return tanks.tank_of("tilted pool", grid, positions, fill, size=1.0, terrain=terrain, kinematic_viscosity=1e-6)


def energy(particles):
    return float((particles.masses * np.square(particles.velocities).sum(axis=1)).sum(dtype=np.float64) / 2)


def level(particles):
    return float((particles.masses * particles.positions[:, 2]).sum(dtype=np.float64) / particles.masses.sum())


def honey():
    """So thick, and its walls so sticky, that viscosity counts in every way."""
    return tanks.honey_slope(cells=20)


def syrupy_river():
    tank = river()
    return replace(tank, parameters=replace(tank.parameters, kinematic_viscosity=0.02))


@pytest.mark.parametrize(("tank", "frames"), [(dam, 6), (river, 5), (tilted_pool, 4), (honey, 4), (syrupy_river, 4)])
@pytest.mark.parametrize("spread", [False, True])
def test_a_liquid_takes_the_steps_that_it_takes_on_the_host(tank, frames, spread):
    settings = SimulationSettings(spread_crowds=spread)
    host, device = tank().simulator(settings=settings), on_device(tank(), settings=settings)
    h = host.grid.spacing
    for _ in range(frames):
        ours, theirs = (s.advance(0.7 * s.parameters.time_step) for s in (device, host))
        assert (ours.substeps, ours.emitted, ours.removed) == (theirs.substeps, theirs.emitted, theirs.removed)
        assert ours.wet_volume == pytest.approx(theirs.wet_volume, rel=0.01, abs=1.5 * h**3)
    one, other = device.particles, host.particles
    np.testing.assert_array_equal(one.ids, other.ids)
    # single precision; viscosity is solved by other means, to 1e-5 of the momentum; crowds are spread by a rough
    # solution, of which a tenth may differ: 0.02 cells a step
    farthest, typical, share = (0.1, 5e-3, 1e-2) if spread else (5e-4, 5e-5, 1e-4)
    assert np.abs(one.positions - other.positions).max() < farthest * h
    assert np.sqrt(np.square(one.positions - other.positions).mean()) < typical * h
    assert device.volume == pytest.approx(host.volume, rel=1e-6)
    assert level(one) == pytest.approx(level(other), abs=share * h)
    assert energy(one) == pytest.approx(energy(other), rel=share)


def test_a_splash_stays_the_same_liquid_for_long():
    host, device = dam().simulator(), on_device(dam())
    for _ in range(12):
        for simulator in (host, device):
            simulator.advance(2.0 * simulator.parameters.time_step)
    one, other = device.particles, host.particles
    assert energy(other) > 100  # it runs along the floor
    assert len(one) == pytest.approx(len(other), rel=0.01)
    assert device.volume == pytest.approx(host.volume, rel=1e-5)
    assert energy(one) == pytest.approx(energy(other), rel=0.02)
    assert level(one) == pytest.approx(level(other), rel=0.01)


def test_a_steady_force_pushes_as_on_the_host():
    rng, grid = np.random.default_rng(0), dam().grid
    force = FaceVelocity(*(rng.normal(0, 3, grid.face_shape(a)).astype(np.float32) for a in range(3)))
    one, other = (make(dam(), forces=[SteadyForce(force)]) for make in (on_device, lambda t, **o: t.simulator(**o)))
    plain = dam().simulator()
    for simulator in (one, other, plain):
        simulator.advance(simulator.parameters.time_step)
    apart = np.abs(other.particles.positions - plain.particles.positions).max()
    assert apart > 1e-3 * grid.spacing
    assert np.abs(one.particles.positions - other.particles.positions).max() < 0.02 * apart


@pytest.mark.parametrize("tank", [dam, river])
def test_a_state_goes_on_bit_for_bit(tank):
    first = on_device(tank(), seed=3)
    for _ in range(3):
        first.advance(0.9 * first.parameters.time_step)
    state, ends = first.state(), []
    assert "head_rate" in state
    second = on_device(tank(), seed=3)
    second.restore(state)
    for simulator in (first, second):
        for _ in range(3):
            simulator.advance(0.9 * simulator.parameters.time_step)
        ends.append(simulator.state())
    assert ends[0].keys() == ends[1].keys()
    for name, value in ends[0].items():
        np.testing.assert_array_equal(value, ends[1][name], err_msg=name)


@pytest.mark.parametrize("viscosity", [1e-6, 0.05])
def test_an_emitter_fills_as_on_the_host(viscosity):
    tank = dam()
    tank = replace(tank, parameters=replace(tank.parameters, kinematic_viscosity=viscosity))
    mesh = RigidBody.sphere("tap", 0.3).mesh
    mesh = replace(mesh, vertices=mesh.vertices + np.array([2.6, 0.25, 1.4]))
    settings = SimulationSettings(spread_crowds=False)

    def supply():
        return Supply(emitters=(Emitter("tap", mesh, (1.5, 0.0, -1.0), start=0.03, end=0.3),))

    host, device = (
        tank.simulator(supply=supply(), settings=settings),
        on_device(tank, supply=supply(), settings=settings),
    )
    for _ in range(5):
        ours, theirs = (s.advance(1.2 * s.parameters.time_step) for s in (device, host))
        assert (ours.emitted, ours.substeps) == (theirs.emitted, theirs.substeps)
    assert len(host.particles) > len(tank.particles) + 100
    apart = np.abs(device.particles.positions - host.particles.positions) / tank.grid.spacing
    assert apart.max() < 2e-3
    again = on_device(tank, supply=supply(), settings=settings)
    again.restore(device.state())
    for simulator in (again, device):
        simulator.advance(4.0 * tank.parameters.time_step)  # beyond its end
    np.testing.assert_array_equal(again.particles.positions, device.particles.positions)


def test_the_same_start_gives_the_same_bits():
    ends = []
    for _ in range(2):
        simulator = on_device(river())
        simulator.advance(2.5 * simulator.parameters.time_step)
        ends.append(simulator.particles)
    for field in ("positions", "velocities", "affine", "deformation", "masses", "ids", "source"):
        np.testing.assert_array_equal(getattr(ends[0], field), getattr(ends[1], field))


def test_what_lies_in_drained_cells_is_taken_out():
    simulators = dam().simulator(), on_device(dam())
    for simulator in simulators:
        simulator.drains = np.zeros(simulator.grid.shape, bool)
        simulator.drains[:3] = True
        simulator.advance(simulator.parameters.time_step)
    host, device = simulators
    assert len(host.particles) < 0.9 * len(dam().particles)
    np.testing.assert_array_equal(device.particles.ids, host.particles.ids)
    assert device.drained == pytest.approx(host.drained, rel=1e-6)


def test_a_tank_that_begins_empty_fills():
    tank = river()
    tank = replace(tank, particles=tank.particles.select(np.zeros(0, int)))
    host, device = tank.simulator(), on_device(tank)
    for _ in range(2):
        ours, theirs = (s.advance(s.parameters.time_step) for s in (device, host))
    assert theirs.n_particles > 50
    assert (ours.n_particles, ours.emitted) == (theirs.n_particles, theirs.emitted)


def test_a_step_that_blows_up_leaves_the_state_as_it_was(monkeypatch):
    simulator = on_device(dam())
    simulator.advance(simulator.parameters.time_step)
    before = simulator.state()
    step = WarpLiquid.step

    def broken(self, dt, time):
        return replace(step(self, dt, time), farthest=float("nan"))

    monkeypatch.setattr(WarpLiquid, "step", broken)
    with pytest.raises(FluidliftError, match="blew up"):
        simulator.advance(simulator.parameters.time_step)
    after = simulator.state()
    for name in ("particles.ids", "particles.masses", "head_rate", "time"):
        assert np.sort(before[name], axis=None) == pytest.approx(np.sort(after[name], axis=None)), name


class Whim(BodyForce):
    """A force that no device knows."""

    def applied(self, velocity, masses, box, dt, time=0.0):
        return velocity


def test_the_host_keeps_what_the_device_cannot_do():
    work, tank = ParticleWork(liquid=WarpLiquids("cpu")), dam()
    ball = RigidBody.sphere("ball", 0.1)
    tense = replace(tank, parameters=replace(tank.parameters, surface_tension=0.07))
    still = InletPath(np.zeros(1), np.zeros((1, 3), int))
    reasons = {
        "surface tension": tense.simulator(work=work),
        "a force of its own kind": tank.simulator(work=work, forces=[Whim()]),
        "a prescribed outflow": tank.simulator(work=work, settings=SimulationSettings(prescribe_outflow=True)),
        "drops that fly": tank.simulator(work=work, settings=SimulationSettings(airy_above=0.5)),
        "an inlet that moves": tanks.river(cells=16).simulator(work=work, supply=Supply(path=still)),
        "rigid bodies": tanks.pool(cells=12).with_bodies(ball).simulator(work=work),
    }
    for reason, simulator in reasons.items():
        assert simulator.on_host_because == reason
        simulator.advance(0.5 * simulator.parameters.time_step)
        assert len(simulator.particles)


def test_a_state_of_another_grid_is_refused():
    simulator = on_device(dam())
    simulator.advance(simulator.parameters.time_step)
    state = simulator.state()
    state["head_first"] = np.array([1000, 0, 0])
    with pytest.raises(InputRejected, match="another grid"):
        simulator.restore(state)
