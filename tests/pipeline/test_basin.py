"""Water that stays, from the clip to frames that can be played: a seiche, and a whirl in a vessel, of known truth.

The water of a tank swings to and fro; that of a pot goes round. Neither goes anywhere.
"""

import cv2
import numpy as np
import pytest
from catalogue import QUICK, write_clip

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.look.surface_skin import without_skin
from fluidlift.scene.splat_files import frame_files, read_frame
from fluidlift.types import CellType

FRAMES, PERIOD, SWING = 36, 24, 5.0
"""of the clip; frames and px of the swing"""
SIZE = (64, 96)


def texture(shape, colour, contrast, seed):
    noise = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(shape).astype(np.float32), (0, 0), 1.2)
    return np.clip(np.asarray(colour) + contrast * (noise / noise.std())[..., None], 0, 255).astype(np.float32)


def pictures(outline, moved):
    """u8 [T,H,W,3]: water within an outline; `moved(t)` are the places (x, y) in its texture that the pixels show."""
    height, width = SIZE
    ground, water = texture(SIZE, (120, 95, 60), 22, 0), texture((3 * height, 3 * width), (70, 105, 120), 26, 1)
    out = []
    for t in range(FRAMES):
        x, y = moved(t)
        shown = cv2.remap(water, (x + width).astype(np.float32), (y + height).astype(np.float32), cv2.INTER_LINEAR)
        out.append(np.where(outline[..., None], shown, ground))
    return np.stack(out).astype(np.uint8)


def seiche():
    """A tank across the picture: all of its surface swings to and fro."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    tank = (v > 20) & (v < 52) & (u > 6) & (u < 90)
    return pictures(tank, lambda t: (u - SWING * np.sin(2 * np.pi * t / PERIOD), v))


def whirl():
    """A round pot, looked down on: its surface turns by 3 degrees per frame."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    x, y = u - 48.0, (v - 32.0) * 1.5
    pot = np.hypot(x, y) < 36

    def turned(t):
        c, s = np.cos(np.radians(3.0 * t)), np.sin(np.radians(3.0 * t))
        return 48.0 + c * x + s * y, 32.0 + (c * y - s * x) / 1.5

    return pictures(pot, turned)


@pytest.fixture(scope="module")
def basins(tmp_path_factory):
    """Folders of both assets."""
    place, found = tmp_path_factory.mktemp("basins"), {}
    for film in (seiche, whirl):
        clip, folder = write_clip(place / f"{film.__name__}.mp4", film()), place / f"{film.__name__}.fluid"
        options = ["--size", "1", "--pitch", "42", *QUICK, "--set", "simulate.frames=5"]
        assert main(["make", str(clip), "-o", str(folder), *options]) in (DONE, WITH_WARNINGS)
        found[film] = folder
    return found


@pytest.mark.parametrize("film", [seiche, whirl])
def test_it_is_taken_for_water_that_stays(basins, film):
    manifest, asset = read_manifest(basins[film]), load_asset(basins[film])
    assert asset.kind == "basin", manifest["metrics"]["kind_scores"]
    assert set(np.unique(asset.cell_types)) <= {CellType.EMPTY, CellType.FLUID, CellType.SOLID}
    assert asset.parameters.inflow_velocity == (0.0, 0.0, 0.0) and asset.parameters.outflow_velocity == 0.0
    assert not any(e.fitted for e in asset.estimates.values())


def of_water(folder):
    asset = load_asset(folder)
    wet = asset.cell_types == CellType.FLUID
    points, velocity = asset.grid.centers()[wet], asset.velocity.at_centers()[wet]
    return points[:, :2] - points[:, :2].mean(axis=0), velocity


def test_a_swing_is_no_current(basins):
    _, velocity = of_water(basins[seiche])
    pixel = 1.0 / 84  # m: the tank is 84 px and 1 m long
    fastest = SWING * 2 * np.pi / PERIOD * 25 * pixel
    assert np.linalg.norm(velocity.mean(axis=0)) < 0.02 * fastest
    assert np.linalg.norm(velocity, axis=1).mean() < 0.15 * fastest


def test_a_whirl_goes_round_and_nowhere(basins):
    arm, velocity = of_water(basins[whirl])
    rate = np.median((arm[:, 0] * velocity[:, 1] - arm[:, 1] * velocity[:, 0]) / np.square(arm).sum(axis=1))
    truth = np.radians(3.0) * 25  # rad/s, clockwise in the picture and seen from above
    assert -1.1 * truth < rate < -0.4 * truth
    assert np.linalg.norm(velocity.mean(axis=0)) < 0.1 * np.linalg.norm(velocity, axis=1).mean()


@pytest.mark.parametrize("film", [seiche, whirl])
def test_it_stays_where_it_is(basins, film):
    files = frame_files(basins[film])
    cell = load_asset(basins[film]).grid.spacing
    first, last = (without_skin(read_frame(f).gaussians, cell).means for f in (files[0], files[-1]))
    assert len(files) == 5 and len(last) > 0.97 * len(first)
    np.testing.assert_allclose(last.mean(axis=0), first.mean(axis=0), atol=0.03 * np.ptp(first[:, :2], axis=0).max())


def test_a_fit_of_its_parameters_is_refused_and_says_why(basins, capsys):
    assert main(["fit", str(basins[seiche]), "--free", "kinematic_viscosity"]) == REJECTED
    assert "not seen" in capsys.readouterr().err
