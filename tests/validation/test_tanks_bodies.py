"""Bodies in liquids: Archimedes, sinking, Stokes, displacement, pistons."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.physics.rigid import RigidBody, Trajectory
from fluidlift.synthetic import tanks
from fluidlift.synthetic.gauges import Gauge
from fluidlift.types import GRAVITY as G

pytestmark = pytest.mark.usefixtures("single_thread")


def level(gauge: Gauge, simulator, beyond: float) -> float:
    """m, of the water farther than `beyond` from the middle of the pool along x or y."""
    depth = gauge.depth(simulator.particles)
    x, y = np.moveaxis(gauge.fine.centers()[:, :, 0, :2], -1, 0)
    return float(depth[np.maximum(np.abs(x), np.abs(y)) > beyond].mean())


@pytest.mark.parametrize("density", [300.0, 500.0, 800.0])
def test_a_floating_box_sinks_in_as_deep_as_archimedes_says(density):
    size = np.array([0.25, 0.25, 0.2])  # 8 and 6.6 cells
    tank = tanks.pool(cells=20, width=0.64, depth=0.5)
    draft = density / 1000.0 * size[2]
    # half a cell too high: it bobs and comes to rest
    start = 0.32 - draft + 0.5 * size[2] + 0.5 * tank.grid.spacing
    tank = tank.with_bodies(RigidBody.box("box", size, density=density, position=(0.0, 0.0, start)))
    gauge, simulator = Gauge.of(tank), tank.simulator()
    simulator.advance(2.5)
    found, upright = [], []
    for _ in range(8):
        simulator.advance(0.125)  # over two or three periods of bobbing, 2 pi sqrt(draft / g) and more
        bottom = simulator.bodies.center[0, 2] - 0.5 * size[2]
        found.append(level(gauge, simulator, 0.125 + 2 * tank.grid.spacing) - bottom)
        upright.append(abs(simulator.bodies.rotation[0, 2, 2]))
    assert np.mean(found) == pytest.approx(draft, abs=0.05 * size[2])
    # broader than high and lighter than water: upright is stable (metacentre above the centre of mass)
    assert min(upright) > 0.98


def test_a_dipped_body_raises_the_water_by_what_it_displaces():
    width = 0.64
    tank = tanks.pool(cells=20, width=width, depth=0.4)
    still = Gauge.of(tank).depth(tank.particles).mean()
    lowered = Trajectory(
        np.array([0.0, 0.8, 2.0]), np.array([[0, 0, 0.45], [0, 0, 0.13], [0, 0, 0.13]]), np.tile([1.0, 0, 0, 0], (3, 1))
    )
    body = RigidBody.sphere("ball", 0.11, motion="animated", trajectory=lowered)
    tank = tank.with_bodies(body)
    gauge, simulator = Gauge.of(tank), tank.simulator()
    simulator.advance(2.0)
    volume = 4.0 / 3.0 * np.pi * 0.11**3
    levels = []
    for _ in range(4):
        simulator.advance(0.2)  # the water swings with a period of 0.9 s
        levels.append(level(gauge, simulator, 0.2))
    # 13.6 mm, 0.43 cells; a tenth of a cell is what the gauge resolves over the pool
    assert np.mean(levels) - still == pytest.approx(volume / width**2, abs=0.1 * tank.grid.spacing)
    assert not simulator.bodies.inside(simulator.particles.positions).any()


def test_a_heavy_ball_falls_through_water_with_its_added_mass():
    radius, density = 0.08, 2500.0
    tank = tanks.pool(cells=24, width=0.72, depth=1.2)
    h = tank.grid.spacing
    tank = tank.with_bodies(RigidBody.sphere("ball", radius, density=density, position=(0.0, 0.0, 0.62)))
    gauge, simulator = Gauge.of(tank), tank.simulator()
    times, heights = [0.0], [0.62]
    while simulator.time < 0.3:
        simulator.advance(0.03)
        times.append(simulator.time)
        heights.append(simulator.bodies.center[0, 2])
    times, fallen = np.array(times), 0.62 - np.array(heights)
    # (rho_s - rho_f) g / (rho_s + rho_f / 2): half of the displaced water moves with the ball (Stokes 1843), and a
    # little more between walls at 4.5 radii: (1 + 3 (R / L)^3) at most
    theory = (density - 1000.0) * G / (density + 500.0)
    found = 2 * np.polyfit(times[2:] ** 2, fallen[2:], 1)[0]
    assert found == pytest.approx(theory, rel=0.1)
    simulator.advance(0.9)
    ball = simulator.bodies
    assert ball.center[0, 2] == pytest.approx(radius, abs=0.5 * h)  # it lies on the floor
    assert np.abs(ball.velocity[0]).max() < 0.1 * np.sqrt(G * h)
    assert gauge.depth(simulator.particles).mean() > 0  # the pool is still there
    assert not ball.inside(simulator.particles.positions).any()


@pytest.mark.parametrize("density", [2800.0, 700.0], ids=["denser than honey", "lighter than honey"])
def test_a_ball_moves_through_honey_at_the_speed_of_stokes(density):
    # terminal velocity 2/9 (rho_s / rho_f - 1) g R^2 / nu, Reynolds number below 0.2
    radius, viscosity, fluid = 0.03, 0.05, 1400.0
    tank = tanks.pool(cells=22, width=0.22, depth=1.1, viscosity=viscosity)
    tank = replace(tank, parameters=replace(tank.parameters, density=fluid, wall_damping=1.0, time_step=0.02))
    tank = tank.with_bodies(RigidBody.sphere("ball", radius, density=density, position=(0.0, 0.0, 0.12)))
    simulator = tank.simulator()
    speeds = []
    for _ in range(6):
        simulator.advance(0.05)
        speeds.append(simulator.bodies.velocity[0, 2])
    theory = -2.0 / 9.0 * (density / fluid - 1.0) * G * radius**2 / viscosity
    # walls at 3.7 radii, even frictionless ones, take about a third of the speed (Happel and Brenner 1965, chapter 7);
    # three cells of radius leave a fifth. Without viscous drag the ball would be ten times as fast
    assert 0.4 * abs(theory) < abs(np.mean(speeds[-2:])) < 1.1 * abs(theory)
    assert np.sign(speeds[-1]) == np.sign(theory)


def test_a_piston_pushes_the_water_ahead_and_none_gets_past():
    tank = tanks.standing_wave(cells=32, length=1.28, depth=0.25, mode=0, width_cells=4)
    h, speed = tank.grid.spacing, 0.15
    thickness = 1.6 * h
    width = 6 * h  # wider than the tank: it seals
    height = tank.grid.high[2] - tank.grid.low[2] + 4 * h
    path = Trajectory(
        np.array([0.0, 2.0]), np.array([[0.15, 2 * h, 0.2], [0.45, 2 * h, 0.2]]), np.tile([1.0, 0, 0, 0], (2, 1))
    )
    plate = RigidBody.box("piston", np.array([thickness, width, height]), motion="animated", trajectory=path)
    tank = tank.with_bodies(plate)
    simulator = tank.simulator()
    start = simulator.particles
    behind = start.ids[start.positions[:, 0] < 0.15]
    simulator.advance(2.0)
    p, face = simulator.particles, simulator.bodies.center[0, 0]
    assert face == pytest.approx(0.45, abs=1e-6)
    ours = np.isin(p.ids, behind)
    assert p.positions[ours, 0].max() < face  # those behind stay behind
    first = p.ids < start.ids.max()
    assert p.positions[first & ~ours, 0].min() > face  # and those in front in front
    # the water in front has nowhere to go but up: its mean level rises as the piston takes its room
    depth = Gauge.of(tank).depth(p).mean(axis=1)
    x = (np.arange(len(depth)) + 0.5) * 0.5 * h
    front = depth[x > face + thickness].sum() * 0.5 * h
    assert front == pytest.approx(0.32 * (1.28 - 0.15 - 0.5 * thickness), rel=0.06)
    assert speed < np.sqrt(G * 0.32)  # slower than the waves: no bore


def test_a_ball_on_a_thread_of_nothing_floats_up_and_gains_no_energy():
    tank = tanks.pool(cells=20, width=0.6, depth=0.8)
    ball = RigidBody.sphere("ball", 0.09, density=300.0, position=(0.02, -0.01, 0.15))
    tank = tank.with_bodies(ball)
    simulator = tank.simulator()
    mass = 300.0 * 4.0 / 3.0 * np.pi * 0.09**3

    def energy():
        p, b = simulator.particles, simulator.bodies
        m = p.masses.astype(np.float64)
        motion = 0.5 * np.square(p.velocities.astype(np.float64)).sum(axis=1)
        return float((m * (motion + G * p.positions[:, 2])).sum() + b.energy.sum() + mass * G * b.center[0, 2])

    start, highest = energy(), 0.0
    driven = (1000.0 / 300.0 - 1.0) * mass * G * 0.33  # what buoyancy can give on the way up
    for _ in range(12):
        simulator.advance(0.1)
        highest = max(highest, energy() - start)
    # rounding of the surface by the jitter is worth a few per cent of it
    assert highest < 0.05 * driven
    assert simulator.bodies.center[0, 2] > 0.4  # it is up
    assert not simulator.bodies.inside(simulator.particles.positions).any()
