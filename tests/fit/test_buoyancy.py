"""Smoke that rises further has more lift: the outline tells how much."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.fit import buoyancy
from fluidlift.fit.buoyancy import RisingSmoke, buoyancy_from_rise, course
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, PinholeCamera, Terrain, TriangleMesh

GRID = Grid((14, 14, 30), 0.1, (-0.7, -0.7, 0.0))
FRAMES, INTERVAL, LIFT = 16, 0.1, 1.5


def still_smoke() -> RisingSmoke:
    """A column that stands on its inlet, seen from the side."""
    types = np.full(GRID.shape, CellType.EMPTY, np.uint8)
    x, y, z = np.moveaxis(GRID.centers(), -1, 0)
    column = (np.hypot(x, y) < 0.26) & (z < 1.0)
    types[column] = CellType.FLUID
    types[column & (z < 0.2)] = CellType.INFLOW
    phi = GRID.nodes()[..., 2].astype(np.float32)
    ground = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
    rise = np.zeros(GRID.face_shape(2), np.float32)
    rise[5:9, 5:9, :11] = 0.5
    zero = FaceVelocity.zeros(GRID)
    return RisingSmoke(
        Terrain(GRID, phi, np.array([0.0, 0.0, 1.0]), ground), types, FaceVelocity(zero.u, zero.v, rise),
        FluidParameters(inflow_velocity=(0.0, 0.0, 0.5), wall_damping=0.0), outline=lambda k: np.zeros((1, 1), bool),
        camera=PinholeCamera.looking((0.0, -6.0, 1.5), (0.0, 0.0, 1.5), 32.0, (80, 120)), interval=INTERVAL,
        frames=FRAMES,
    )  # fmt: skip


def outlines(smoke: RisingSmoke, lift: float) -> list[np.ndarray]:
    """What a clip of the smoke shows: pixels with a particle near."""
    simulator, out = buoyancy._simulator(smoke, lift), []
    for k in range(FRAMES):
        if k:
            simulator.advance(INTERVAL)
        uv, _ = smoke.camera.project(simulator.particles.positions)
        mask = np.zeros((120, 80), bool)
        at = np.floor(uv).astype(int)
        at = at[((at >= 0) & (at < (80, 120))).all(axis=1)]
        for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
            row, col = np.minimum(at[:, 1] + step[0], 119), np.minimum(at[:, 0] + step[1], 79)
            mask[row, col] = True
        out.append(mask)
    return out


@pytest.fixture(scope="module")
def clip():
    smoke = still_smoke()
    seen = outlines(smoke, LIFT)
    return replace(smoke, outline=lambda k: seen[k])


@pytest.mark.parametrize("guess", [0.1, 6.0])
def test_the_lift_of_smoke_is_found_from_its_outline_whatever_the_guess(clip, guess):
    found = buoyancy_from_rise(clip, guess)
    assert found is not None
    # the search ends within 0.15 of a cell, and a cell of the mean height is what sigma stands for
    assert abs(found.value - LIFT) < 0.3 * found.sigma
    assert 0.0 < found.sigma < 0.7 * LIFT
    assert found.runs <= buoyancy.MOST_RUNS and found.frames == FRAMES


def test_what_wide_cells_get_wrong_is_taken_off(clip, monkeypatch):
    monkeypatch.setattr(buoyancy, "MOST_CELLS", 2000)
    heights, missing_height = [], buoyancy._missing_height

    def told(smoke, value, seen):
        heights.append((smoke.terrain.grid.cells, missing_height(smoke, value, seen)))
        return heights[-1][1]

    monkeypatch.setattr(buoyancy, "_missing_height", told)
    found = buoyancy_from_rise(clip, 0.5)
    assert found is not None and found.runs == len(heights)
    assert [cells for cells, _ in heights].count(GRID.cells) == 1  # the only one that takes its time
    # a column of five cells becomes one of two or three: half a wide cell of height is what is left
    cell = clip.camera.focal[1] * 2 * GRID.spacing / 6.0
    assert abs(missing_height(clip, found.value, course(clip.outline, FRAMES))) < 0.5 * cell


def test_smoke_that_rises_no_further_tells_nothing(clip):
    still = replace(clip, outline=lambda k: clip.outline(0))
    assert buoyancy_from_rise(still, 1.0) is None


def test_the_course_ends_where_the_smoke_leaves_the_picture():
    masks = np.zeros((20, 40, 10), bool)
    for k in range(20):
        masks[k, max(24 - 2 * k, 0) : 36, 3:7] = True
    rows = course(lambda k: masks[k], 20)
    assert rows is not None and len(rows) == 12  # row 2 is the first that is not at the border
    assert np.diff(rows) == pytest.approx(np.full(11, -2.0), abs=0.1)  # 3 % of a body that grows: a little deeper
    assert course(lambda k: masks[k], 5) is None
    assert course(lambda k: masks[k + 14], 6) is None
