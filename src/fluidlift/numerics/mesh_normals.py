"""Normals of triangle meshes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.types import TriangleMesh


def vertex_normals(
    mesh: TriangleMesh, *, otherwise: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> Float[np.ndarray, "v 3"]:
    """Unit normals, those of the faces around weighed by area; `otherwise` where there is no face."""
    points, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    a, b, c = (points[faces[:, k]] for k in range(3))
    across, total = np.cross(b - a, c - a), np.zeros((len(points), 3))
    for k in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, k], across[:, axis], len(points))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, 1e-300), otherwise)
