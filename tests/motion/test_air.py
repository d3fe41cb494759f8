"""A rising ball of smoke keeps its speed when the air around it makes room."""

import numpy as np
import pytest

from fluidlift.motion.air import with_air
from fluidlift.physics.pressure import build_system, divergence
from fluidlift.types import CellType, FaceVelocity, Grid


def test_smoke_keeps_its_speed_and_air_returns_around_it():
    grid = Grid((20, 20, 24), 0.05)
    r = np.linalg.norm(grid.centers() - np.array([0.5, 0.5, 0.5]), axis=-1)
    cells = np.where(r < 0.2, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    velocity = FaceVelocity.zeros(grid)
    velocity.w[:] = 1.0
    moved, report = with_air(velocity, cells, None, grid)
    smoke = cells == CellType.FLUID
    w = moved.at_centers()[..., 2]
    assert report.converged
    # uniform motion of the ball is divergence-free: only the jump at its rim must be spread, mobility 0.02 against 1
    assert w[smoke].mean() == pytest.approx(1.0, abs=0.1)
    beside = (np.abs(grid.centers()[..., 2] - 0.5) < 0.05) & (r > 0.27) & (r < 0.4)
    assert w[beside].mean() < 0.0  # the air that makes room above goes down at the sides
    system = build_system(np.full(grid.shape, CellType.FLUID, np.uint8), None, grid, open_border=True)
    # the solve's tolerance of 1e-4 of the initial divergence 1 / h
    assert np.abs(divergence(moved, grid, system)).max() * grid.spacing < 5e-3
