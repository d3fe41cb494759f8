"""Filling scenes: terrain of a distance, and jittered particles between heights, inside shapes, outside bodies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.numerics.isosurface import surface_nets
from fluidlift.numerics.mesh_distance import mesh_distance
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.rigid import RigidBody
from fluidlift.types import Grid, Terrain, TriangleMesh, matrix_from_quat

PER_AXIS = 2
"""particles along each axis of a cell"""
JITTER = 0.25
"""largest random shift of a particle from its lattice point, in spacings of the lattice"""

Height = Callable[[np.ndarray, np.ndarray], np.ndarray] | float
"""m above z = 0 at (x, y), or the same everywhere"""
Distance = Callable[[Float[np.ndarray, "*n 3"]], Float[np.ndarray, "*n"]]
"""signed distance (m, positive outside) at positions (m)"""


def terrain_of(
    grid: Grid, distance: Distance | None = None, mainstream: tuple[float, ...] = (1.0, 0.0, 0.0)
) -> Terrain:
    """A terrain of a signed distance; None: nothing solid but the sides of the box."""
    shape = tuple(n + 1 for n in grid.shape)
    if distance is None:
        far = float(np.linalg.norm(grid.high - grid.low))
        mesh = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
        return Terrain(grid, np.full(shape, far, np.float32), np.asarray(mainstream, float), mesh)
    values = distance(grid.nodes()).astype(np.float32)
    vertices, faces = surface_nets(values, spacing=grid.spacing, origin=grid.origin, close=False)
    return Terrain(grid, values, np.asarray(mainstream, float), TriangleMesh(vertices, faces))


def between(
    grid: Grid,
    floor: Height,
    surface: Height,
    *,
    x: tuple[float, float] | None = None,
    y: tuple[float, float] | None = None,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Jittered particles between two heights, in columns that are filled exactly from the floor to the surface.

    Args:
        grid: of the scene.
        floor: lower end of the liquid.
        surface: upper end.
        x: range, m; None: the whole box. It is filled exactly too.
        y: range, m.

    Returns:
        Positions (m) and the volume of the liquid (m^3, by the midpoint rule over the columns).
    """
    wish = grid.spacing / PER_AXIS
    axes, steps = [], []
    for axis, extent in enumerate((x, y)):
        low, high = extent or (float(grid.low[axis]), float(grid.high[axis]))
        count = max(1, round((high - low) / wish))
        steps.append((high - low) / count)
        axes.append(low + (np.arange(count) + 0.5) * steps[-1])
    columns = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    bottom, top = (np.broadcast_to(h(*columns.T) if callable(h) else h, len(columns)) for h in (floor, surface))
    depth = np.maximum(top - bottom, 0.0)
    layers = np.round(depth / wish).astype(np.int64)
    column = np.repeat(np.arange(len(columns)), layers)
    layer = np.arange(len(column)) - np.repeat(np.cumsum(layers) - layers, layers)
    step = depth[column] / layers[column]
    points = np.column_stack([columns[column], bottom[column] + (layer + 0.5) * step])
    shift = np.random.default_rng(seed).uniform(-JITTER, JITTER, points.shape)
    points += shift * np.column_stack([np.full(len(step), steps[0]), np.full(len(step), steps[1]), step])
    return points, float(depth.sum() * steps[0] * steps[1])


def inside(grid: Grid, distance: Distance, *, seed: int = 0) -> Float[np.ndarray, "n 3"]:
    """Jittered particles (m) where a signed distance is negative."""
    step = grid.spacing / PER_AXIS
    axes = [grid.low[a] + (np.arange(PER_AXIS * grid.shape[a]) + 0.5) * step for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = points[distance(points) < 0]
    return points + np.random.default_rng(seed).uniform(-JITTER, JITTER, points.shape) * step


def within(body: RigidBody, points: Float[np.ndarray, "n 3"], spacing: float) -> Bool[np.ndarray, " n"]:
    """Which points (m) lie in a body at its start; `spacing` (m) of the grid on which its distance is taken."""
    position, quat = body.start(0.0)
    # sums, not matrix products: the points of a large scene would start threaded BLAS
    local = np.einsum("ij,ni->nj", matrix_from_quat(quat), points - position)
    shape = mesh_distance(body.mesh, spacing)
    near = ((local >= shape.grid.low) & (local <= shape.grid.high)).all(axis=1)
    out = np.zeros(len(points), bool)
    out[near] = sample_nodes(shape.distance, shape.grid, local[near]) < 0
    return out
