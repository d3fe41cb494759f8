"""Meshes for other tools: glTF binary (y up), PLY and OBJ (z up)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from fluidlift.errors import require
from fluidlift.io.atomic import atomic_write, write_bytes
from fluidlift.io.color import linear_from_srgb
from fluidlift.io.ply import AXES, write_mesh
from fluidlift.types import TriangleMesh

__all__ = ["write_glb", "write_mesh", "write_obj"]


def write_glb(path: Path | str, mesh: TriangleMesh, *, name: str = "terrain") -> Path:
    """Write a binary glTF: y up and metres, as glTF demands; with its texture (a PNG inside the file), or with vertex
    colours in linear light where it has none.

    Raises:
        ValueError: a mesh without faces, which glTF does not allow.
    """
    require(len(mesh.faces) > 0 and len(mesh.vertices) > 0, "an empty mesh", "at least one triangle")
    body = _textured(mesh) if mesh.texture is not None else _coloured(mesh)
    scene = trimesh.Scene()
    scene.add_geometry(body, node_name=name, geom_name=name)
    # normals are written: without them a viewer has to show every triangle flat
    return write_bytes(path, scene.export(file_type="glb", include_normals=mesh.texture is not None))


def _coloured(mesh: TriangleMesh) -> trimesh.Trimesh:
    vertices = np.asarray(mesh.vertices, np.float64) @ AXES["y_up"].T
    colors = None
    if mesh.colors is not None:
        linear = np.round(255 * linear_from_srgb(np.asarray(mesh.colors, np.float64))).astype(np.uint8)
        colors = np.concatenate([linear, np.full((len(linear), 1), 255, np.uint8)], axis=1)
    return trimesh.Trimesh(vertices, np.asarray(mesh.faces), vertex_colors=colors, process=False)


def _textured(mesh: TriangleMesh) -> trimesh.Trimesh:
    """glTF knows one texture coordinate per vertex: a vertex on a seam is written once for each side."""
    assert mesh.uv is not None and mesh.texture is not None
    corners = np.concatenate([mesh.faces.reshape(-1, 1), mesh.uv.reshape(-1, 2)], axis=1, dtype=np.float64)
    once, number = np.unique(corners, axis=0, return_inverse=True)
    vertices = np.asarray(mesh.vertices, np.float64)[once[:, 0].astype(np.int64)] @ AXES["y_up"].T
    uv = once[:, 1:] * (1.0, -1.0) + (0.0, 1.0)  # trimesh counts v from below and turns it over again
    material = trimesh.visual.material.PBRMaterial(
        name="terrain", baseColorTexture=Image.fromarray(mesh.texture), metallicFactor=0.0, roughnessFactor=1.0
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, number.reshape(-1, 3), visual=visual, process=False)


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
