"""Still and sloshing water: rest, the dispersion relation of waves, volume, energy, units."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

from fluidlift.synthetic import tanks
from fluidlift.synthetic.gauges import Gauge
from fluidlift.types import GRAVITY as G
from fluidlift.types import Grid, Particles, Terrain

pytestmark = pytest.mark.usefixtures("single_thread")


def energy(particles: Particles, spacing: float) -> float:
    """J per (kg/m^3): kinetic, with the rotation and strain that particles carry in their affine matrix (Jiang et al.
    2015: h^2 / 4 is the inertia of the quadratic spline), and potential."""
    m = particles.masses.astype(np.float64)
    speed = np.square(particles.velocities.astype(np.float64)).sum(axis=1)
    inner = 0.25 * spacing**2 * np.square(particles.affine.astype(np.float64)).sum(axis=(1, 2))
    return float((0.5 * m * (speed + inner) + m * G * particles.positions[:, 2]).sum())


@pytest.mark.parametrize("depth", [0.4, 0.43, 0.47], ids=["whole cells", "0.3 cells more", "0.7 cells more"])
def test_still_water_stays_still_at_any_fill_height(depth):
    tank = tanks.standing_wave(cells=10, depth=depth, mode=0)
    h, gauge = tank.grid.spacing, Gauge.of(tank)
    simulator = tank.simulator()
    start = gauge.depth(simulator.particles)
    center = simulator.particles.positions.mean(axis=0, dtype=np.float64)
    for _ in range(5):
        report = simulator.advance(0.4)
    # bumps of the jittered surface (3 % of a cell) move at 0.03 sqrt(k g) h = 4 % of sqrt(g h) before they are gone
    assert report.max_speed < 0.04 * np.sqrt(G * h)
    moved = simulator.particles.positions.mean(axis=0, dtype=np.float64) - center
    assert np.abs(moved).max() < 0.02 * h  # what the bumps can lower the centre of mass by, and no more
    # the mean surface stays where the tank was filled to
    assert gauge.depth(simulator.particles).mean() == pytest.approx(start.mean(), abs=0.05 * h)
    assert report.n_particles == len(tank.particles) and report.removed == 0


def slosh(cells: int, *, mode: int = 1, amplitude: float = 0.03, periods: float = 2.5) -> tuple[float, float]:
    """Frequency over that of linear theory, and the share of the amplitude that is left after a period."""
    tank = tanks.standing_wave(cells=cells, mode=mode, amplitude=amplitude, width_cells=2)
    k = mode * np.pi / tank.size
    theory = np.sqrt(G * k * np.tanh(k * 0.5 * tank.size))
    period = 2 * np.pi / theory
    gauge, simulator = Gauge.of(tank), tank.simulator()
    times, heights = [0.0], [gauge.amplitude(simulator.particles, mode)]
    while simulator.time < periods * period:
        simulator.advance(period / 16)
        times.append(simulator.time)
        heights.append(gauge.amplitude(simulator.particles, mode))

    def swing(t, size, frequency, decay, phase):
        return size * np.exp(-decay * t) * np.cos(frequency * t + phase)

    found, _ = curve_fit(swing, times, heights, p0=[heights[0], theory, 0.1, 0.0], maxfev=4000)
    return float(found[1] / theory), float(np.exp(-found[2] * period))


@pytest.mark.parametrize("mode", [1, 2])
def test_a_tank_sloshes_at_the_frequency_of_linear_waves(mode):
    ratio, kept = slosh(32, mode=mode, amplitude=0.03 / mode)
    # omega^2 = g k tanh(k H). The waves have k a = 0.09: the finite amplitude slows them by (k a)^2 / 8 = 0.1 %; the
    # grid, with 32 cells per one or two half waves, by (k h)^2 / 24 < 0.2 %, and the splitting in time by as much.
    # The surface is known to a few hundredths of a cell of its 0.5 or 1 cell of amplitude: 2 %
    assert ratio == pytest.approx(1.0, abs=0.02)
    # water's viscosity takes 0.1 % per period; what the transfer between particles and grid takes must stay small
    assert kept > 0.93


def test_sloshing_gets_better_with_the_grid():
    coarse, fine = slosh(12), slosh(24)
    assert abs(fine[0] - 1) < max(abs(coarse[0] - 1), 0.01)
    # the loss per period falls with the cell width, first order or better (a third of slack for the fit)
    assert 1 - fine[1] < 0.5 * 1.33 * (1 - coarse[1])


def test_ten_seconds_of_sloshing_keep_the_volume_and_do_not_gain_energy():
    tank = tanks.standing_wave(cells=20, amplitude=0.08, width_cells=2)
    gauge, simulator = Gauge.of(tank), tank.simulator()
    k = np.pi / tank.size
    period = 2 * np.pi / np.sqrt(G * k * np.tanh(0.5 * k * tank.size))
    simulator.advance(0.1)  # the jitter of the start is gone
    volumes, energies = [], []
    while simulator.time < 10.0:
        volumes.append(gauge.volume(simulator.particles))
        energies.append(energy(simulator.particles, tank.grid.spacing))
        simulator.advance(period / 8)
    # over a whole period: the gauge rounds a steep wave, and velocities and places are known half a step apart
    volumes, energies = (np.convolve(x, np.full(8, 1 / 8), "valid") for x in (volumes, energies))
    # of the volume that the surface encloses; the masses of the particles never change
    assert np.abs(volumes / volumes[0] - 1).max() < 0.01
    # the wave has rho g a^2 / 4 of energy per area; none may appear out of nothing beyond 5 % of that
    wave = 0.25 * G * (0.08 * tank.size) ** 2 * tank.size * 2 * tank.grid.spacing * tank.parameters.density
    assert np.max(energies - np.minimum.accumulate(energies)) < 0.05 * wave


def in_other_units(tank: tanks.Tank, length: float, time: float) -> tanks.Tank:
    """The same flow with lengths and times given in other units (masses per volume stay)."""
    grid = Grid(tank.grid.shape, tank.grid.spacing * length, tuple(length * x for x in tank.grid.origin))
    terrain = Terrain(
        grid, tank.terrain.signed_distance * np.float32(length), tank.terrain.mainstream, tank.terrain.mesh
    )
    p = tank.parameters
    parameters = replace(
        p, gravity=tuple(g * length / time**2 for g in p.gravity),
        inflow_velocity=tuple(v * length / time for v in p.inflow_velocity),
        kinematic_viscosity=p.kinematic_viscosity * length**2 / time, time_step=p.time_step * time,
    )  # fmt: skip
    particles = Particles.at_rest(
        tank.particles.positions * np.float32(length), tank.particles.masses * length**3,
        velocities=tank.particles.velocities * np.float32(length / time),
    )  # fmt: skip
    return replace(tank, grid=grid, terrain=terrain, parameters=parameters, particles=particles)


@pytest.mark.parametrize("name", ["water", "honey", "inflow"])
def test_the_same_flow_in_other_units_is_the_same_flow(name):
    if name == "inflow":
        tank, duration = tanks.river(cells=24, length=2.0), 0.3
    else:
        tank, duration = tanks.dam_break(cells=6, width_cells=3), 0.12
        if name == "honey":
            tank = replace(tank, parameters=replace(tank.parameters, kinematic_viscosity=5e-4, wall_damping=1.0))
    # powers of two: scaling them is exact in floating point, so any difference is a number with a hidden unit
    length, time = 64.0, 4.0
    one, other = tank.simulator(), in_other_units(tank, length, time).simulator()
    one.advance(duration)
    other.advance(duration * time)
    assert len(one.particles) == len(other.particles)
    apart = np.abs(one.particles.positions - other.particles.positions / length).max()
    assert apart < 1e-4 * tank.grid.spacing  # a hundred roundings of single precision, not a chaotic divergence
