"""Triangle meshes from files of strangers: OBJ, PLY and binary glTF. Nothing is allocated on a file's word alone."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.limits import require_file, require_size
from fluidlift.io.ply import AXES, read_mesh
from fluidlift.types import TriangleMesh

SUFFIXES = (".obj", ".ply", ".glb")

_MAX_BYTES = 256 * 2**20
_MAX_NODES = 10_000
_MAX_VERTICES = 5_000_000
_KINDS = {5121: np.dtype("<u1"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942


def read_any_mesh(path: Path | str) -> TriangleMesh:
    """A mesh in metres with z up, with the vertex colours (sRGB) of an OBJ or PLY that has them.

    OBJ and PLY are taken as they are (metres, z up); glTF is y up by definition and is turned. Polygons of an OBJ
    become fans of triangles. Materials, normals, texture coordinates and colours of a glTF are left out.

    Raises:
        InputRejected: no such file, another format, larger than 256 MB, damaged, without triangles, or with what this
            reader does not know (compressed or sparse glTF, ASCII PLY).
    """
    path = require_file(path, "mesh file")
    if path.suffix.lower() not in SUFFIXES:
        raise InputRejected(f"'{path.name}' as a mesh", "a file that ends in " + ", ".join(SUFFIXES), "convert it")
    require_size(path, _MAX_BYTES, "mesh file")
    read = {".obj": _read_obj, ".ply": _read_ply, ".glb": _read_glb}[path.suffix.lower()]
    try:
        mesh = read(path)
    except (ValueError, KeyError, IndexError, TypeError, struct.error, RecursionError, OverflowError) as error:
        raise InputRejected(
            f"'{path.name}' cannot be read as a mesh ({error})", "a whole file", "export it again"
        ) from None
    if not len(mesh.faces):
        raise InputRejected(f"'{path.name}' holds no triangles", "a closed surface of triangles")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise InputRejected(f"'{path.name}' has faces that name missing vertices", "a whole mesh", "export it again")
    if not np.isfinite(mesh.vertices).all():
        raise InputRejected(f"'{path.name}' has vertices that are not finite", "finite coordinates", "export it again")
    return mesh


def _read_ply(path: Path) -> TriangleMesh:
    mesh = read_mesh(path)
    return TriangleMesh(mesh.vertices.astype(np.float64), mesh.faces, mesh.colors)


def _read_obj(path: Path) -> TriangleMesh:
    """`v` and `f` lines; `f` counts from 1, or backwards from the last vertex where it is negative.

    A vertex may be followed by its colour: three more numbers from 0 to 1. Taken where all of them have one.
    """
    vertices: list[list[float]] = []
    colors: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    with path.open("r", encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            words = line.split()
            if not words:
                continue
            try:
                if words[0] == "v":
                    vertices.append([float(w) for w in words[1:4]])
                    if len(vertices[-1]) != 3:
                        raise ValueError("a vertex of fewer than three numbers")
                    if len(words) == 7:
                        colors.append([float(w) for w in words[4:7]])
                elif words[0] == "f":
                    corner = [_obj_index(w, len(vertices)) for w in words[1:]]
                    if len(corner) < 3:
                        raise ValueError("a face of fewer than three corners")
                    faces += [(corner[0], corner[i], corner[i + 1]) for i in range(1, len(corner) - 1)]
            except ValueError as error:
                raise ValueError(f"line {number}: {error}") from None
    places, triangles = np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3)
    painted = np.array(colors, np.float32).reshape(-1, 3)
    whole = len(painted) == len(places) > 0 and bool(((painted >= 0) & (painted <= 1)).all())
    return TriangleMesh(places, triangles, painted if whole else None)


def _obj_index(word: str, count: int) -> int:
    index = int(word.split("/", 1)[0])
    index = index - 1 if index > 0 else count + index
    if not 0 <= index < count:
        raise ValueError(f"a face that names vertex '{word[:20]}' of {count}")
    return index


def _read_glb(path: Path) -> TriangleMesh:
    scene, binary = _chunks(path.read_bytes())
    required = scene.get("extensionsRequired", [])
    if required:
        raise ValueError(f"it needs the extension {str(required[0])[:40]}, which this reader does not know")
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    count = 0
    for node, world in _placed_nodes(scene):
        if "mesh" not in node:
            continue
        for primitive in scene["meshes"][_index(node["mesh"])]["primitives"]:
            if primitive.get("mode", 4) != 4:
                continue  # points and lines bound nothing
            points = _accessor(scene, binary, primitive["attributes"]["POSITION"], "VEC3")
            points = points.astype(np.float64) @ world[:3, :3].T + world[:3, 3]
            if "indices" in primitive:
                corner = _accessor(scene, binary, primitive["indices"], "SCALAR").astype(np.int64).ravel()
            else:
                corner = np.arange(len(points))
            if len(corner) and corner.max() >= len(points):
                raise ValueError("faces that name missing vertices")
            triangles = corner[: len(corner) // 3 * 3].reshape(-1, 3) + count
            if np.linalg.det(world[:3, :3]) < 0:  # a mirror turns the surface inside out
                triangles = triangles[:, ::-1]
            vertices.append(points)
            faces.append(triangles)
            count += len(points)
            if count > _MAX_VERTICES:
                raise ValueError(f"more than {_MAX_VERTICES} vertices")
    if not vertices:
        raise ValueError("no triangles")
    return TriangleMesh(np.concatenate(vertices) @ AXES["y_up"], np.concatenate(faces))


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a GLB."""
    magic, version, length = struct.unpack_from("<4sII", data)
    if magic != b"glTF" or version != 2:
        raise ValueError("no binary glTF 2.0")
    data = data[: min(length, len(data))]
    at, scene, binary = 12, None, b""
    while at + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > len(data):
            raise ValueError("it breaks off")
        chunk = data[at + 8 : at + 8 + size]
        if kind == _JSON and scene is None:
            scene = json.loads(chunk)
        elif kind == _BINARY and not binary:
            binary = chunk
        at += 8 + size
    if not isinstance(scene, dict):
        raise ValueError("no scene")
    return scene, binary


def _index(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"the index {value!r}")
    return value


def _placed_nodes(scene: dict[str, Any]) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Nodes of the scene with their transforms world_from_node; each node at most once."""
    nodes = scene.get("nodes", [])
    roots = scene["scenes"][_index(scene.get("scene", 0))].get("nodes", []) if scene.get("scenes") else []
    queue = [(_index(i), np.eye(4)) for i in roots]
    seen: set[int] = set()
    out = []
    while queue:
        index, parent = queue.pop(0)
        if index in seen or len(seen) > _MAX_NODES:
            raise ValueError("a node that is its own ancestor, or too many nodes")
        seen.add(index)
        world = parent @ _transform(nodes[index])
        out.append((nodes[index], world))
        queue += [(_index(i), world) for i in nodes[index].get("children", [])]
    return out


def _transform(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64)
    norm = x * x + y * y + z * z + w * w
    if not norm > 0:
        raise ValueError("a rotation of length 0")
    s = 2.0 / norm
    rotation = np.array([
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ])  # fmt: skip
    out = np.eye(4)
    out[:3, :3] = rotation * np.array(node.get("scale", [1, 1, 1]), np.float64)
    out[:3, 3] = np.array(node.get("translation", [0, 0, 0]), np.float64)
    return out


def _accessor(scene: dict[str, Any], binary: bytes, number: Any, kind: str) -> np.ndarray:
    """The values of an accessor, inside the file's own buffer."""
    accessor = scene["accessors"][_index(number)]
    if accessor["type"] != kind or "sparse" in accessor or "bufferView" not in accessor:
        raise ValueError("a sparse or empty accessor, or one of another type")
    dtype = _KINDS[accessor["componentType"]]
    if kind == "VEC3" and dtype.kind != "f":
        raise ValueError("positions that are not floating-point numbers")
    view = scene["bufferViews"][_index(accessor["bufferView"])]
    if _index(view.get("buffer", 0)) != 0 or "uri" in scene["buffers"][0]:
        raise ValueError("data in another file")
    width = 3 if kind == "VEC3" else 1
    count, item = _index(accessor["count"]), dtype.itemsize * width
    stride = _index(view.get("byteStride", item)) or item
    offset = _index(view.get("byteOffset", 0)) + _index(accessor.get("byteOffset", 0))
    end = min(_index(view.get("byteOffset", 0)) + _index(view["byteLength"]), len(binary))
    if count == 0:
        return np.zeros((0, width), dtype)
    if stride < item or offset + (count - 1) * stride + item > end:
        raise ValueError("an accessor that reaches beyond its data")
    return np.ndarray((count, width), dtype, binary, offset, (stride, dtype.itemsize)).copy()
