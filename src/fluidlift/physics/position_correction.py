"""Position correction against clumps: particles are spread from crowded places, their velocity left alone.

After Kugelstadt, Longva, Thuerey, Bender 2019, "Implicit density projection for volume conserving liquids": where
particles fill more than a cell holds, a displacement field with the divergence of the excess spreads them. Cells
inside the liquid that are underfilled draw particles in, more gently; at the free surface a cell may be partly empty.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numba import njit

from fluidlift.numerics.poisson import solve
from fluidlift.numerics.sampling import sample_faces
from fluidlift.numerics.sharing import shared
from fluidlift.physics.pressure import PressureSystem, subtract_gradient
from fluidlift.physics.transfer import CellOrder, deposit_to_cells
from fluidlift.types import FaceVelocity, Grid

TOLERATED = 0.05
"""share of excess that is left alone: the noise of irregular sampling"""
RELAXATION = 0.5
"""share of the remaining excess that one step takes away"""
LARGEST_EXCESS = 0.5
LARGEST_LACK = 0.3
"""of cells without a face to the air"""
LARGEST_MOVE = 0.2
"""cells per step"""


def fill_ratio(
    positions: np.ndarray, volumes: np.ndarray, grid: Grid, order: CellOrder, capacity: np.ndarray
) -> Float[np.ndarray, "nx ny nz"]:
    """Volume (m^3) of the particles around each cell centre over what fits there."""
    return deposit_to_cells(positions, volumes, grid, order) / (grid.spacing**3 * np.maximum(capacity, 0.25))


def spreading(
    positions: Float[np.ndarray, "n 3"],
    ratio: Float[np.ndarray, "nx ny nz"],
    capacity: Float[np.ndarray, "nx ny nz"],
    system: PressureSystem,
    grid: Grid,
    order: CellOrder,
) -> Float[np.ndarray, "n 3"] | None:
    """Displacement (m) of each particle that evens out the filling, or None where it is even."""
    excess = np.clip(ratio - 1.0 - TOLERATED, 0.0, LARGEST_EXCESS)
    surface = system.boundary_term(np.ones(grid.shape)) > 0
    # slivers of open space between the cell and the bed never count as full: drawing into them would never end
    lack = np.where(surface | (capacity < 0.5), 0.0, np.clip(ratio - 1.0 + TOLERATED, -LARGEST_LACK, 0.0))
    wanted = np.where(system.unknown, RELAXATION * excess + 0.5 * RELAXATION * lack, 0.0) * capacity
    if not wanted.any():
        return None
    # a rough solution will do: what it leaves, the next step takes
    psi, _ = solve(system, wanted, tolerance=0.1, max_iterations=6)
    field = subtract_gradient(FaceVelocity.zeros(grid), system, psi)
    return limited_moves(field, grid, positions, LARGEST_MOVE * grid.spacing, order)


def limited_moves(
    field: FaceVelocity, grid: Grid, positions: Float[np.ndarray, "n 3"], limit: float, order: CellOrder
) -> Float[np.ndarray, "n 3"]:
    """A displacement on faces (m) at positions (trilinear), shortened to at most `limit` (m)."""
    moves = np.empty((len(positions), 3), np.float32)
    _sample_moves(positions, order.order, grid.low, grid.spacing, *field.components, np.float32(limit), moves)
    return moves


def limited_moves_plain(
    field: FaceVelocity, grid: Grid, positions: Float[np.ndarray, "n 3"], limit: float
) -> Float[np.ndarray, "n 3"]:
    """`limited_moves` as it reads."""
    moves = sample_faces(field, grid, positions)
    length = np.sqrt(np.square(moves).sum(axis=1, keepdims=True))
    return moves * np.minimum(1.0, limit / np.maximum(length, 1e-30))


@njit(cache=True)
def _trilinear(field, x, y, z):
    """Value at a place in cells of the field's own lattice, the outermost one continued."""
    nx, ny, nz = field.shape
    x = min(max(x, np.float32(0.0)), np.float32(nx - 1))
    y = min(max(y, np.float32(0.0)), np.float32(ny - 1))
    z = min(max(z, np.float32(0.0)), np.float32(nz - 1))
    i, j, k = min(np.int64(x), nx - 2), min(np.int64(y), ny - 2), min(np.int64(z), nz - 2)
    i, j, k = max(i, 0), max(j, 0), max(k, 0)
    i1, j1, k1 = min(i + 1, nx - 1), min(j + 1, ny - 1), min(k + 1, nz - 1)
    fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    one = np.float32(1.0)
    low = (field[i, j, k] * (one - fz) + field[i, j, k1] * fz) * (one - fy)
    low += (field[i, j1, k] * (one - fz) + field[i, j1, k1] * fz) * fy
    high = (field[i1, j, k] * (one - fz) + field[i1, j, k1] * fz) * (one - fy)
    high += (field[i1, j1, k] * (one - fz) + field[i1, j1, k1] * fz) * fy
    return low * (one - fx) + high * fx


@shared(lambda positions, order, *_: (0, len(order)))
def _sample_moves(begin, end, positions, order, low, h, u, v, w, limit, moves):
    inverse = np.float32(1.0 / h)
    half = np.float32(0.5)
    x0, y0, z0 = np.float32(low[0]), np.float32(low[1]), np.float32(low[2])
    for m in range(begin, end):
        p = order[m]
        x = (positions[p, 0] - x0) * inverse
        y = (positions[p, 1] - y0) * inverse
        z = (positions[p, 2] - z0) * inverse
        a = _trilinear(u, x, y - half, z - half)
        b = _trilinear(v, x - half, y, z - half)
        c = _trilinear(w, x - half, y - half, z)
        length = np.sqrt(a * a + b * b + c * c)
        share = limit / length if length > limit else np.float32(1.0)
        moves[p, 0], moves[p, 1], moves[p, 2] = a * share, b * share, c * share
