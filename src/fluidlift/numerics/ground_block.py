"""The ground as a block that one can pick up: a surface over its box, closed at the sides and below."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.types import Grid, TriangleMesh

PARTS = 2
"""faces along a cell: cells are as wide as the water can be simulated, the eye sees their edges"""


def ground_mesh(grid: Grid, heights: Float[np.ndarray, "nx+1 ny+1"], *, parts: int = PARTS) -> TriangleMesh:
    """A closed mesh under a height field, with vertices shared by all faces that meet in them.

    The top is a smooth surface through the heights; the sides go straight down to a floor two cells below its lowest
    point, all around alike. There is no wall where the fluid enters or leaves.

    Args:
        grid: its nodes carry the heights.
        heights: z of the ground, m.
        parts: faces along a cell.

    Raises:
        ValueError: heights of another shape, or that are not finite.
    """
    nx, ny = grid.shape[:2]
    require(heights.shape == (nx + 1, ny + 1), f"heights {heights.shape}", f"{(nx + 1, ny + 1)}")
    require(bool(np.isfinite(heights).all()), "heights that are not finite")
    h = grid.spacing / parts
    columns = np.meshgrid(*(np.linspace(0, n, n * parts + 1) for n in (nx, ny)), indexing="ij")
    z = ndimage.map_coordinates(heights.astype(np.float64), columns, order=3, mode="nearest")
    x, y = (grid.low[a] + columns[a] * grid.spacing for a in (0, 1))
    floor = float(z.min()) - 2.0 * grid.spacing
    number = np.arange(z.size).reshape(z.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    top = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    rim = np.concatenate([number[:-1, 0], number[-1, :-1], number[:0:-1, -1], number[0, :0:-1]])
    vertices = [np.stack([x.ravel(), y.ravel(), z.ravel()], -1)]
    edge, rings = vertices[0][rim], [rim]
    count = int(np.clip(np.ceil((float(edge[:, 2].max()) - floor) / h), 1, 64))
    for k in range(1, count + 1):
        ring = edge.copy()
        ring[:, 2] += (floor - edge[:, 2]) * k / count
        rings.append(z.size + (k - 1) * len(rim) + np.arange(len(rim)))
        vertices.append(ring)
    faces = [top]
    for upper, lower in zip(rings[:-1], rings[1:], strict=True):
        p, q, r, s = upper, np.roll(upper, -1), np.roll(lower, -1), lower
        faces += [np.stack([p, s, r], -1), np.stack([p, r, q], -1)]
    centre = np.array([[0.5 * (x.min() + x.max()), 0.5 * (y.min() + y.max()), floor]])
    last = z.size + count * len(rim)
    faces.append(np.stack([np.roll(rings[-1], -1), rings[-1], np.full(len(rim), last)], -1))
    return TriangleMesh(np.concatenate([*vertices, centre]).astype(np.float32), np.concatenate(faces).astype(np.int64))
