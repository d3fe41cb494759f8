"""A bath duck as a closed mesh: a few ellipsoids that melt into each other.

python benchmarks/edits/duck.py demo.fluid/duck.obj 0.23     # m, its length
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from fluidlift.io.export_mesh import write_obj
from fluidlift.numerics.isosurface import surface_nets
from fluidlift.types import TriangleMesh

PARTS = (
    ((0.0, 0.0, 0.0), (0.50, 0.42, 0.22)),  # body
    ((0.32, 0.0, 0.34), (0.17, 0.16, 0.17)),  # head
    ((0.54, 0.0, 0.31), (0.13, 0.09, 0.035)),  # beak
    ((-0.46, 0.0, 0.13), (0.16, 0.16, 0.09)),  # tail
)
"""centre and half axes; the duck looks along +x and is about 1.2 long. It is as dense everywhere, without the weight
that a toy has in its keel: with a narrower body, or a larger head, it would float upside down"""
MELT = 0.05
"""width over which parts flow into each other"""
YELLOW, ORANGE, BLACK = (1.0, 0.78, 0.06), (0.95, 0.38, 0.05), (0.04, 0.04, 0.05)
"""sRGB"""
EYES = ((0.445, 0.105, 0.405), (0.445, -0.105, 0.405))
EYE = 0.048
"""radius"""


def duck_mesh(length: float, *, nodes: int = 56) -> TriangleMesh:
    """A duck of a length (m) around its own middle, with vertex colours."""
    step = 1.5 / nodes
    axes = (np.arange(-0.75, 0.85, step), np.arange(-0.45, 0.45, step), np.arange(-0.4, 0.7, step))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    total = sum(np.exp(-_distance(grid, part) / MELT) for part in PARTS)
    low = tuple(float(a[0]) for a in axes)
    vertices, faces = surface_nets(-MELT * np.log(total), spacing=step, origin=low)
    vertices = np.asarray(vertices, np.float64)
    factor = length / float(np.ptp(vertices[:, 0]))
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    return TriangleMesh((vertices - middle) * factor, faces, _colors(vertices))


def _distance(points: np.ndarray, part: tuple[tuple[float, ...], tuple[float, ...]]) -> np.ndarray:
    """To an ellipsoid, about."""
    centre, half = part
    return (np.linalg.norm((points - centre) / np.array(half), axis=-1) - 1.0) * min(half)


def _colors(vertices: np.ndarray) -> np.ndarray:
    """sRGB [v,3]: the beak orange, the eyes black, the rest yellow."""
    nearest = np.argmin([_distance(vertices, part) for part in PARTS], axis=0)
    colors = np.where((nearest == 2)[:, None], ORANGE, YELLOW)
    for eye in EYES:
        colors[np.linalg.norm(vertices - eye, axis=1) < EYE] = BLACK
    return colors.astype(np.float32)


def write_duck(path: Path, length: float) -> TriangleMesh:
    """Write the duck as OBJ: its colours stand behind the vertices."""
    mesh = duck_mesh(length)
    write_obj(path, mesh)
    return mesh


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    write_duck(Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 0.23)
