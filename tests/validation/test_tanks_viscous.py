"""Honey: it falls like water, turns like a solid, creeps as theory says, and its thin threads buckle."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.synthetic import filling, tanks
from fluidlift.synthetic.analytic import film_speed, on_faces, tilted_channel
from fluidlift.synthetic.gauges import Gauge
from fluidlift.types import GRAVITY as G
from fluidlift.types import CellType, FluidParameters, Grid, Particles

pytestmark = pytest.mark.usefixtures("single_thread")


def simulator_of(grid, positions, *, velocities=None, terrain=None, **parameters):
    particles = Particles.at_rest(positions, 1.0, velocities=velocities)
    return LiquidSimulator(
        grid, terrain or filling.terrain_of(grid), FluidParameters(**parameters), particles,
        cell_types=np.zeros(grid.shape, np.uint8),
    )  # fmt: skip


def test_a_falling_sheet_of_honey_falls_as_fast_as_a_stone_and_keeps_its_thickness():
    h = 0.01
    grid = Grid((14, 10, 40), h)
    positions = filling.inside(grid, lambda p: np.abs(p - [0.07, 0.05, 0.32]).max(axis=-1, initial=0.0) - 0.03)
    positions = positions[np.abs(positions[:, 0] - 0.07) < 0.0101]  # two cells thick
    simulator = simulator_of(grid, positions, kinematic_viscosity=0.05, time_step=0.01)
    duration = 0.2
    simulator.advance(duration)
    p = simulator.particles
    # nothing strains it and nothing rubs on it: air that is treated as a wall would hold it
    np.testing.assert_allclose(p.velocities[:, 2], -G * duration, rtol=0.01)
    assert np.abs(p.velocities[:, :2]).max() < 0.01 * G * duration
    # an irregular sample may be evened out once, which moves its rims by a tenth of a cell at most
    assert p.positions[:, 0].std() == pytest.approx(positions[:, 0].std(), rel=0.1)


@pytest.mark.parametrize("viscosity", [1e-6, 1.0], ids=["water", "very stiff honey"])
def test_viscosity_does_not_brake_a_body_that_turns_like_a_solid(viscosity):
    h, spin = 0.02, 1.0
    grid = Grid((24, 24, 10), h)
    middle = np.array([0.24, 0.24, 0.1])
    positions = filling.inside(
        grid, lambda p: np.maximum(np.hypot(*np.moveaxis(p - middle, -1, 0)[:2]) - 0.14, abs(p[..., 2] - 0.1) - 0.05)
    )
    r = positions - middle
    velocities = spin * np.column_stack([-r[:, 1], r[:, 0], 0 * r[:, 0]])
    simulator = simulator_of(
        grid, positions, velocities=velocities, gravity=(0, 0, 0), kinematic_viscosity=viscosity, time_step=0.02
    )
    p = simulator.particles
    p.affine[:, 0, 1], p.affine[:, 1, 0] = -spin, spin
    simulator._particles = p

    def momentum():
        p = simulator.particles
        x, v, c = (a.astype(np.float64) for a in (p.positions, p.velocities, p.affine))
        x = x - np.average(x, axis=0, weights=p.masses)
        own = 0.25 * h**2 * (c[:, 1, 0] - c[:, 0, 1])
        return float((p.masses * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0] + own)).sum())

    start = momentum()
    simulator.advance(0.5)
    # half a radian in 25 steps. The strain of a rotation is zero, whatever the viscosity; the rim in cells costs some
    assert momentum() == pytest.approx(start, rel=0.05)


def test_a_heap_of_honey_spreads_like_a_viscous_gravity_current():
    # Huppert 1982, J. Fluid Mech. 121, 43-58: half-width 1.411 (g q^3 t / 3 nu)^(1/5) with q m^2 on that side
    base, viscosity = 0.05, 0.02
    tank = tanks.dam_break(cells=16, base=base, aspect=1.0, length=4.0, width_cells=2)
    h = tank.grid.spacing
    floor = 2.4 * h
    grid = Grid((*tank.grid.shape[:2], tank.grid.shape[2] + 3), h)
    terrain = filling.terrain_of(grid, lambda p: p[..., 2] - floor)
    simulator = simulator_of(
        grid, tank.particles.positions + np.float32([0, 0, floor]), terrain=terrain, kinematic_viscosity=viscosity,
        wall_damping=1.0, time_step=0.02,
    )  # fmt: skip
    times, widths = [], []
    while simulator.time < 2.6:
        simulator.advance(0.2)
        times.append(simulator.time)
        widths.append(np.percentile(simulator.particles.positions[:, 0], 99.8))
    theory = 1.411 * (G * base**6 * np.array(times) / (3 * viscosity)) ** 0.2
    late = theory > 1.8 * base  # flat enough for lubrication theory: four times as long as high
    # the theory is that of a thin layer that starts from a point: a tenth at this aspect ratio; a cell is 2 % of it
    np.testing.assert_allclose(np.array(widths)[late], theory[late], rtol=0.1)
    rate = np.polyfit(np.log(np.array(times)[late]), np.log(np.array(widths)[late]), 1)[0]
    assert rate == pytest.approx(0.2, abs=0.05)


def test_a_film_on_a_slope_flows_as_nusselt_says():
    angle, thickness, viscosity = np.radians(20.0), 0.03, 0.02
    h = thickness / 8.4
    length = 0.20
    drop = length * np.tan(angle)
    foot = 0.008
    grid = Grid((round(length / h), 3, int(np.ceil((drop + foot + 1.6 * thickness) / h))), h)
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])

    def above(points):
        return (points - np.array([0.0, 0.0, foot + drop])) @ normal

    terrain = filling.terrain_of(grid, above, (np.cos(angle), 0.0, -np.sin(angle)))
    channel = tilted_channel(thickness=thickness, slope=angle, viscosity=viscosity, gravity=G, height=foot + drop)
    positions = filling.inside(grid, lambda p: np.maximum(above(p) - thickness, 0.1 * h - above(p)))
    mean = G * np.sin(angle) * thickness**2 / (3 * viscosity)
    along = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    centers = grid.centers()
    film = (above(centers) < thickness) & (above(centers) > 0)
    types = np.zeros(grid.shape, np.uint8)
    types[:2][film[:2]] = CellType.INFLOW
    types[-2:] = CellType.OUTFLOW
    particles = Particles.at_rest(positions, 1.0, velocities=channel(positions))
    parameters = FluidParameters(
        kinematic_viscosity=viscosity, wall_damping=1.0, inflow_velocity=tuple(mean * along), time_step=0.01
    )
    tank = tanks.Tank("film", grid, terrain, parameters, particles, types, thickness, 0.0)
    simulator = tank.simulator(inflow_profile=on_faces(channel, grid))
    simulator.advance(1.0)  # the middle is exchanged; the film settles in thickness^2 / nu = 0.05 s
    p = simulator.particles
    middle = np.abs(p.positions[:, 0] - 0.5 * length) < 0.15 * length
    height = above(p.positions[middle])
    speed = p.velocities[middle] @ along
    columns = Gauge.of(tank).depth(p).mean(axis=1)
    x = (np.arange(len(columns)) + 0.5) * 0.5 * h
    depth = columns[np.abs(x - 0.5 * length) < 0.15 * length].mean() * np.cos(angle)
    # what the inlet lets in: its cells are whole, the film is not
    assert np.mean(speed) == pytest.approx(mean, rel=0.06)
    # Nusselt 1916: the flux q takes a depth of (3 nu q / g sin)^(1/3); two tenths of a cell of 8.4 are 2.4 %
    assert depth == pytest.approx(np.cbrt(3 * viscosity * np.mean(speed) * depth / (G * np.sin(angle))), rel=0.03)
    # the profile: no slip at the bed, no shear at the surface
    truth = film_speed(height, thickness=depth, slope=angle, viscosity=viscosity, gravity=G)
    truth[height > depth] = truth.max()  # the surface is rough by a fraction of a cell
    shape = speed / np.mean(speed) - truth / truth.mean()
    assert np.sqrt(np.mean(shape**2)) < 0.06


def sway(viscosity: float) -> tuple[float, float]:
    """Largest lateral deflection of the falling thread's middle in radii, and the width of the heap below in radii."""
    radius = 0.003
    tank = tanks.thread(cells=24, width=0.036, height=0.045, radius=radius, viscosity=viscosity, speed=0.15)
    plate = 2.5 * tank.grid.spacing
    simulator = tank.simulator()
    largest, heap = 0.0, 0.0
    while simulator.time < 0.6:
        simulator.advance(0.02)
        x = simulator.particles.positions
        band = x[(x[:, 2] > plate + 3.5 * radius) & (x[:, 2] < plate + 6.5 * radius)]
        if len(band) > 20:
            largest = max(largest, float(np.hypot(*band[:, :2].mean(axis=0))))
        low = x[x[:, 2] < plate + 2.0 * radius]
        if len(low) > 20:
            heap = float(np.sqrt(2.0) * np.hypot(*(low[:, :2] - low[:, :2].mean(axis=0)).std(axis=0)))
    return largest / radius, heap / radius


def test_a_thread_of_honey_buckles_and_one_of_water_does_not():
    honey, heap = sway(2e-2)
    water, puddle = sway(1e-6)
    # viscous stress, with no traction at the free surface, turns the thread aside where the plate stops it (Taylor
    # 1969): it lays itself down in loops wider than itself. The inertia of water only spreads it
    assert honey > 0.5
    assert water < 0.25
    # liquid that covers the square plate evenly has a width of sqrt(2) rms = side / sqrt(3): water has run to the
    # walls, honey heaps up
    even = 0.036 / 0.003 / np.sqrt(3.0)
    assert heap < 0.65 * even
    assert puddle > 0.7 * even


def test_honey_on_a_slope_sticks_to_the_board():
    tank = tanks.honey_slope(cells=32)
    first = tank.simulator().particles

    def moved(simulator):
        """How far each of the first particles that is still there has gone, and how high it was above the board."""
        now = simulator.particles
        _, before, after = np.intersect1d(first.ids, now.ids, return_indices=True)
        start = first.positions[before]
        height = sample_nodes(tank.terrain.signed_distance, tank.grid, start) / tank.grid.spacing
        return np.linalg.norm(now.positions[after] - start, axis=1), height

    simulator = tank.simulator()
    simulator.advance(0.2)
    way, height = moved(simulator)
    early = np.median(way)
    simulator.advance(0.3)
    way, height = moved(simulator)
    # the lowest half cell hardly leaves its place while the top slides over it
    assert np.median(way[height < 0.5]) < 0.35 * np.median(way[height > 3.0])
    water = replace(tank, parameters=replace(tank.parameters, kinematic_viscosity=1e-6, wall_damping=0.0)).simulator()
    water.advance(0.2)
    assert early < 0.5 * np.median(moved(water)[0])
