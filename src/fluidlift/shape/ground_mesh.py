"""The ground as a block that one can pick up: a surface over its box, closed at the sides and below."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage
from scipy.spatial import cKDTree

from fluidlift.errors import require
from fluidlift.types import Grid, PinholeCamera, TriangleMesh

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


def ground_colours(
    mesh: TriangleMesh, plate: UInt8[np.ndarray, "h w 3"], camera: PinholeCamera
) -> Float[np.ndarray, "v 3"]:
    """sRGB in [0, 1] of each vertex of a terrain.

    What the picture shows gets its colour from there. Ground beyond the picture goes on as the seen ground beside it,
    evened out: the last pixel would be drawn into long streaks. The cut sides and the floor show plain earth.

    Args:
        mesh: of the terrain, world.
        plate: the scene without its fluid.
        camera: in the world.
    """
    vertices = mesh.vertices.astype(np.float64)
    uv, depth = camera.project(vertices)
    row, col, _ = camera.nearest_pixels(vertices)
    colours = plate[row, col].astype(np.float32) / 255.0
    seen = (depth > 0) & (uv >= 0).all(axis=-1) & (uv < np.array(camera.size)).all(axis=-1)
    cut = _cut_vertices(mesh)
    known = seen & ~cut
    if not known.any():
        return colours
    colours[cut] = 0.75 * np.median(colours[known], axis=0)
    hidden = ~seen & ~cut
    if hidden.any():
        nearest = cKDTree(vertices[known, :2]).query(vertices[hidden, :2], k=min(32, int(known.sum())))[1]
        colours[hidden] = colours[known][nearest.reshape(int(hidden.sum()), -1)].mean(axis=1)
    return colours


def _cut_vertices(mesh: TriangleMesh) -> np.ndarray:
    """bool [v]: on the sides of the mesh's box or its floor, and on no face that looks up."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    up = normal[:, 2] > 0.2 * np.linalg.norm(normal, axis=1)
    top = np.zeros(len(mesh.vertices), bool)
    top[mesh.faces[up].ravel()] = True
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    near = 1e-3 * float((high - low).max())
    side = (np.abs(mesh.vertices - low) < near).any(axis=1) | (np.abs(mesh.vertices - high) < near)[:, :2].any(axis=1)
    return side & ~top
