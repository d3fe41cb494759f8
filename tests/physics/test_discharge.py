"""A jet of which only a share is liquid: as fast and as wide as it was filmed, with the discharge that is known."""

import numpy as np
import pytest

from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.refill import Refill
from fluidlift.physics.stepping import ARRIVED
from fluidlift.physics.surroundings import SimulationSettings
from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidParameters,
    Grid,
    Particles,
    PinholeCamera,
    Terrain,
    TriangleMesh,
)

GRID = Grid((8, 8, 40), 0.05)
NO_MESH = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
SPEED = 2.0
"""m/s at the inlet"""


def jet(discharge_speed: float | None, speed: float = SPEED) -> LiquidSimulator:
    """A jet of 4 x 4 cells that falls out of its inlet through 1.8 m of air."""
    cells = np.zeros(GRID.shape, np.uint8)
    cells[2:6, 2:6, -2:] = CellType.INFLOW
    cells[:, :, :2] = CellType.OUTFLOW
    terrain = Terrain(GRID, np.full((9, 9, 41), 10.0, np.float32), np.array([0.0, 0.0, -1.0]), NO_MESH)
    parameters = FluidParameters(inflow_velocity=(0.0, 0.0, -speed), time_step=0.02)
    return LiquidSimulator(
        GRID, terrain, parameters, Particles.at_rest(np.zeros((0, 3)), 1.0), cell_types=cells,
        settings=SimulationSettings(discharge_speed=discharge_speed),
    )  # fmt: skip


def layers(simulator: LiquidSimulator) -> np.ndarray:
    """Particles in each layer of cells between the inlet and the outlet, the highest first."""
    at = GRID.cell_of(simulator.particles.positions)[:, 2]
    return np.bincount(at, minlength=40)[3:37][::-1]


def test_what_comes_in_is_the_discharge_whatever_the_speed():
    simulator = jet(0.25)
    for _ in range(3):
        simulator.advance(0.04)
    before = simulator.volume
    simulator.advance(0.2)
    # nothing has come to the outlet yet; a layer of particles (half a cell of 16) may be on its way
    entered = 16 * 0.05**2 * 0.25 * 0.2
    assert simulator.volume - before == pytest.approx(entered, abs=16 * 0.05**2 * 0.025 * 0.25 / SPEED)


def test_a_jet_as_fast_as_filmed_has_no_gaps_where_one_that_creeps_in_tears():
    """The same discharge: at its own speed over the section, free fall draws out what comes in to an eighth."""
    fast, creeping = jet(0.25), jet(None, speed=0.25)
    for simulator in (fast, creeping):
        for _ in range(24):
            simulator.advance(0.04)
    assert layers(fast).min() >= 8, "of 128 in a layer of the inlet"
    assert layers(creeping)[8:].min() < 8
    assert layers(fast).std() / layers(fast).mean() < 0.8
    # A v is constant along it: from 2 m/s to 6 m/s the number per layer falls to a third
    top, bottom = layers(fast)[:4].mean(), layers(fast)[-4:].mean()
    speed = np.sqrt(SPEED**2 + 2 * 9.81 * np.array([0.1, 1.6]))
    assert bottom / top == pytest.approx(speed[0] / speed[1], rel=0.25)


def test_a_body_that_falls_is_liquid_by_its_discharge_over_its_speed_and_one_that_has_arrived_is_whole():
    simulator = jet(0.25)
    speeds = np.array([0.9 * ARRIVED * SPEED, SPEED, 2.0 * SPEED])
    share = simulator._liquid_share(np.outer(speeds, [0.0, 0.0, -1.0]))
    np.testing.assert_allclose(share, [1.0, 0.125, 0.0625])
    np.testing.assert_array_equal(jet(None)._liquid_share(np.ones((2, 3))), [1.0, 1.0])
    simulator.advance(0.04)
    # eight particles stand for a cell
    np.testing.assert_allclose(simulator.particles.masses, 1000.0 * 0.05**3 / 8 * 0.125, rtol=1e-5)


def test_what_is_put_in_where_a_jet_ran_dry_counts_by_the_same_share():
    simulator = jet(0.25)
    simulator.advance(0.04)
    falls = FaceVelocity(*(np.full(GRID.face_shape(a), v, np.float32) for a, v in enumerate((0.0, 0.0, -SPEED))))
    body = Particles.at_rest(GRID.centers()[2:6, 2:6, 10:30].reshape(-1, 3), 1.0)
    camera = PinholeCamera.looking((0.2, -4.0, 1.0), (0.2, 0.2, 1.0), 40.0, (80, 80))
    terrain = Terrain(GRID, np.full((9, 9, 41), 10.0, np.float32), np.array([0.0, 0.0, -1.0]), NO_MESH)
    simulator.refill = Refill(np.ones(GRID.shape, bool), falls, body, terrain, camera)
    before, count = simulator.volume, len(simulator.particles)
    added = simulator._fill_dry()
    assert added == len(simulator.particles) - count > 1000
    assert simulator.refilled == pytest.approx(simulator.volume - before, rel=1e-4)
    assert simulator.refilled == pytest.approx(added * 0.05**3 / 8 * 0.125, rel=1e-4)
