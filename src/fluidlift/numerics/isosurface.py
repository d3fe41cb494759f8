"""Triangles of a level set: naive surface nets (Gibson 1998), vectorised."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require

_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


def surface_nets(
    field: Float[np.ndarray, "nx ny nz"],
    *,
    spacing: float = 1.0,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    close: bool = True,
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The surface field = 0, wound so that normals point to positive values.

    Args:
        field: node values, negative inside the body.
        spacing: node distance, m.
        origin: position of node (0, 0, 0), m.
        close: cap the body where it runs out of the box, so that the surface is watertight.

    Returns:
        Vertices (m) and triangles. Empty arrays where the field has no sign change.
    """
    require(field.ndim == 3, f"a field of shape {field.shape}", "[nx,ny,nz]")
    shift = 0
    if close:
        field = np.pad(field, 1, constant_values=float(max(spacing, np.abs(field).max())))
        shift = 1
    inside = field < 0
    cells = tuple(n - 1 for n in field.shape)
    count = np.zeros(cells, np.int8)
    corner = [
        (slice(c[0], c[0] + cells[0]), slice(c[1], c[1] + cells[1]), slice(c[2], c[2] + cells[2])) for c in _CORNERS
    ]
    for c in corner:
        count += inside[c]
    active = np.argwhere((count > 0) & (count < 8))
    if len(active) == 0:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64)
    number = np.full(cells, -1, np.int64)
    number[tuple(active.T)] = np.arange(len(active))
    # a cell's vertex is the mean of the zero crossings on its edges
    values = np.stack([field[c][tuple(active.T)] for c in corner], axis=1)
    total, crossings = np.zeros((len(active), 3)), np.zeros(len(active))
    for a, b in _EDGES:
        va, vb = values[:, a], values[:, b]
        cut = (va < 0) != (vb < 0)
        t = np.where(cut, va / np.where(cut, va - vb, 1.0), 0.0)
        total += np.where(cut[:, None], _CORNERS[a] + t[:, None] * (_CORNERS[b] - _CORNERS[a]), 0.0)
        crossings += cut
    vertices = (active + total / crossings[:, None] - shift) * spacing + np.asarray(origin)
    # every grid edge with a sign change joins the four cells around it
    faces = []
    for axis in range(3):
        p, q = (axis + 1) % 3, (axis + 2) % 3
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        for s in (p, q):
            low[s] = high[s] = slice(1, -1)
        first, second = inside[tuple(low)], inside[tuple(high)]
        edge = np.argwhere(first != second)
        outward = first[tuple(edge.T)]  # inside at the low end: the normal points along +axis
        base = edge.copy()
        base[:, p] += 1
        base[:, q] += 1
        ring = []
        for dp, dq in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
            cell = base.copy()
            cell[:, p] += dp
            cell[:, q] += dq
            ring.append(number[tuple(cell.T)])
        a, b, c, d = ring
        quads = np.where(outward[:, None], np.stack([a, b, c, d], 1), np.stack([d, c, b, a], 1))
        faces += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int64)
