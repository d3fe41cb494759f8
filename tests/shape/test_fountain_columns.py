"""Columns of a fountain and their pool, in the picture and in cells, on made clips whose truth is known."""

import numpy as np
import pytest

from fluidlift.shape import airborne
from fluidlift.shape.fountain_columns import find_columns
from fluidlift.shape.jet_column import Jet
from fluidlift.synthetic.fountain import SCENES, filmed_airborne
from fluidlift.types import CellType, Grid, PinholeCamera, Setting, Terrain, TriangleMesh

FRAMES, SIZE = 12, (160, 120)


def seen(name: str):
    """Mask, motion and trust of a made fountain, its camera and its scene: what falls is seen, its core is not."""
    clip, scene = filmed_airborne(name, 2, frames=FRAMES, size=SIZE), SCENES[name]()
    air = clip.air.mean(axis=0) > 0.25
    rows = np.arange(SIZE[1])[:, None]
    top = np.flatnonzero(air.any(axis=1))[0]
    speed = np.sqrt(np.maximum(rows - top, 0.0)) * np.ones((1, SIZE[0]))
    core = clip.air.all(axis=0)
    motion = np.where(air[..., None], np.stack([0.0 * speed, speed], -1), 0.0)
    trust = np.where(core, 0.05, 0.9) * (air | clip.pool)
    return air | clip.pool, motion, trust, clip, scene


@pytest.mark.parametrize("name", ["single", "windy", "froth"])
def test_one_column_stands_in_the_pool_that_is_seen(name):
    mask, motion, trust, clip, scene = seen(name)
    (column,), pool = find_columns(mask, motion, trust, pitch=scene.pitch)
    source = scene.sources[0]
    above = clip.camera.project(np.array([[source.start[0], 0.0, scene.rise]]))[0][0, 1]
    assert column.centers[0, 1] < above + 6 and column.nozzle is not None
    foot = clip.camera.project(np.array([[0.0, 0.0, 0.0]]))[0][0]
    assert abs(column.nozzle[1] - foot[1]) < 0.15 * SIZE[1]
    agree = (pool & clip.pool).sum() / (pool | clip.pool).sum()
    assert agree > 0.8, agree


def test_jets_in_a_row_are_no_round_column():
    mask, motion, trust, _, scene = seen("row")
    found, pool = find_columns(mask, motion, trust, pitch=scene.pitch)
    assert len(found) >= 2
    for column in found:
        tall = np.ptp(column.centers[:, 1])
        assert 2 * column.half_widths.max() < 1.5 * tall
    assert not (found[0].pixels & found[1].pixels).any() and pool.any()


def test_a_pool_that_is_not_seen_is_where_the_water_lands():
    _, motion, trust, clip, scene = seen("single")
    air = clip.air.mean(axis=0) > 0.25
    (column,), pool = find_columns(air, motion, trust, pitch=scene.pitch)
    rows, columns = np.nonzero(pool)
    assert abs(columns.mean() - column.centers[-1, 0]) < 3
    assert np.ptp(columns) >= 2 * column.half_widths.max() - 2
    assert np.ptp(rows) < np.ptp(columns) / 3  # it lies


def test_where_nothing_moves_there_is_no_column():
    mask = np.ones((40, 60), bool)
    found, pool = find_columns(mask, np.zeros((40, 60, 2)), np.ones((40, 60)), pitch=10.0)
    assert found == [] and (pool == mask).all()


def test_what_rises_comes_out_of_a_pipe_over_the_surface():
    grid = Grid((30, 30, 10), 0.1, (-1.5, -1.5, -0.6))
    cells = np.full(grid.shape, CellType.EMPTY, np.uint8)
    z = grid.centers()[..., 2]
    cells[z < -0.4] = CellType.SOLID
    cells[(z > -0.4) & (z < 0)] = CellType.FLUID
    mesh = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    phi = (grid.nodes()[..., 2] + 0.4).astype(np.float32)
    pool = Setting(
        Terrain(grid, phi, np.array([0.0, 0, 1.0]), mesh), cells, np.zeros((30, 30)), np.full((30, 30), -0.4)
    )
    jet = Jet((0.0, 0.0), np.array([-0.05, 1.2]), np.array([0.8, 0.4]), nozzle=(0.2, 0.0))
    points = np.zeros((4, 3))
    camera = PinholeCamera.looking(np.array([0.0, -5.0, 2.0]), np.zeros(3), 60.0, (320, 240))
    out = airborne.with_jets(pool, [jet], points, points, camera)
    centers, h = out.terrain.grid.centers(), 0.1
    inlet = centers[out.cell_types == CellType.INFLOW]
    assert len(inlet) and (np.hypot(inlet[:, 0] - 0.2, inlet[:, 1]) <= airborne.nozzle_radius(jet, h)).all()
    assert inlet[:, 2].min() > 0 and inlet[:, 2].max() < airborne.MOUTH * h
    below = (np.hypot(centers[..., 0] - 0.2, centers[..., 1]) < 0.1) & (centers[..., 2] < 0)
    assert (out.cell_types[below] == CellType.SOLID).all()
    assert not (out.cell_types == CellType.OUTFLOW).any()
    flies = (out.cell_types == CellType.FLUID) & (centers[..., 2] > 0)
    assert flies.any() and np.hypot(*centers[flies][:, :2].T).max() <= 0.8
    assert Jet.from_dict(jet.to_dict()).nozzle == jet.nozzle
