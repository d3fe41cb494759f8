"""Triangle meshes from files of strangers: OBJ, PLY and binary glTF. Nothing is allocated on a file's word alone."""

from __future__ import annotations

import struct
from array import array
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.confined import read_confined
from fluidlift.io.limits import ReadLimits, parse_json, require_file, require_size
from fluidlift.io.mesh_textures import (
    MAX_PLAIN,
    Paint,
    corner_colors,
    materials_of,
    one_picture,
    vertex_colors,
)
from fluidlift.io.ply import AXES, read_mesh
from fluidlift.io.ply_records import open_ply
from fluidlift.numerics.srgb import srgb_from_linear
from fluidlift.types import TriangleMesh

SUFFIXES = (".obj", ".ply", ".glb")

_MAX_BYTES = 256 * 2**20
_MAX_NODES = 10_000
MAX_VERTICES = 5_000_000
MAX_TRIANGLES = 3_000_000
"""with their colours and texture coordinates they take 1 GB while they are read"""
_MAX_LINES = 20_000_000
"""of an OBJ: vertices, their normals and coordinates, and triangles, each at their most"""
_MAX_LINE = 2**20
"""characters of a line of an OBJ"""
_MAX_SCENE = 16 * 2**20
"""bytes of the JSON of a GLB"""
_KINDS = {5121: np.dtype("<u1"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942


def read_any_mesh(path: Path | str) -> TriangleMesh:
    """A mesh in metres with z up, with its vertex colours (sRGB), and with one texture where it has pictures.

    OBJ and PLY are taken as they are (metres, z up); glTF is y up by definition and is turned. Polygons of an OBJ
    become fans of triangles. Of materials, the colour and its picture are taken: `Kd` and `map_Kd` of the .mtl beside
    an OBJ, base colours and their PNG or JPEG inside a binary glTF. Pictures of several materials become one, and the
    vertices have its colours for what shows no textures. All else of a material, and normals, are left out.

    Raises:
        InputRejected: no such file, another format, larger than 256 MB, damaged, without triangles, with what this
            reader does not know (compressed or sparse glTF, ASCII PLY), or with pictures that are missing or too large;
            or reading it takes more than `io.confined` lets it take.
    """
    path = require_file(path, "mesh file")
    mesh = read_confined(_read_mesh, path)
    if not len(mesh.faces):
        raise InputRejected(f"'{path.name}' holds no triangles", "a closed surface of triangles")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise InputRejected(f"'{path.name}' has faces that name missing vertices", "a whole mesh", "export it again")
    if not np.isfinite(mesh.vertices).all():
        raise InputRejected(f"'{path.name}' has vertices that are not finite", "finite coordinates", "export it again")
    return mesh


def _read_mesh(path: Path, limits: ReadLimits) -> TriangleMesh:
    """The mesh as it is in the file; nothing of it is checked that reading does not need."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputRejected(f"'{path.name}' as a mesh", "a file that ends in " + ", ".join(SUFFIXES), "convert it")
    require_size(path, _MAX_BYTES, "mesh file")
    read = {".obj": _read_obj, ".ply": _read_ply, ".glb": _read_glb}[path.suffix.lower()]
    try:
        return read(path)
    except (ValueError, LookupError, TypeError, AttributeError, struct.error, ArithmeticError) as error:
        raise InputRejected(
            f"'{path.name}' cannot be read as a mesh ({str(error)[:200]})", "a whole file", "export it again"
        ) from None


def _read_ply(path: Path) -> TriangleMesh:
    elements, _ = open_ply(path)
    for name, most in (("vertex", MAX_VERTICES), ("face", MAX_TRIANGLES)):
        _require_count(elements[name].count if name in elements else 0, most, f"elements '{name}'")
    mesh = read_mesh(path)
    return TriangleMesh(mesh.vertices.astype(np.float64), mesh.faces, mesh.colors)


def _read_obj(path: Path) -> TriangleMesh:
    """`v`, `vt`, `f`, `usemtl` and `mtllib` lines; `f` counts from 1, or backwards from the last one where negative.

    A vertex may be followed by its colour: three more numbers from 0 to 1. Taken where all of them have one.
    """
    obj = _Obj()
    with path.open("r", encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            try:
                _require_count(number, _MAX_LINES, "lines")
                obj.take(line)
            except ValueError as error:
                raise ValueError(f"line {number}: {error}") from None
    places, triangles = np.array(obj.vertices).reshape(-1, 3), np.array(obj.faces, np.int64).reshape(-1, 3)
    colors = np.array(obj.colors, np.float32).reshape(-1, 3)
    whole = len(colors) == len(places) > 0 and bool(((colors >= 0) & (colors <= 1)).all())
    materials = materials_of(path.parent, obj.library) if obj.library and len(triangles) else {}
    if not materials or not obj.names.keys() & materials.keys():
        return TriangleMesh(places, triangles, colors if whole else None)
    paints = [materials.get(name, Paint()) for name in obj.names]
    coordinates = np.concatenate([np.zeros((1, 2)), np.array(obj.coordinates).reshape(-1, 2)])
    uv = coordinates[np.array(obj.corners, np.int64) + 1].reshape(-1, 3, 2)
    uv[..., 1] = 1.0 - uv[..., 1]  # an OBJ counts from the lower left corner
    return _painted(places, triangles, paints, np.array(obj.materials, np.int64), uv)


class _Obj:
    """What the lines of an OBJ add up to; numbers lie in arrays, which take a tenth of the memory of lists."""

    def __init__(self) -> None:
        self.vertices, self.colors, self.coordinates = array("d"), array("d"), array("d")
        self.faces, self.corners, self.materials = array("i"), array("i"), array("i")
        """vertices and coordinates (-1: none) of corners; indices of names"""
        self.names: dict[str, int] = {"": 0}
        self.library = ""
        self._material = 0

    def take(self, line: str) -> None:
        """One line; raises ValueError."""
        if len(line) > _MAX_LINE:
            raise ValueError(f"a line of {len(line)} characters")
        words = line.split()
        if not words:
            return
        if words[0] == "v":
            self._vertex(words)
        elif words[0] == "vt":
            self.coordinates.extend((float(words[1]), float(words[2]) if len(words) > 2 else 0.0))
            _require_count(len(self.coordinates) // 2, MAX_VERTICES, "texture coordinates")
        elif words[0] == "f":
            self._face(words[1:])
        elif words[0] == "usemtl":
            name = line.split(None, 1)[1].strip() if len(words) > 1 else ""
            self._material = self.names.setdefault(name, len(self.names))
            _require_count(len(self.names), MAX_PLAIN, "materials")
        elif words[0] == "mtllib" and len(words) > 1 and not self.library:
            self.library = line.split(None, 1)[1].strip()

    def _vertex(self, words: list[str]) -> None:
        if len(words) < 4:
            raise ValueError("a vertex of fewer than three numbers")
        self.vertices.extend([float(w) for w in words[1:4]])
        _require_count(len(self.vertices) // 3, MAX_VERTICES, "vertices")
        if len(words) == 7:
            self.colors.extend([float(w) for w in words[4:7]])

    def _face(self, words: list[str]) -> None:
        if len(words) < 3:
            raise ValueError("a face of fewer than three corners")
        _require_count(len(self.materials) + len(words) - 2, MAX_TRIANGLES, "triangles")
        corner = [_obj_index(w, len(self.vertices) // 3) for w in words]
        at = [_obj_coordinate(w, len(self.coordinates) // 2) for w in words]
        for i in range(1, len(corner) - 1):
            self.faces.extend((corner[0], corner[i], corner[i + 1]))
            self.corners.extend((at[0], at[i], at[i + 1]))
            self.materials.append(self._material)


def _require_count(count: int, most: int, what: str) -> None:
    if count > most:
        raise ValueError(f"more than {most} {what}")


def _painted(
    places: np.ndarray, faces: np.ndarray, paints: list[Paint], which: np.ndarray, uv: np.ndarray
) -> TriangleMesh:
    """The mesh with the pictures and colours of its materials."""
    texture, at = one_picture(paints, which, uv)
    colors = vertex_colors(len(places), faces, corner_colors(paints, which, uv if at is None else at, texture))
    return TriangleMesh(places, faces, colors, at, texture)


def _obj_index(word: str, count: int) -> int:
    index = int(word.split("/", 1)[0])
    index = index - 1 if index > 0 else count + index
    if not 0 <= index < count:
        raise ValueError(f"a face that names vertex '{word[:20]}' of {count}")
    return index


def _obj_coordinate(word: str, count: int) -> int:
    """Index of a corner's texture coordinate, -1 where it has none or names one that is not there."""
    parts = word.split("/")
    if len(parts) < 2 or not parts[1]:
        return -1
    index = int(parts[1])
    index = index - 1 if index > 0 else count + index
    return index if 0 <= index < count else -1


def _read_glb(path: Path) -> TriangleMesh:
    scene, binary = _chunks(path.read_bytes())
    required = scene.get("extensionsRequired", [])
    if required:
        raise ValueError(f"it needs the extension {str(required[0])[:40]}, which this reader does not know")
    parts: list[tuple[np.ndarray, ...]] = []
    paints = _glb_paints(scene, binary)
    count, built, colored = 0, 0, False
    for node, world in _placed_nodes(scene):
        if "mesh" not in node:
            continue
        for primitive in scene["meshes"][_index(node["mesh"])]["primitives"]:
            if primitive.get("mode", 4) != 4:
                continue  # points and lines bound nothing
            count, built = count + _count_of(scene, primitive, "POSITION"), built + _triangles_of(scene, primitive)
            _require_count(count, MAX_VERTICES, "vertices")  # primitives and nodes may share what they are made of
            _require_count(built, MAX_TRIANGLES, "triangles")
            material = _index(primitive["material"]) + 1 if "material" in primitive else 0
            if material >= len(paints):
                raise ValueError("a material that is not there")
            points, triangles, colors, uv = _glb_part(scene, binary, primitive, world)
            colored = colored or material > 0 or "COLOR_0" in primitive["attributes"]
            parts.append((points, triangles + (count - len(points)), colors, uv, np.full(len(triangles), material)))
            _require_count(len(parts), _MAX_NODES, "parts")
    if not parts:
        raise ValueError("no triangles")
    points, faces, colors, uv, which = (np.concatenate(p) for p in zip(*parts, strict=True))
    points = points @ AXES["y_up"]
    if not colored or not len(faces):
        return TriangleMesh(points, faces)
    mesh = _painted(points, faces, paints, which, uv)
    if mesh.texture is not None or mesh.colors is None:
        return mesh
    # colours of vertices are a factor of the material's, in linear light
    plain = np.array([_linear(p.color) for p in paints])
    factor = vertex_colors(len(points), faces, np.repeat(plain[which][:, None], 3, axis=1))
    return TriangleMesh(points, faces, srgb_from_linear(np.clip(colors * factor, 0, 1)).astype(np.float32))


def _count_of(scene: dict[str, Any], primitive: dict[str, Any], name: str) -> int:
    """Values of an attribute, as its accessor says."""
    return _index(scene["accessors"][_index(primitive["attributes"][name])]["count"])


def _triangles_of(scene: dict[str, Any], primitive: dict[str, Any]) -> int:
    """Triangles of a primitive, as its accessors say."""
    if "indices" not in primitive:
        return _count_of(scene, primitive, "POSITION") // 3
    return _index(scene["accessors"][_index(primitive["indices"])]["count"]) // 3


def _linear(color: tuple[float, float, float]) -> np.ndarray:
    from fluidlift.numerics.srgb import linear_from_srgb

    return linear_from_srgb(np.array(color, np.float64))


def _glb_part(
    scene: dict[str, Any], binary: bytes, primitive: dict[str, Any], world: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places in the scene, triangles, linear colours of vertices, and texture coordinates of corners."""
    attributes = primitive["attributes"]
    points = _accessor(scene, binary, attributes["POSITION"], "VEC3")
    if points.dtype.kind != "f":
        raise ValueError("positions that are not floating-point numbers")
    points = points.astype(np.float64) @ world[:3, :3].T + world[:3, 3]
    if "indices" in primitive:
        corner = _accessor(scene, binary, primitive["indices"], "SCALAR").astype(np.int64).ravel()
    else:
        corner = np.arange(len(points))
    if len(corner) and corner.max() >= len(points):
        raise ValueError("faces that name missing vertices")
    triangles = corner[: len(corner) // 3 * 3].reshape(-1, 3)
    if np.linalg.det(world[:3, :3]) < 0:  # a mirror turns the surface inside out
        triangles = triangles[:, ::-1]
    colors, uv = np.ones((len(points), 3)), np.zeros((len(points), 2))
    if "COLOR_0" in attributes:
        colors = _shares(scene, binary, attributes["COLOR_0"], ("VEC3", "VEC4"))[:, :3]
    if "TEXCOORD_0" in attributes:
        uv = _shares(scene, binary, attributes["TEXCOORD_0"], ("VEC2",))
    if len(colors) != len(points) or len(uv) != len(points):
        raise ValueError("colours or texture coordinates of another number than its vertices")
    return points, triangles, colors, uv[triangles]


def _shares(scene: dict[str, Any], binary: bytes, number: Any, kinds: tuple[str, ...]) -> np.ndarray:
    """Numbers of an accessor as float64; of whole ones, shares of their largest."""
    kind = scene["accessors"][_index(number)]["type"]
    if kind not in kinds:
        raise ValueError(f"an accessor of the type {str(kind)[:20]}")
    values = _accessor(scene, binary, number, kind)
    return values / np.iinfo(values.dtype).max if values.dtype.kind == "u" else values.astype(np.float64)


def _glb_paints(scene: dict[str, Any], binary: bytes) -> list[Paint]:
    """The one of primitives without a material (white), then the materials."""
    paints = [Paint((1.0, 1.0, 1.0))]
    materials = scene.get("materials", [])
    _require_count(len(materials), MAX_PLAIN, "materials")
    for material in materials:
        told = material.get("pbrMetallicRoughness", {})
        factor = np.clip(np.array(told.get("baseColorFactor", [1, 1, 1, 1]), np.float64)[:3], 0, 1)
        r, g, b = srgb_from_linear(factor).tolist()
        source = None
        if "baseColorTexture" in told:
            number = scene["textures"][_index(told["baseColorTexture"]["index"])].get("source")
            source = None if number is None else _glb_picture(scene, binary, _index(number))
        paints.append(Paint((r, g, b), source, (r, g, b)))
    return paints


def _glb_picture(scene: dict[str, Any], binary: bytes, number: int) -> memoryview:
    image = scene["images"][number]
    if "bufferView" not in image:
        raise ValueError("a texture in another file")
    kind = image.get("mimeType", "")
    if kind not in ("image/png", "image/jpeg"):
        raise ValueError(f"a texture of the kind '{str(kind)[:40]}'; PNG and JPEG are known")
    view = scene["bufferViews"][_index(image["bufferView"])]
    start = _index(view.get("byteOffset", 0))
    return memoryview(binary)[start : start + _index(view["byteLength"])]


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
            if size > _MAX_SCENE:
                raise ValueError(f"a scene of {size} bytes; at most {_MAX_SCENE} are read")
            scene = parse_json(chunk)
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
    view = scene["bufferViews"][_index(accessor["bufferView"])]
    if _index(view.get("buffer", 0)) != 0 or "uri" in scene["buffers"][0]:
        raise ValueError("data in another file")
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[kind]
    count, item = _index(accessor["count"]), dtype.itemsize * width
    stride = _index(view.get("byteStride", item)) or item
    offset = _index(view.get("byteOffset", 0)) + _index(accessor.get("byteOffset", 0))
    end = min(_index(view.get("byteOffset", 0)) + _index(view["byteLength"]), len(binary))
    if count == 0:
        return np.zeros((0, width), dtype)
    if stride < item or offset + (count - 1) * stride + item > end:
        raise ValueError("an accessor that reaches beyond its data")
    return np.ndarray((count, width), dtype, binary, offset, (stride, dtype.itemsize)).copy()
