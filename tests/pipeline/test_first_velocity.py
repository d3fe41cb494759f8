"""The velocity that a simulation starts with."""

from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.numerics.sampling import sample_faces
from fluidlift.pipeline.scene import beyond_surface
from fluidlift.types import CellType, FaceVelocity, Grid


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
