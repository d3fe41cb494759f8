"""What enters looks like the body downstream, mirrored: no seam, no single colour for long."""

from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.numerics.sampling import sample_faces
from fluidlift.pipeline.scene import beyond_surface
from fluidlift.pipeline.simulating import emission_look
from fluidlift.types import CellType, FaceVelocity, Gaussians, Grid

ALONG = np.array([1.0, 0.0, 0.0])


def line():
    x = np.linspace(0.0, 1.0, 101)
    return Gaussians.isotropic(np.stack([x, 0 * x, 0 * x], axis=1), 0.01, np.full((101, 3), 0.5))


def looked_up(speed, times):
    look = emission_look(line(), ALONG, speed)
    return np.array([0.01 * look(np.zeros((1, 3)), t)[0] for t in times])


def test_the_pattern_moves_upstream_at_the_speed_of_the_inflow():
    # from 12 % (what lies before is left out) onwards; Gaussians stand 0.01 apart
    np.testing.assert_allclose(looked_up(0.5, [0.4, 0.8, 1.2]), [0.2, 0.4, 0.6], atol=0.011)


def test_at_the_end_it_turns_back_without_a_jump():
    times = np.arange(0.0, 8.0, 0.05)
    steps = np.abs(np.diff(looked_up(0.5, times)))
    # 0.5 * 0.05 per step, rounded to Gaussians 0.01 apart
    assert steps.max() <= 0.036
    assert looked_up(0.5, times).max() <= 0.91


def test_still_water_keeps_one_look():
    assert np.ptp(looked_up(0.0, [0.0, 1.0, 5.0])) == 0.0


@pytest.mark.parametrize("kind", ["stream", "fall", "pour"])
def test_the_skin_of_a_stream_is_as_fast_as_the_stream(kind):
    grid = Grid((10, 6, 6), 0.1)
    cells = np.full(grid.shape, CellType.EMPTY, np.uint8)
    cells[:, :, :3] = CellType.FLUID
    u = np.zeros((11, 6, 6), np.float32)
    u[:, :, :3] = 2.0
    stored = FaceVelocity(u, np.zeros((10, 7, 6), np.float32), np.zeros((10, 6, 7), np.float32))
    velocity = beyond_surface(SimpleNamespace(kind=kind, velocity=stored, cell_types=cells))
    # from the centre of the last cell of liquid to half a cell above its surface
    skin = np.array([[0.5, 0.3, z] for z in (0.25, 0.28, 0.30, 0.35)])
    np.testing.assert_allclose(sample_faces(velocity, grid, skin), [[2.0, 0.0, 0.0]] * 4, atol=1e-6)  # float32
    assert sample_faces(stored, grid, skin[2:])[:, 0].max() < 1.1  # what is stored has lost half of it there


def test_the_air_around_smoke_keeps_its_own_velocity():
    stored = FaceVelocity.zeros(Grid((3, 3, 3), 0.1))
    assert beyond_surface(SimpleNamespace(kind="plume", velocity=stored, cell_types=np.zeros((3, 3, 3)))) is stored
