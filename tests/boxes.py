"""Boxes: open shares of faces, and walls for bodies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fluidlift.physics import boundaries
from fluidlift.physics.boundaries import Walls
from fluidlift.types import Grid, Terrain, TriangleMesh


def closed_box(shape: tuple[int, int, int]) -> list[np.ndarray]:
    """Weights of the faces of a box whose sides let nothing through."""
    weights = []
    for axis in range(3):
        w = np.ones(tuple(n + (a == axis) for a, n in enumerate(shape)), np.float32)
        np.moveaxis(w, axis, 0)[[0, -1]] = 0.0
        weights.append(w)
    return weights


def walls_of(
    shape: tuple[int, int, int], distance: Callable[[np.ndarray], np.ndarray] | None = None, open_top: bool = True, *,
    spacing: float = 0.05, regions: np.ndarray | None = None,
) -> Walls:  # fmt: skip
    """A box; `distance` gives the terrain from the nodes."""
    grid = Grid(shape, spacing)
    nodes = np.full(tuple(n + 1 for n in shape), 100.0) if distance is None else distance(grid.nodes())
    terrain = Terrain(grid, np.float32(nodes), np.eye(3)[0], TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
    open_sides = np.zeros((3, 2), bool)
    open_sides[2, 1] = open_top
    return boundaries.build_walls(terrain, np.zeros(shape, np.uint8) if regions is None else regions, open_sides)
