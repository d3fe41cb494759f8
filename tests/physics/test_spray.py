"""Spray over a pool: what is in the air is a share of liquid, and a pump throws up no more than it draws."""

import numpy as np
import pytest

from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.surroundings import SimulationSettings
from fluidlift.types import CellType, FluidParameters, Grid, Particles, Terrain, TriangleMesh

GRID = Grid((16, 16, 24), 0.1, (-0.8, -0.8, -0.4))
NO_MESH = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
SHARE = 0.1


def fountain(*, keeps: bool, airy: bool = True) -> LiquidSimulator:
    """A pool of 4 cells with a nozzle of 2 x 2 cells over it that throws up 1 m, and a block of spray beside it."""
    step = (np.arange(32) + 0.5) * 0.05
    x, y, z = np.meshgrid(step - 0.8, step - 0.8, (np.arange(8) + 0.5) * 0.05 - 0.4, indexing="ij")
    pool = np.stack([x, y, z], -1).reshape(-1, 3)
    block = np.stack(np.meshgrid(*[(np.arange(8) + 0.5) * 0.05] * 3, indexing="ij"), -1).reshape(-1, 3)
    start = np.concatenate([pool, block + [-0.7, -0.7, 0.4]]).astype(np.float32)
    cells = np.zeros(GRID.shape, np.uint8)
    cells[7:9, 7:9, 4:6] = CellType.INFLOW
    nodes = GRID.nodes()  # through an open foot the nozzle would draw up the pool itself
    pipe = np.maximum(np.abs(nodes[..., :2]).max(axis=-1) - 0.1, nodes[..., 2]).astype(np.float32)
    terrain = Terrain(GRID, pipe, np.array([0.0, 0.0, 1.0]), NO_MESH)
    found = LiquidSimulator(
        GRID, terrain, FluidParameters(inflow_velocity=(0.0, 0.0, 4.4), time_step=0.02), Particles.at_rest(start, 1.0),
        cell_types=cells, settings=SimulationSettings(airy_above=0.0 if airy else None, airy=SHARE),
    )  # fmt: skip
    if keeps:
        layer = np.zeros(GRID.shape, bool)
        layer[:, :, 3] = True
        found.keep_volume(layer)
    return found


def test_what_is_in_the_air_at_first_is_a_share_of_liquid_and_the_pool_is_whole():
    held = fountain(keeps=False).particles
    flies = held.positions[:, 2] > 0
    full = 1000.0 * 0.1**3 / 8
    assert held.masses[~flies].mean() == pytest.approx(full, rel=0.05)
    assert held.masses[flies].mean() == pytest.approx(SHARE * full, rel=0.05)
    whole = fountain(keeps=False, airy=False).particles
    assert whole.masses[whole.positions[:, 2] > 0].mean() == pytest.approx(full, rel=0.05)


def test_a_pool_that_is_thrown_up_keeps_its_volume():
    free, kept = fountain(keeps=False), fountain(keeps=True)
    before = free.volume
    for simulator in (free, kept):
        for _ in range(15):
            simulator.advance(0.04)
    entered = SHARE * 4 * 0.1**2 * 4.4 * 0.6
    assert free.volume - before > 0.7 * entered
    assert abs(kept.volume - before) <= 2 * 0.1**3  # to the cells that it is drawn from
    assert kept.particles.positions[:, 2].max() > 0.5  # and it flies


def test_drops_that_rise_and_fall_through_the_same_cells_do_not_brake_each_other():
    x, z = np.meshgrid((np.arange(16) + 0.5) * 0.05, (np.arange(4) + 0.5) * 0.05 + 0.6, indexing="ij")
    places = np.stack([x.ravel() - 0.4, np.zeros(x.size), z.ravel()], -1).astype(np.float32)
    speed = np.where(np.arange(len(places)) % 2 == 0, 2.0, -1.0).astype(np.float32)  # beside each other, m/s

    def after(airy_above: float | None) -> np.ndarray:
        start = Particles.at_rest(places, 1.0)
        start.velocities[:, 2] = speed
        terrain = Terrain(GRID, np.ones(GRID.nodes().shape[:3], np.float32), np.array([0.0, 0.0, 1.0]), NO_MESH)
        simulator = LiquidSimulator(
            GRID, terrain, FluidParameters(time_step=0.01), start, cell_types=np.zeros(GRID.shape, np.uint8),
            settings=SimulationSettings(airy_above=airy_above, airy=SHARE, reseed=False),
        )  # fmt: skip
        for _ in range(5):
            simulator.advance(0.02)
        held = simulator.particles
        return held.positions[np.argsort(held.ids), 2]

    fall = places[:, 2] + speed * 0.1 - 0.5 * 9.81 * 0.1**2
    assert np.abs(after(0.0) - fall).max() < 0.01  # m: of first order in steps of 0.01 s
    assert np.abs(after(None) - fall).mean() > 0.05  # through the grid they move together


def test_cells_to_draw_from_are_some_of_the_grid():
    with pytest.raises(ValueError, match="some of"):
        fountain(keeps=False).keep_volume(np.zeros(GRID.shape, bool))
