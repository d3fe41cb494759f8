"""A tank of water with a few frames, as an asset on disk: small enough for a browser without a graphics card."""

from pathlib import Path

import numpy as np
import pytest

from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
)

FRAMES, INTERVAL = 8, 0.04


def tank(cells=(12, 8, 8), spacing=0.05) -> FluidAsset:
    """A block of water that is let go at one end of a tank."""
    grid = Grid(cells, spacing)
    centers = grid.centers()
    wet = (centers[..., 0] < 0.25) & (centers[..., 2] < 0.3)
    at = centers[wet][:, None, :] + spacing * np.array(
        [[x, y, z] for x in (-0.25, 0.25) for y in (-0.25, 0.25) for z in (-0.25, 0.25)]
    )
    means = at.reshape(-1, 3)
    rest = Gaussians.isotropic(means, 0.42 * spacing, np.full((len(means), 3), (0.1, 0.4, 0.8)))
    low, high = grid.low, grid.high
    floor = np.array([[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]])
    terrain = Terrain(
        grid, (grid.nodes()[..., 2] + 0.5 * spacing).astype(np.float32), np.array([1.0, 0.0, 0.0]),
        TriangleMesh(floor, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 0.5)),
    )  # fmt: skip
    middle = 0.5 * (low + high)
    camera = PinholeCamera.looking(middle + np.array([0.1, -1.2, 0.6]), middle, 50.0, (96, 64))
    types = np.where(wet, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    parameters = FluidParameters(time_step=0.01)
    return FluidAsset(
        "pour", rest, terrain, grid, types, FaceVelocity.zeros(grid), parameters, {}, camera, Similarity3(), INTERVAL,
        FRAMES,
    )  # fmt: skip


def write_tank(folder: Path) -> Path:
    """The tank as a finished asset."""
    from fluidlift.io.asset_folder import save_asset, update_manifest
    from fluidlift.io.ply import write_gaussians
    from fluidlift.pipeline.preview import PreviewSize, coarse_asset, preview_frames, preview_scene

    asset = tank()
    save_asset(folder, asset)
    scene = preview_scene(coarse_asset(asset, PreviewSize()), folder, {}, FRAMES)
    for frame in preview_frames(scene):
        path = folder / "frames" / "splats" / f"{1001 + frame.number}.ply"
        ids = np.arange(len(frame.gaussians))
        write_gaussians(path, frame.gaussians, ids=ids, velocities=frame.velocities)
    update_manifest(folder, simulation={"frames": FRAMES, "frame_interval": INTERVAL})
    return folder


@pytest.fixture(scope="session")
def finished_tank(tmp_path_factory) -> Path:
    """Written once; tests that change it work on a copy."""
    return write_tank(tmp_path_factory.mktemp("tank") / "tank.fluid")


@pytest.fixture
def tank_folder(finished_tank, tmp_path) -> Path:
    """A copy to work with."""
    import shutil

    return shutil.copytree(finished_tank, tmp_path / "tank.fluid")
