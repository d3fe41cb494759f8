"""Water up to the horizon, on pictures that are drawn."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.shape.kind import estimate_up, level_camera
from fluidlift.shape.view import horizon_line, look_at, open_horizon
from fluidlift.types import PinholeCamera
from fluidlift.types.kind import BASIN, STREAM

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


def line_of(picture, fluid):
    seen = open_horizon(picture, fluid)
    assert seen is not None
    return seen.ends


def found(picture, fluid):
    seen = open_horizon(picture, fluid)
    return 0.0 if seen is None else seen.share


@pytest.mark.parametrize("lean", [0.0, -3.2, 6.0])
def test_the_sea_ends_on_a_straight_line(lean):
    picture, water = landscape(lean)
    assert found(picture, water) > 0.9
    assert found(picture, water & (ROW > 120)) > 0.9, "only its near part was found"


def test_a_pier_may_stand_before_it():
    picture, water = landscape()
    pier = (COL > 290) & (ROW > 50) & (ROW < 80)
    picture[pier] = 20
    assert found(picture, water & ~pier) > 0.9


@pytest.mark.parametrize("bank", [6.0, 15.0])
def test_a_bank_stands_between_a_river_and_the_sky(bank):
    assert open_horizon(*landscape(bank=bank)) is None


def test_hills_are_not_straight():
    picture, water = landscape()
    hills = (ROW < 60) & (ROW > 40 + 12 * np.sin(COL / 25.0))
    picture[hills] = WOODS
    picture[(ROW >= 60) & (ROW < 66)] = WOODS
    assert open_horizon(picture, water & (ROW >= 66)) is None


def test_what_lies_does_not_rise_above_it_nor_does_a_tray_reach_from_side_to_side():
    picture, water = landscape()
    assert open_horizon(picture, water | (np.hypot(ROW - 30, COL - 160) < 20)) is None
    assert open_horizon(picture, water & (np.abs(COL - 160) < 80)) is None
    assert open_horizon(picture, np.zeros_like(water)) is None


def test_a_picture_of_water_alone_shows_none():
    picture, _ = landscape(line=-20.0)
    assert open_horizon(picture, np.ones((H, W), bool)) is None


@pytest.mark.parametrize("lean", [0.0, -2.5, 5.0])
def test_the_line_lies_where_the_water_ends(lean):
    (_, left), (_, right) = line_of(*landscape(lean))
    rise = np.tan(np.radians(lean)) * W / 2
    assert left == pytest.approx(60.0 - rise, abs=2.0)  # half a step of the leans is 0.7 px, a row 1.2
    assert right == pytest.approx(60.0 + rise, abs=2.0)


@pytest.mark.parametrize("lean", [0.0, 2.0])
def test_haze_that_darkens_towards_it_is_not_taken_for_it(lean):
    """As before sunset: over the last 20 px the sky loses more light than at the sea's edge."""
    picture, water = landscape(lean, noise=1.0)
    edge = 60.0 + np.tan(np.radians(lean)) * (COL - W / 2)
    haze = np.array(SKY) - np.array([70.0, 60.0, 50.0]) * np.clip((ROW - edge + 25.0) / 20.0, 0.0, 1.0)[..., None]
    glow = 1.0 - 0.1 * (COL / W)[..., None]  # brighter on one side: surfaces of equal light lean
    picture = np.where(water[..., None], 0.8 * picture + 20.0, haze * glow).astype(np.uint8)
    (_, left), (_, right) = line_of(picture, water)
    rise = np.tan(np.radians(lean)) * W / 2
    assert left == pytest.approx(60.0 - rise, abs=2.5) and right == pytest.approx(60.0 + rise, abs=2.5)


@pytest.mark.parametrize(("line", "lean"), [(60.0, 0.0), (25.0, 3.0), (120.0, -4.0)])
def test_standing_water_up_to_the_horizon_tells_the_tilt(line, lean):
    """A camera that looks p below the horizon sees it f tan(p) above its middle; the roll is the line's lean."""
    picture, water = landscape(lean, line)
    camera = PinholeCamera.from_fov(50.0, (W, H))
    seen = look_at(BASIN, picture, water, water)
    up = estimate_up(BASIN, water, np.zeros((H, W, 2)), np.zeros((H, W)), camera, seen)
    pitch = np.degrees(np.arctan((H / 2 - line) / camera.focal[0] * np.cos(np.radians(lean))))
    assert up.pitch == pytest.approx(pitch, abs=0.7)
    rise = np.tan(np.radians(lean)) * W / 2
    (_, left), (_, right) = horizon_line(level_camera(camera, up))
    assert left == pytest.approx(line - rise, abs=5.0) and right == pytest.approx(line + rise, abs=5.0)  # 0.8 degrees
    assert up.confidence > 0.9 and "horizon of open water" in up.source


def test_what_runs_on_may_fall_over_a_brink_which_is_no_horizon():
    picture, water = landscape()
    assert look_at(STREAM, picture, water, water).horizon is None
