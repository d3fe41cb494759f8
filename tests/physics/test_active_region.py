"""The region of a substep: it holds what matters, and changes nothing."""

import numpy as np

from fluidlift.physics.active_region import BLOCK, MARGIN, crop_walls, face_box, moved_to, region_around
from fluidlift.physics.apic import LiquidSimulator, SimulationSettings
from fluidlift.physics.boundaries import build_walls
from fluidlift.types import CellType, FluidParameters, Grid, Particles, Terrain, TriangleMesh

GRID = Grid((40, 33, 20), 0.1, (1.0, -2.0, 0.5))


def terrain_on(grid, distance):
    return Terrain(
        grid, np.float32(distance), np.array([1.0, 0, 0]), TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    )


def test_the_region_holds_all_particles_with_a_margin_and_stays_in_the_box():
    rng = np.random.default_rng(0)
    for low, high in (([2.0, -1.0, 1.0], [2.4, -0.5, 1.2]), ([1.0, -2.0, 0.5], [5.0, 1.29, 2.49])):
        points = rng.uniform(low, high, (9000, 3)).astype(np.float32)
        box = region_around(points, GRID)
        cells = GRID.cell_of(points)
        for axis, side in enumerate(box):
            assert 0 <= side.start and side.stop <= GRID.shape[axis]
            assert side.start == 0 or side.start <= cells[:, axis].min() - MARGIN
            assert side.stop == GRID.shape[axis] or side.stop > cells[:, axis].max() + MARGIN
            assert side.start % BLOCK == 0 and (side.stop % BLOCK == 0 or side.stop == GRID.shape[axis])


def test_cells_that_must_be_kept_are_kept():
    points = np.array([[4.5, 1.0, 2.0]], np.float32)
    box = region_around(points, GRID, (np.array([0, 3, 1]), np.array([2, 5, 4])))
    assert [s.start for s in box] == [0, 0, 0]


def test_cropped_walls_are_those_of_a_box_of_that_size():
    distance = np.linalg.norm(GRID.nodes() - np.array([3.0, -0.5, 1.2]), axis=-1) - 0.5
    types = np.zeros(GRID.shape, np.uint8)
    types[10:12, 9:13, 4:8] = CellType.OUTFLOW
    walls = build_walls(terrain_on(GRID, distance), types, np.zeros((3, 2), bool))
    box = (slice(8, 32), slice(0, 24), slice(0, 16))
    inner = crop_walls(walls, box)
    np.testing.assert_allclose(inner.grid.centers(), GRID.centers()[box], atol=1e-12)
    np.testing.assert_array_equal(inner.regions, walls.regions[box])
    for axis in range(3):
        assert inner.openings[axis].shape == inner.grid.face_shape(axis)
        np.testing.assert_array_equal(inner.openings[axis], walls.openings[axis][face_box(box, axis)])


def test_moved_values_keep_their_cells():
    whole = np.random.default_rng(1).normal(size=(30, 30, 30))
    old = whole[8:24, 0:16, 4:20]
    new = moved_to(old, (8, 0, 4), (16, 8, 0), (14, 20, 12))
    expected = np.zeros((14, 20, 12))
    expected[:8, :8, 4:] = whole[16:24, 8:16, 4:12]
    np.testing.assert_array_equal(new, expected)
    assert not moved_to(old, (0, 0, 0), (40, 40, 40), (5, 5, 5)).any()


def test_a_larger_box_does_not_change_the_liquid():
    h = 0.05
    results = []
    for cells in ((16, 16, 24), (48, 40, 56)):
        grid = Grid(cells, h, tuple(-h * ((np.array(cells) - [16, 16, 24]) // 2 // 8 * 8)))
        nodes = grid.nodes()
        bowl = np.minimum(0.35 - np.linalg.norm(nodes[..., :2] - 0.4, axis=-1), nodes[..., 2] - 0.12)
        terrain = terrain_on(grid, bowl)
        # a jittered lattice, 8 per cell, dropped from a little above the bed
        axes = [np.arange(0.1625, stop, h / 2) for stop in (0.4, 0.65, 0.5)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        points += np.random.default_rng(0).uniform(-0.1, 0.1, points.shape) * h
        points = points[np.linalg.norm(points[:, :2] - 0.4, axis=1) < 0.33]
        simulator = LiquidSimulator(
            grid, terrain, FluidParameters(time_step=0.02), Particles.at_rest(points, 1.0),
            cell_types=np.zeros(cells, np.uint8), settings=SimulationSettings(reseed=False),
        )  # fmt: skip
        for _ in range(3):
            simulator.advance(0.02)
        results.append(simulator.particles)
    assert np.abs(results[0].velocities).max() > 0.5  # it moves
    # rounding of coordinates with another origin; a splash is chaotic, and from its start on no two runs agree
    np.testing.assert_allclose(results[0].positions, results[1].positions, atol=1e-3 * h)
