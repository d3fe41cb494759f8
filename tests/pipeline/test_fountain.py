"""A made fountain, from the clip to frames that can be played."""

import numpy as np
import pytest
from catalogue import QUICK, write_clip

from fluidlift.cli import DONE, WITH_WARNINGS, main
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.scene.splat_files import frame_files
from fluidlift.synthetic.fountain import SCENES, filmed_airborne
from fluidlift.types import CellType


@pytest.fixture(scope="module")
def fountain(tmp_path_factory):
    """Folder of the asset."""
    place = tmp_path_factory.mktemp("fountain")
    clip, folder = write_clip(place / "clip.mp4", filmed_airborne("windy", 4, frames=20, size=(192, 144)).frames), place
    options = [*QUICK, "--size", "5", "--set", "simulate.frames=5"]
    assert main(["make", str(clip), "-o", str(folder / "made.fluid"), *options]) in (DONE, WITH_WARNINGS)
    return folder / "made.fluid"


def test_it_is_told_and_stands_in_a_pool_that_is_closed(fountain):
    asset = load_asset(fountain)
    assert asset.kind == "fountain", read_manifest(fountain)["metrics"]["kind_scores"]
    cells, centers = asset.cell_types, asset.grid.centers()
    assert not (cells == CellType.OUTFLOW).any()
    inlet = cells == CellType.INFLOW
    level = centers[inlet][:, 2].min() - 0.5 * asset.grid.spacing
    above = (cells == CellType.FLUID) & (centers[..., 2] > level)
    below = (cells == CellType.FLUID) & (centers[..., 2] < level)
    assert above.any() and below.any()
    # what is in the air stands on its pool, and takes less of the plan than that
    assert above.any(axis=2).sum() < (below | inlet | above).any(axis=2).sum()
    assert np.ptp(centers[above][:, 2]) > 0.8 * np.ptp(centers[above][:, 0]) * SCENES["windy"]().rise / 3.6


def test_it_rises_as_fast_as_its_height_says_and_falls_outside(fountain):
    asset = load_asset(fountain)
    cells, centers = asset.cell_types, asset.grid.centers()
    velocity = asset.velocity.at_centers()
    inlet = cells == CellType.INFLOW
    height = centers[cells == CellType.FLUID][:, 2].max() - centers[inlet][:, 2].min()
    speed = np.linalg.norm(asset.parameters.inflow_velocity)
    assert 0.75 < speed**2 / (2 * 9.81) / height < 1.0
    middle = centers[..., 2] > centers[inlet][:, 2].min() + 0.4 * height
    falls = velocity[middle & (cells == CellType.FLUID)][:, 2]
    assert (falls < 0).any() and (falls > 0).any()
    assert 0.03 < asset.parameters.inflow_fluctuation / speed < 0.07


def test_it_plays_and_keeps_its_volume(fountain):
    assert len(frame_files(fountain)) == 5
    simulated = read_manifest(fountain)["metrics"]
    assert simulated["kind_scores"]["fountain"] > 0.7
