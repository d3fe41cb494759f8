"""The liquid simulator's surface: waves, level water, surface tension."""

import numpy as np
import pytest
from scipy.optimize import curve_fit

from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.surface_tension import capillary_time_step
from fluidlift.types import FluidParameters, Grid

GRAVITY = 9.81


def rms_speed(simulator):
    v = simulator.particles.velocities.astype(np.float64)
    return float(np.sqrt(np.square(v).sum(axis=1).mean()))


def damped_cosine(t, amplitude, frequency, decay, phase, offset):
    return amplitude * np.exp(-decay * t) * np.cos(2 * np.pi * frequency * t + phase) + offset


def fitted(times, values):
    """Frequency and decay of an oscillation whose expected period is 1."""
    start = [values[0], 1.0, 0.05, 0.0, 0.0]
    (_, frequency, decay, _, _), _ = curve_fit(damped_cosine, times, values, p0=start)
    return abs(frequency), decay


@pytest.mark.parametrize("mode, amplitude", [(1, 0.5), (3, 0.5)])
def test_standing_waves_swing_as_linear_theory_says(scene, mode, amplitude):
    cells, depth = 48, 0.26
    h = 1.0 / cells
    grid = Grid((cells, 4, 20), h)
    k = mode * np.pi
    period = 2 * np.pi / np.sqrt(GRAVITY * k * np.tanh(k * depth))
    particles = scene.body(grid, lambda p: p[:, 2] < depth)
    x, z = particles.positions[:, 0].astype(float), particles.positions[:, 2].astype(float)
    push = amplitude * h / np.sinh(k * depth)
    particles.positions[:, 0] = x - push * np.sin(k * x) * np.cosh(k * z)
    particles.positions[:, 2] = z + push * np.cos(k * x) * np.sinh(k * z)
    simulator = LiquidSimulator(
        grid, scene.terrain(grid), FluidParameters(time_step=period / 60), particles, cell_types=scene.cells(grid)
    )

    def height():
        p = simulator.particles
        return float(np.average(np.cos(k * p.positions[:, 0]), weights=p.masses))

    times, heights = [0.0], [height()]
    while simulator.time < 1.5 * period:
        simulator.advance(period / 20)
        times.append(simulator.time / period)
        heights.append(height())
    frequency, decay = fitted(np.array(times), np.array(heights))
    # half a cell high: with its surface in whole cells the water does not swing at all. Measured: 1.000, 0.995; decay
    # 0.00 and 0.01
    assert frequency == pytest.approx(1.0, abs=0.03)
    assert -0.03 < decay < 0.08


@pytest.mark.parametrize("degrees", [10, 35])
def test_water_in_a_tilted_box_comes_to_rest(scene, degrees):
    h = 0.1
    grid = Grid((16, 6, 14), h)
    up = np.array([-np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])
    particles = scene.body(grid, lambda p: (p - np.array([0.8, 0.0, 0.6])) @ up < 0)
    parameters = FluidParameters(gravity=tuple(-GRAVITY * up), time_step=0.02)
    simulator = LiquidSimulator(grid, scene.terrain(grid), parameters, particles, cell_types=scene.cells(grid))
    simulator.advance(1.0)
    fastest = max(simulator.advance(0.1).max_speed for _ in range(5))
    # measured 0.03 and 0.008, 0.003; with a surface in whole cells 0.2 and 0.035. A wave as high as a
    # particle's share of a cell moves at 0.7 m/s
    assert fastest < 0.1 and rms_speed(simulator) < 0.015


def test_water_on_a_beach_comes_to_rest(scene):
    h, slope = 0.1, 0.577
    grid = Grid((16, 8, 12), h)
    x = grid.nodes()
    terrain = scene.terrain(grid, (x[..., 2] - 0.13 - slope * (x[..., 0] - 0.6)) / np.sqrt(1 + slope**2))
    particles = scene.body(grid, lambda p: p[:, 2] < 0.62, terrain=terrain)
    simulator = LiquidSimulator(grid, terrain, FluidParameters(time_step=0.02), particles, cell_types=scene.cells(grid))
    speeds = [simulator.advance(0.1).max_speed for _ in range(25)]
    # the lattice leaves out the last particles of the wedge; the waves of that, hundredths of a cell high, run out.
    # Velocities continued from slivers of faces would grow at the shore line to 5 m/s in the first second
    assert max(speeds) < 0.7 and max(speeds[-5:]) < 0.25 and rms_speed(simulator) < 0.03
    p = simulator.particles.positions
    top = [np.percentile(p[(p[:, 0] > a) & (p[:, 0] < a + 0.2), 2], 98) for a in (0.0, 0.4, 0.8)]
    assert np.ptp(top) < 0.25 * h


DROP = {"density": 1000.0, "surface_tension": 0.072, "gravity": (0.0, 0.0, 0.0)}
MILLIMETRE = 1e-3


def drop(scene, radius, stretch=0.0):
    """A drop, stretched along z at constant volume; and its radius after sampling (m), in weightlessness."""
    n = int(2 * radius * (1 + stretch)) + 8
    grid = Grid((n, n, n), MILLIMETRE)
    center = (n / 2 + np.array([0.13, -0.21, 0.07])) * MILLIMETRE
    scales = np.array([(1 + stretch) ** -0.5, (1 + stretch) ** -0.5, 1 + stretch])

    def inside(p):
        return np.linalg.norm((p - center) / scales, axis=1) < radius * MILLIMETRE

    simulator = LiquidSimulator(
        grid, scene.terrain(grid), FluidParameters(time_step=0.1, **DROP), scene.body(grid, inside),
        cell_types=scene.cells(grid),
    )  # fmt: skip
    return simulator, (0.75 * simulator.volume / np.pi) ** (1 / 3)


def test_a_round_drop_holds_the_pressure_of_laplace_and_rests(scene):
    simulator, radius = drop(scene, 5.0)
    tension, density = DROP["surface_tension"], DROP["density"]
    swing = 2 * np.pi / np.sqrt(8 * tension / (density * radius**3))
    report = simulator.advance(swing)
    steps = swing / report.substeps
    assert steps <= capillary_time_step(density, tension, MILLIMETRE)
    first, rate = simulator._liquid.head_rate
    center = (np.asarray(simulator.grid.shape) // 2 - np.asarray(first)).astype(int)
    pressure = density * rate[tuple(center)]
    assert pressure == pytest.approx(2 * tension / radius, rel=0.03)
    # particles on a lattice make a rough ball, which swings a little; in speeds of the drop's own swinging
    assert rms_speed(simulator) < 0.05 * np.sqrt(tension / (density * radius))


def test_a_stretched_drop_swings_with_the_period_of_rayleigh(scene):
    simulator, radius = drop(scene, 5.0, stretch=0.1)
    period = 2 * np.pi / np.sqrt(8 * DROP["surface_tension"] / (DROP["density"] * radius**3))
    times, shapes = [], []
    while simulator.time < 1.5 * period:
        simulator.advance(period / 20)
        p = simulator.particles
        x = p.positions - np.average(p.positions, axis=0, weights=p.masses)
        times.append(simulator.time / period)
        shapes.append(
            float(np.average(x[:, 2] ** 2 - 0.5 * (x[:, 0] ** 2 + x[:, 1] ** 2), weights=p.masses)) / radius**2
        )
    frequency, decay = fitted(np.array(times), np.array(shapes))
    # measured 0.94: the blur of the surface, 0.9 cells wide, weakens the forces on a drop of 5 cells' radius
    assert frequency == pytest.approx(1.0, abs=0.1) and 0 < decay < 0.25
