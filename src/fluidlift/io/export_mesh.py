"""Meshes for other tools: glTF binary (y up), PLY and OBJ (z up)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fluidlift.errors import require
from fluidlift.io.atomic import atomic_write
from fluidlift.io.export_gltf import write_gltf
from fluidlift.io.ply import write_mesh
from fluidlift.types import TriangleMesh

__all__ = ["write_glb", "write_mesh", "write_obj"]


def write_glb(path: Path | str, mesh: TriangleMesh, *, name: str = "terrain") -> Path:
    """Write a binary glTF: y up and metres, as glTF demands; with its texture (a PNG inside the file), or with vertex
    colours in linear light where it has none.

    Raises:
        ValueError: a mesh without faces, which glTF does not allow.
    """
    require(len(mesh.faces) > 0 and len(mesh.vertices) > 0, "an empty mesh", "at least one triangle")
    return write_gltf(path, meshes={name: mesh})


def write_obj(path: Path | str, mesh: TriangleMesh, *, comment: str = "metres, z up") -> Path:
    """Write a Wavefront OBJ as it stands; vertex colours follow the coordinates. The comment says in which axes and
    units it stands."""
    columns = [np.asarray(mesh.vertices, np.float64)]
    if mesh.colors is not None:
        columns.append(np.clip(np.asarray(mesh.colors, np.float64), 0, 1))
    table = np.concatenate(columns, axis=1)
    with atomic_write(path) as file:
        file.write(f"# {comment}\n".encode())
        np.savetxt(file, table, fmt="v" + " %.7g" * table.shape[1])
        np.savetxt(file, np.asarray(mesh.faces, np.int64) + 1, fmt="f %d %d %d")
    return Path(path)
