"""The compiled advection of a gas is that of array operations."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from fluidlift.physics.maccormack import advect_maccormack
from fluidlift.types import FaceVelocity, Grid


def smooth_velocity(grid: Grid) -> FaceVelocity:
    """Waves of some cells, up to 3 cells a second in cells of 0.1 m."""
    rng = np.random.default_rng(3)
    components = []
    for axis in range(3):
        points = grid.faces(axis)
        waves = sum(np.sin(points @ rng.normal(scale=8.0, size=3) + rng.uniform(0, 6)) for _ in range(4))
        components.append((0.1 * waves).astype(np.float32))
    return FaceVelocity(*components)


def at_faces(component: np.ndarray, own: int, across: int) -> np.ndarray:
    """Component `own` at the faces across an axis: mean of the four nearest, beyond the array its last ones."""
    if own == across:
        return component.astype(np.float64)
    wide = np.pad(component.astype(np.float64), [(int(a == across),) * 2 for a in range(3)], mode="edge")
    low, high = (np.take(wide, range(s, s + component.shape[across] + 1), axis=across) for s in (0, 1))
    both = low + high
    n = both.shape[own]
    return 0.25 * (np.take(both, range(n - 1), axis=own) + np.take(both, range(1, n), axis=own))


def plain(velocity: FaceVelocity, grid: Grid, dt: float) -> list[np.ndarray]:
    """`advect_maccormack` as its formula reads, in double precision."""
    out = []
    for axis, q in enumerate(velocity.components):
        place = np.indices(q.shape).astype(np.float64)
        moved = [dt / grid.spacing * at_faces(c, own, axis) for own, c in enumerate(velocity.components)]
        last = np.array(q.shape).reshape(3, 1, 1, 1) - 1.0
        back, forth = (np.clip(place + sign * np.stack(moved), 0, last) for sign in (-1, 1))
        once = map_coordinates(q.astype(np.float64), back, order=1)
        again = map_coordinates(once, forth, order=1)
        cell = np.minimum(np.floor(back), np.maximum(last - 1, 0)).astype(int)
        end = last.astype(int)
        corners = [q[tuple(np.minimum(cell[a] + step[a], end[a]) for a in range(3))] for step in np.ndindex(2, 2, 2)]
        out.append(np.clip(once + 0.5 * (q - again), np.min(corners, axis=0), np.max(corners, axis=0)))
    return out


@pytest.mark.parametrize("shape", [(9, 7, 8), (1, 6, 5), (4, 1, 1)], ids=str)
@pytest.mark.parametrize("cells", [0.4, 2.5, 40.0])
def test_the_compiled_advection_is_that_of_array_operations(shape, cells):
    grid = Grid(shape, 0.1)
    velocity = smooth_velocity(grid)
    fastest = max(float(np.abs(c).max()) for c in velocity.components)
    dt = cells * grid.spacing / fastest
    moved = advect_maccormack(velocity, grid, dt)
    for component, wanted in zip(moved.components, plain(velocity, grid, dt), strict=True):
        # single precision: a displacement is good to 1e-7 of itself, a velocity changes by its own size within a cell
        np.testing.assert_allclose(component, wanted, atol=fastest * (1e-6 + 3e-7 * cells))


def test_nothing_but_the_range_of_what_was_there_comes_out():
    grid = Grid((8, 8, 8), 0.1)
    velocity = smooth_velocity(grid)
    moved = advect_maccormack(velocity, grid, 0.7)
    for before, after in zip(velocity.components, moved.components, strict=True):
        assert before.min() <= after.min() and after.max() <= before.max()
