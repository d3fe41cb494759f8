"""Where an inlet stood in each frame of a clip, and the way that it takes with its film."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.physics.inflow_schedule import InletPath
from fluidlift.scene.filmed_inlet import STICKS, inlet_offsets, inlet_path
from fluidlift.scene.simulator import simulator_of
from fluidlift.types import CellType, Grid, PinholeCamera

GRID = Grid((40, 20, 40), 0.01, (-0.2, -0.1, 0.0))
CAMERA = PinholeCamera.looking((0.0, -1.0, 0.2), (0.0, 0.0, 0.2), 2 * np.degrees(np.arctan(80 / 400)), (160, 160))
"""a cell is 4 px wide"""
FRAMES = 20


def cells(*columns: int) -> np.ndarray:
    found = np.zeros(GRID.shape, np.uint8)
    for x in columns:
        found[x : x + 4, 8:12, 32:34] = CellType.INFLOW
    return found


def poured(shifts: np.ndarray, top: int = 24) -> np.ndarray:
    """bool [T,160,160]: a jet of 16 px that hangs from row `top`, and the pool that it falls into."""
    masks = np.zeros((len(shifts), 160, 160), bool)
    for mask, (across, down) in zip(masks, shifts.astype(int)):
        mask[top + down : 130, 72 + across : 88 + across] = True
        mask[120:140, 40:120] = True
    return masks


def swinging(across: int, down: int = 0) -> np.ndarray:
    way = np.sin(np.linspace(0.0, np.pi, FRAMES))[:, None]
    return np.rint(way * np.array([across, down]))


def test_a_jet_that_goes_with_its_jug_is_followed_sideways_and_up():
    for across, down in ((14, 0), (-10, -12)):
        way = swinging(across, down)
        found = inlet_offsets(cells(18), GRID, CAMERA, poured(way), 0)
        expected = way @ np.array([[1.0, 0, 0], [0, 0, -1.0]]) / 400.0
        np.testing.assert_allclose(found, expected, atol=0.5 * GRID.spacing)


def test_offsets_are_from_where_it_is_at_rest():
    way = np.stack([np.arange(FRAMES), np.zeros(FRAMES)], axis=-1)
    found = inlet_offsets(cells(18 + 2), GRID, CAMERA, poured(way), 8)
    assert (found[8] == 0).all()
    np.testing.assert_allclose(found[:, 0], (way[:, 0] - 8) / 400.0, atol=0.3 * GRID.spacing)


@pytest.mark.parametrize("case", ["stays", "two", "none", "unseen", "gone"])
def test_what_stays_or_cannot_be_followed_has_no_way(case):
    way, inlet = swinging(14), cells(18)
    masks = poured(0 * way + (np.arange(FRAMES) % 2)[:, None] if case == "stays" else way)
    if case == "two":
        inlet = cells(10, 26)
    elif case == "none":
        inlet = cells()
    elif case == "unseen":
        masks[0, :60] = False
    elif case == "gone":
        masks[1:, :100] = False
    assert inlet_offsets(inlet, GRID, CAMERA, masks, 0) is None


def test_frames_in_which_it_is_not_found_are_between_those_in_which_it_is():
    way = np.stack([np.arange(FRAMES), np.zeros(FRAMES)], axis=-1)
    masks = poured(way)
    masks[6:9] = False
    found = inlet_offsets(cells(18), GRID, CAMERA, masks, 0)
    np.testing.assert_allclose(found[:, 0], way[:, 0] / 400.0, atol=0.5 * GRID.spacing)


def test_the_way_goes_with_the_film_and_begins_anew_with_it(channel):
    scene = channel(60, kind="pour")
    h = scene.terrain.grid.spacing
    away = np.linspace(0.0, 6.0, FRAMES)[:, None] * np.array([h, 0.0, 0.0])
    path = inlet_path(replace(scene, inlet=away))
    places = np.array([path.at(k * scene.interval) for k in range(60)])
    assert (places[:, 1:] == 0).all()
    np.testing.assert_allclose(places[:18, 0], 6.0 * np.arange(18) / (FRAMES - 1), atol=STICKS + 0.01)
    back = np.flatnonzero(np.diff(places[:, 0]) < 0)
    assert len(back) >= 2 and (np.diff(back) < FRAMES).all(), "with each beginning of the film"
    faster = inlet_path(replace(scene, inlet=away, interval=2 * scene.interval))
    assert faster.at(5 * 2 * scene.interval) == path.at(10 * scene.interval), "at the pace of the film"


def test_a_scene_that_somebody_edited_keeps_its_inlet_where_it_is(channel):
    scene = replace(channel(4, kind="pour"), inlet=np.full((FRAMES, 3), 0.5))
    assert isinstance(inlet_path(scene), InletPath)
    assert inlet_path(replace(scene, changes=("gravity",))) is None
    assert inlet_path(channel(4, kind="pour")) is None
    assert inlet_path(replace(scene, kind="stream")) is None


def test_what_is_simulated_comes_from_where_the_inlet_stands(channel):
    scene = channel(8, kind="pour")
    h = scene.terrain.grid.spacing
    # up, into the air: where there is fluid already, none has to be put in
    moved = replace(scene, inlet=np.linspace(0.0, 3.0, 8)[:, None] * np.array([0.0, 0.0, h]))
    assert moved.parts != scene.parts
    first, second = simulator_of(scene), simulator_of(moved)
    for _ in range(7):
        first.advance(scene.interval)
        second.advance(scene.interval)
    new, other = (s.particles.positions[s.particles.ids >= len(scene.body)] for s in (first, second))
    assert other[:, 2].max() > new[:, 2].max() + h
