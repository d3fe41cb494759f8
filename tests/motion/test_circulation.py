"""Standing water: waves that pass over it are no current, whirls are."""

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.motion.circulation import circulating
from fluidlift.types import CellType, Grid, SurfaceMotion

N, H = 40, 0.1
GRID = Grid((N, N, 6), H, (-2.0, -2.0, 0.0))
TOP = 4


def basin(shore=0.0):
    """A round basin of 1.6 m radius, [N,N,6]; of a beach the bed rises over `shore` m to its outline."""
    centers = GRID.centers()
    inside = 1.6 - np.hypot(centers[..., 0], centers[..., 1])
    bed = 0.4 * np.clip(1.0 - inside / shore, 0.0, 1.0) if shore else 0.0
    wet = (inside > 0) & (centers[..., 2] < H * TOP) & (centers[..., 2] > bed)
    return np.where(wet, CellType.FLUID, CellType.EMPTY).astype(np.uint8)


def seen(cells, velocity_of):
    """Samples on the surface of a basin, and their velocities m/s."""
    points = GRID.centers()[:, :, TOP - 1][(cells == CellType.FLUID).any(axis=2)]
    u, v = velocity_of(points[:, 0], points[:, 1])
    moving = np.stack([u * np.ones(len(points)), v * np.ones(len(points)), np.zeros(len(points))], axis=-1)
    return SurfaceMotion(points, moving, np.ones(len(points), bool))


@pytest.mark.parametrize("shore", [0.0, 1.0], ids=["walls", "beach"])
@pytest.mark.parametrize(
    "waves",
    [lambda x, y: (1.0, 0.3), lambda x, y: (1.0 - 0.5 * x, 0.0), lambda x, y: (0.5 * x, 0.5 * y)],
    ids=["a train", "a train that slows down", "what flows apart"],
)
def test_crests_that_run_through_are_no_current(shore, waves):
    cells = basin(shore)
    found, share = circulating(seen(cells, waves), cells, GRID)
    assert share < 0.02
    assert np.abs(found.velocities).max() < 0.05


def test_a_whirl_stays_and_waves_over_it_go():
    cells = basin()
    whirl = seen(cells, lambda x, y: (-y, x))
    found, share = circulating(whirl, cells, GRID)
    inner = np.hypot(*whirl.points[:, :2].T) < 1.2
    assert share > 0.85
    assert np.abs(found.velocities - whirl.velocities)[inner].max() < 0.15
    over, less = circulating(seen(cells, lambda x, y: (0.5 - y, x)), cells, GRID)
    same = (over.velocities * found.velocities).sum() / np.square(found.velocities).sum()
    assert 0.5 < same < 1.0 and less < share, "waves take as much off the whirl as their errors may have put in"
    assert np.abs(over.velocities - same * found.velocities).max() < 0.05


def test_nothing_passes_the_outline_nor_gathers_anywhere():
    cells, rng = basin(1.0), np.random.default_rng(0)
    a, b = rng.normal(size=(2, 3))
    field = seen(cells, lambda x, y: (0.2 * (a[0] + a[2] * x * y) - y, 0.2 * (b[0] + b[2] * x * y) + 0.7 * x))
    found, _ = circulating(field, cells, GRID)
    depth = (cells == CellType.FLUID).sum(axis=2) * H
    flux = np.zeros((N, N, 2))
    flux[depth > 0] = found.velocities[:, :2] * depth[depth > 0][:, None]
    across = flux.sum(axis=(1,))[:, 0] * H  # m^3/s through every section x = const
    size = float(np.abs(flux[..., 0]).sum(axis=1).max()) * H
    assert np.abs(across).max() < 0.03 * size


def test_crests_that_are_seen_here_and_not_there_leave_no_whirl():
    cells, rng = basin(), np.random.default_rng(1)
    patchy = ndimage.gaussian_filter(rng.random((N, N)), 3.0)
    patchy = (patchy - patchy.min()) / np.ptp(patchy)
    at = (cells == CellType.FLUID).any(axis=2)
    found, share = circulating(seen(cells, lambda x, y: (patchy[at], 0.0)), cells, GRID)
    assert share == 0.0 and not found.velocities.any()


def test_what_is_not_seen_keeps_still():
    cells = basin()
    far = SurfaceMotion(np.array([[9.0, 9.0, 9.0]]), np.ones((1, 3)), np.ones(1, bool))
    found, share = circulating(far, cells, GRID)
    assert share == 0.0
    assert not found.velocities.any()
