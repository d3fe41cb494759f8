"""Water up to the horizon, on pictures that are drawn."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.shape.view import open_horizon

H, W = 180, 320
ROW, COL = np.mgrid[:H, :W]
SKY, SEA, WOODS = (200, 215, 235), (60, 85, 110), (50, 70, 45)


def landscape(lean=0.0, line=60.0, *, bank=0.0, noise=2.0, seed=0):
    """Sky over water that ends on a line, which leans by so many degrees, with a wooded bank so many px high."""
    rng = np.random.default_rng(seed)
    edge = line + np.tan(np.radians(lean)) * (COL - W / 2)
    picture = np.where((ROW + 0.5 < edge)[..., None], SKY, SEA).astype(float)
    picture += 8.0 * (ROW < edge)[..., None] * (ROW / H - 0.5)[..., None]
    waves = gaussian_filter(rng.normal(size=(H, W)), (1.0, 4.0)) * 100.0
    picture += np.where(edge <= ROW, waves, 0.0)[..., None]
    if bank:
        tops = edge - bank * (1.0 + gaussian_filter(rng.normal(size=W), 4.0) * 2.0)
        woods = (tops < ROW) & (edge > ROW)
        picture = np.where(woods[..., None], np.array(WOODS) + 40.0 * rng.normal(size=(H, W, 1)), picture)
    picture += rng.normal(0.0, noise, (H, W, 3))
    return np.clip(picture, 0, 255).astype(np.uint8), edge <= ROW


@pytest.mark.parametrize("lean", [0.0, -3.2, 6.0])
def test_the_sea_ends_on_a_straight_line(lean):
    picture, water = landscape(lean)
    assert open_horizon(picture, water) > 0.9
    assert open_horizon(picture, water & (ROW > 120)) > 0.9, "only its near part was found"


def test_a_pier_may_stand_before_it():
    picture, water = landscape()
    pier = (COL > 290) & (ROW > 50) & (ROW < 80)
    picture[pier] = 20
    assert open_horizon(picture, water & ~pier) > 0.9


@pytest.mark.parametrize("bank", [6.0, 15.0])
def test_a_bank_stands_between_a_river_and_the_sky(bank):
    assert open_horizon(*landscape(bank=bank)) == 0.0


def test_hills_are_not_straight():
    picture, water = landscape()
    hills = (ROW < 60) & (ROW > 40 + 12 * np.sin(COL / 25.0))
    picture[hills] = WOODS
    picture[(ROW >= 60) & (ROW < 66)] = WOODS
    assert open_horizon(picture, water & (ROW >= 66)) == 0.0


def test_what_lies_does_not_rise_above_it_nor_does_a_tray_reach_from_side_to_side():
    picture, water = landscape()
    assert open_horizon(picture, water | (np.hypot(ROW - 30, COL - 160) < 20)) == 0.0
    assert open_horizon(picture, water & (np.abs(COL - 160) < 80)) == 0.0
    assert open_horizon(picture, np.zeros_like(water)) == 0.0


def test_a_picture_of_water_alone_shows_none():
    picture, _ = landscape(line=-20.0)
    assert open_horizon(picture, np.ones((H, W), bool)) == 0.0
