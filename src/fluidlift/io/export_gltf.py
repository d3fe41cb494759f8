"""glTF binary: one instant of a fluid with its ground and its camera. y up and metres, as glTF demands.

Splats follow KHR_gaussian_splatting (Khronos, ratified 2026): points whose attributes hold orientation (x, y, z, w),
linear scales, opacities and harmonics; tools that do not know it show coloured points. The extension has no animation.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import require
from fluidlift.io.frames import FluidFrame
from fluidlift.io.glb import INDICES, Glb
from fluidlift.io.ply import AXES
from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types import Gaussians, PinholeCamera, Similarity3, TriangleMesh, quat_from_matrix

SPLATS = "KHR_gaussian_splatting"
_GLTF_FROM_WORLD = AXES["y_up"]
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""a glTF camera looks along -z with y up"""


def write_gltf(
    path: Path | str,
    *,
    gaussians: Gaussians | None = None,
    meshes: dict[str, TriangleMesh] | None = None,
    camera: PinholeCamera | None = None,
    whitewater: FluidFrame | None = None,
) -> Path:
    """Write a .glb with what is given.

    Args:
        gaussians: world, m; become the node "fluid".
        meshes: by name, world, m; those without faces are left out, because glTF allows none.
        camera: becomes the node "camera". glTF has no place for a principal point off the middle: `extras` keeps K.
        whitewater: with kinds, and nothing else in it; becomes the node "white water", points without size.

    Raises:
        ValueError: nothing to write.
        InputRejected: the disk does not take it.
    """
    glb = Glb()
    shown = {name: mesh for name, mesh in (meshes or {}).items() if len(mesh.faces) and len(mesh.vertices)}
    require(bool(shown) or bool(gaussians), "neither splats nor a mesh with triangles", "one of them")
    if gaussians is not None and len(gaussians):
        glb.add("nodes", {"name": "fluid", "mesh": _splats(glb, gaussians)})
    for name, mesh in shown.items():
        glb.add("nodes", {"name": name, "mesh": _mesh(glb, mesh, name)})
    if whitewater is not None and len(whitewater.gaussians):
        glb.add("nodes", {"name": "white water", "mesh": _whitewater(glb, whitewater)})
    if camera is not None:
        glb.add("nodes", _camera(glb, camera))
    return glb.write(path)


def _splats(glb: Glb, gaussians: Gaussians) -> int:
    g = gaussians.transformed(Similarity3(rotation=_GLTF_FROM_WORLD))
    n = len(g)
    quats = g.quats / np.maximum(np.linalg.norm(g.quats, axis=1, keepdims=True), 1e-12)
    fallback = _colors(g)
    attributes = {
        "POSITION": glb.array(g.means, bounds=True),
        "COLOR_0": glb.array(fallback, normalized=True),
        f"{SPLATS}:ROTATION": glb.array(quats[:, [1, 2, 3, 0]].astype(np.float32)),
        f"{SPLATS}:SCALE": glb.array(g.scales),
        f"{SPLATS}:OPACITY": glb.array(np.clip(g.opacities, 0.0, 1.0).reshape(n)),
    }
    for k in range(g.sh.shape[1]):
        degree = math.isqrt(k)
        attributes[f"{SPLATS}:SH_DEGREE_{degree}_COEF_{k - degree**2}"] = glb.array(g.sh[:, k])
    glb.extension(SPLATS)
    said = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
            "sortingMethod": "cameraDistance"}  # fmt: skip
    return glb.add("meshes", {
        "name": "splats", "primitives": [{"attributes": attributes, "mode": 0, "extensions": {SPLATS: said}}],
    })  # fmt: skip


def _colors(g: Gaussians) -> np.ndarray:
    """u8 [n,4], linear light and opacity."""
    rgb = np.round(255 * linear_from_srgb(g.rgb.astype(np.float64)))
    return np.concatenate([rgb, np.round(255 * np.clip(g.opacities, 0, 1))[:, None]], axis=1).astype(np.uint8)


def _whitewater(glb: Glb, white: FluidFrame) -> int:
    """Points. What glTF has no name for stands in attributes of the application, which begin with an underscore."""
    assert white.kinds is not None
    turned = [(a.astype(np.float64) @ _GLTF_FROM_WORLD.T).astype(np.float32)
              for a in (white.gaussians.means, np.asarray(white.velocities))]  # fmt: skip
    attributes = {
        "POSITION": glb.array(turned[0], bounds=True),
        "COLOR_0": glb.array(_colors(white.gaussians), normalized=True),
        "_VELOCITY": glb.array(turned[1]),
        "_KIND": glb.array(white.kinds.astype(np.float32)),
    }
    look = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = glb.add("materials", {"name": "white water", "pbrMetallicRoughness": look, "alphaMode": "BLEND"})
    return glb.add("meshes", {
        "name": "white water", "primitives": [{"attributes": attributes, "material": material, "mode": 0}],
    })  # fmt: skip


def _mesh(glb: Glb, mesh: TriangleMesh, name: str) -> int:
    """Triangles with normals (without them a viewer has to show every triangle flat), and with a texture or, where
    there is none, vertex colours in linear light."""
    vertices, faces, uv = once_per_corner(mesh)
    points = (np.asarray(mesh.vertices, np.float64) @ _GLTF_FROM_WORLD.T).astype(np.float32)
    normals = (vertex_normals(mesh) @ _GLTF_FROM_WORLD.T).astype(np.float32)
    attributes = {
        "POSITION": glb.array(points[vertices], bounds=True),
        "NORMAL": glb.array(normals[vertices]),
    }
    look: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    if uv is not None and mesh.texture is not None:
        attributes["TEXCOORD_0"] = glb.array(uv)
        look["baseColorTexture"] = {"index": glb.picture(encoded(mesh.texture, "PNG"), "image/png")}
    elif mesh.colors is not None:
        linear = np.round(65535 * linear_from_srgb(np.clip(np.asarray(mesh.colors, np.float64), 0, 1)))
        color = np.concatenate([linear, np.full((len(linear), 1), 65535)], axis=1).astype(np.uint16)
        attributes["COLOR_0"] = glb.array(color[vertices], normalized=True)
    material = glb.add("materials", {"name": name, "pbrMetallicRoughness": look, "doubleSided": True})
    indices = glb.array(faces.ravel().astype(np.uint32), target=INDICES)
    return glb.add("meshes", {
        "name": name, "primitives": [{"attributes": attributes, "indices": indices, "material": material, "mode": 4}],
    })  # fmt: skip


def once_per_corner(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """(vertex of the mesh that each written one is, faces over the written ones, their texture coordinates).

    A file with one texture coordinate per vertex holds a vertex on a seam once for each side.
    """
    if mesh.uv is None:
        return np.arange(len(mesh.vertices)), np.asarray(mesh.faces), None
    corners = np.concatenate([mesh.faces.reshape(-1, 1), mesh.uv.reshape(-1, 2)], axis=1, dtype=np.float64)
    once, number = np.unique(corners, axis=0, return_inverse=True)
    return once[:, 0].astype(np.int64), number.reshape(-1, 3), once[:, 1:].astype(np.float32)


def encoded(picture: np.ndarray, kind: str, **options: Any) -> bytes:
    """A picture u8 [H,W,3] as the bytes of a PNG or JPEG file."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(picture).save(out, kind, **options)
    return out.getvalue()


def _camera(glb: Glb, camera: PinholeCamera) -> dict[str, Any]:
    (_, fy), (width, height) = camera.focal, camera.size
    lens = {"yfov": 2.0 * math.atan(0.5 * height / fy), "aspectRatio": width * fy / (height * camera.focal[0]),
            "znear": 0.01}  # fmt: skip
    index = glb.add("cameras", {"name": "camera", "type": "perspective", "perspective": lens})
    turned = _GLTF_FROM_WORLD @ camera.camera_from_world.rotation.T @ _OPENGL_FROM_OPENCV
    w, x, y, z = quat_from_matrix(turned).tolist()
    return {
        "name": "camera", "camera": index, "rotation": [x, y, z, w],
        "translation": (_GLTF_FROM_WORLD @ camera.position).tolist(), "extras": camera.to_dict(),
    }  # fmt: skip
