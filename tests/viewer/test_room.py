"""Where something new is put on the fluid, and what is told of bodies that begin in the ground."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.io.asset_folder import load_asset, save_asset
from fluidlift.scene.edits import EditSession
from fluidlift.scene.forecast import place_told, placed
from fluidlift.scene.open_water import open_water
from fluidlift.types import CellType

ROCK, WIDE = np.array([0.125, 0.2, 0.15]), 0.08
"""m: a round rock in the middle of the water, up to z = 0.23"""


@pytest.fixture
def rocky(finished_tank):
    """The tank's water, 0.25 m long, 0.4 m wide and 0.3 m deep, with a rock in its middle."""
    asset = load_asset(finished_tank)
    away = np.linalg.norm(asset.grid.nodes() - ROCK, axis=-1) - WIDE
    distance = np.minimum(asset.terrain.signed_distance, away).astype(np.float32)
    return replace(asset, terrain=replace(asset.terrain, signed_distance=distance))


def test_room_is_on_the_water_beside_the_rock_and_beside_what_is_there_already(finished_tank, rocky):
    width, h = 0.06, rocky.grid.spacing
    place = open_water(load_asset(finished_tank), width)
    assert np.abs(place[:2] - ROCK[:2]).max() <= h  # nothing is in the way: the middle, to a cell
    assert abs(place[2] - 0.3) < 0.5 * h  # the highest particles stand a quarter of a cell below the surface
    tall = replace(rocky, terrain=replace(rocky.terrain, signed_distance=pillar(rocky)))
    taken = []
    for _ in range(2):
        place = open_water(tall, width, taken)
        assert np.linalg.norm(place[:2] - ROCK[:2]) > WIDE + 0.5 * width
        assert all(np.linalg.norm(place[:2] - other) > width for other, _ in taken)
        taken.append((place[:2], width))


def pillar(asset):
    """The rock as a pillar through the whole depth."""
    away = np.linalg.norm(asset.grid.nodes()[..., :2] - ROCK[:2], axis=-1) - WIDE
    return np.minimum(asset.terrain.signed_distance, away).astype(np.float32)


def test_where_there_is_no_room_the_roomiest_place_is_given_and_the_inlet_is_left_free(finished_tank):
    asset = load_asset(finished_tank)
    assert np.isfinite(open_water(asset, 10.0)).all()
    types = asset.cell_types.copy()
    types[:2] = np.where(types[:2] == CellType.FLUID, CellType.INFLOW, types[:2])  # x < 0.1
    # half a body and two cells beyond the inlet's last column at 0.075, within a column of rounding
    assert open_water(replace(asset, cell_types=types), 0.06)[0] >= 0.075 + 0.03 + 0.05


def test_a_floating_body_that_begins_in_the_ground_is_told_with_a_height_at_which_it_is_free(rocky, tmp_path):
    save_asset(tmp_path / "tank.fluid", rocky)
    session = EditSession.open(tmp_path / "tank.fluid")
    ball = {"shape": "sphere", "radius": 0.01, "position": ROCK.tolist(), "motion": "free"}
    place = session.add("obstacles", ball)
    (told,) = session.warnings()
    assert "'sphere1' at (0.125, 0.2, 0.15) m begins" in told and "inside the ground" in told
    height = float(told.split("from a height of ")[1].split(" m")[0])
    assert 0.15 + WIDE < height < 0.5  # above the rock, below the sky
    session.set(f"{place}.position", [0.125, 0.2, height])
    assert session.warnings() == []
    session.set(f"{place}.position", ROCK.tolist())
    session.set(f"{place}.motion", "static")  # a rock that stands in the ground is nothing odd
    assert session.warnings() == []


def test_an_edit_that_takes_long_or_for_ever_is_told_when_it_is_made(tank_folder):
    session = EditSession.open(tank_folder)
    session.set("parameters.gravity", [0, 0, -800.0])
    (told,) = session.warnings()
    assert "gravity of 800 m/s^2 needs about" in told and "may take very long" in told
    session.set("parameters.time_step", 1e-6)
    (told,) = session.warnings()
    assert "cannot be simulated as it is: time_step 1e-06 s needs 40,000 steps" in told
    session.undo()
    session.undo()
    assert session.warnings() == []


@pytest.mark.parametrize("origin", [0.0, 136.0, -5_600_000.0])
@pytest.mark.parametrize("cell", [2e-4, 0.025, 0.3, 12.0])
def test_a_place_is_told_and_written_as_finely_wherever_the_origin_lies(origin, cell):
    place = origin + cell * np.array([0.123456, -4.56789, 31.41592])
    told = [float(c) for c in place_told(place, cell).split(", ")]
    assert np.abs(told - place).max() <= 0.05 * cell + 1e-9  # half of a tenth; doubles have 1e-9 m here
    assert np.abs(placed(place, 0.01 * cell) - place).max() <= 0.005 * cell + 1e-9
    assert max(len(f"{c:.12g}".partition(".")[2]) for c in placed(place, 0.01 * cell)) <= 6  # 2e-6 m: no noise behind
