"""PLY: Gaussians as 3D Gaussian splatting tools exchange them, points, and meshes. Binary, written with NumPy.

The splat file is that of the first Gaussian splatting code: logarithms of the scales, logits of the opacities,
quaternions w x y z, and the harmonics above degree 0 channel by channel (all coefficients of red, of green, of blue).
Most such files have y down. Here the world's z-up axes are kept unless another frame is asked for; a comment in the
header says which. Further properties carry the stable id and the velocity of each splat.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import InputRejected, require
from fluidlift.io.atomic import atomic_write
from fluidlift.io.limits import require_file
from fluidlift.numerics import harmonics
from fluidlift.types import Gaussians, Similarity3, TriangleMesh

AXES = {
    "z_up": np.eye(3),
    "y_up": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "y_down": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
"""rotations file_from_world: the world's own axes; glTF's (y up, z back); those of splat viewers (y down, z forward)"""

_OPACITY_EDGE = 1e-6
"""opacities are kept this far from 0 and 1, where the logit is infinite"""

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_MAX_HEADER = 2**16


@dataclass(frozen=True)
class SplatFile:
    """The content of a splat PLY, in world axes."""

    gaussians: Gaussians
    extras: dict[str, np.ndarray] = field(default_factory=dict)
    """further properties by name: id int32 [n], vx, vy, vz float32 [n] in m/s, ..."""
    comments: tuple[str, ...] = ()


def write_gaussians(
    path: Path | str,
    gaussians: Gaussians,
    *,
    ids: Int[np.ndarray, "n"] | None = None,
    velocities: Float[np.ndarray, "n 3"] | None = None,
    extras: Mapping[str, np.ndarray] | None = None,
    axes: str = "z_up",
    comments: Sequence[str] = (),
) -> Path:
    """Write a splat PLY.

    Args:
        gaussians: world, m.
        ids: become the property `id`.
        velocities: m/s, become vx, vy, vz.
        extras: further properties [n] of any number kind.
        axes: "z_up" (the world as it is), "y_up" or "y_down". View-dependent harmonics turn with the frame.
        comments: lines for the header.
    """
    n = len(gaussians)
    require(axes in AXES, f"axes '{axes}'", "one of " + ", ".join(AXES))
    turned = _turned(gaussians, AXES[axes])
    columns: dict[str, np.ndarray] = dict(zip(("x", "y", "z"), turned.means.T))
    columns |= {name: np.zeros(n, np.float32) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{c}": turned.sh[:, 0, c] for c in range(3)}
    rest = turned.sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (turned.sh.shape[1] - 1))
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    opacity = np.clip(turned.opacities.astype(np.float64), _OPACITY_EDGE, 1 - _OPACITY_EDGE)
    columns["opacity"] = np.log(opacity / (1 - opacity))
    scales = np.log(np.maximum(turned.scales.astype(np.float64), 1e-20))
    columns |= {f"scale_{a}": scales[:, a] for a in range(3)}
    columns |= {f"rot_{a}": turned.quats[:, a] for a in range(4)}
    columns = {name: column.astype(np.float32) for name, column in columns.items()}
    if ids is not None:
        columns["id"] = np.asarray(ids).astype(np.int32)
    if velocities is not None:
        v = np.asarray(velocities, np.float32).reshape(n, 3) @ AXES[axes].T.astype(np.float32)
        columns |= dict(zip(("vx", "vy", "vz"), v.T))
    columns |= extras or {}
    note = f"fluidlift splats, metres, axes {axes}"
    _write(path, [("vertex", _records(columns, n))], [note, *comments])
    return Path(path)


def read_splats(path: Path | str) -> SplatFile:
    """Read a splat PLY; axes other than z-up are turned back where our own header comment names them.

    Raises:
        InputRejected: no such file, not a binary PLY, a header that promises more than the file holds, missing
            properties, or numbers that are not finite.
    """
    path = require_file(path, "PLY file")
    elements, comments = _read(path)
    if "vertex" not in elements:
        raise InputRejected(f"'{path.name}' has no vertices", "a Gaussian splat PLY")
    vertex = elements["vertex"]
    names = vertex.dtype.names or ()
    needed = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    needed += [f"scale_{a}" for a in range(3)] + [f"rot_{a}" for a in range(4)]
    missing = [name for name in needed if name not in names]
    rest = [name for name in names if name.startswith("f_rest_")]
    if missing or len(rest) not in (0, 9, 24, 45) or any(f"f_rest_{i}" not in names for i in range(len(rest))):
        raise InputRejected(
            f"'{path.name}' is not a splat file (missing {', '.join(missing) or 'harmonics'})",
            "a PLY with f_dc, opacity, scale and rot, and 0, 9, 24 or 45 of f_rest",
            "convert it to the uncompressed PLY of 3D Gaussian splatting",
        )

    def stacked(columns: Sequence[str]) -> np.ndarray:
        return np.stack([vertex[name].astype(np.float32) for name in columns], axis=-1)

    n = len(vertex)
    sh = stacked(["f_dc_0", "f_dc_1", "f_dc_2"])[:, None]
    if rest:
        higher = stacked([f"f_rest_{i}" for i in range(len(rest))]).reshape(n, 3, len(rest) // 3).transpose(0, 2, 1)
        sh = np.concatenate([sh, higher], axis=1)
    quats = stacked([f"rot_{a}" for a in range(4)])
    norm = np.linalg.norm(quats, axis=1, keepdims=True)
    logit, log_scales = vertex["opacity"].astype(np.float64), stacked([f"scale_{a}" for a in range(3)])
    means = stacked(["x", "y", "z"])
    finite = all(np.isfinite(a).all() for a in (means, sh, quats, logit, log_scales))
    if not finite or (n and (norm.min() < 1e-6 or log_scales.max() > 60)):
        raise InputRejected(f"'{path.name}' holds numbers that are not finite or no rotations", "finite splats")
    opacities = 1.0 / (1.0 + np.exp(-np.clip(logit, -60, 60)))
    gaussians = Gaussians(means, quats / np.maximum(norm, 1e-12), np.exp(log_scales), opacities, sh)
    known = {*needed, *rest, "nx", "ny", "nz"}
    extras = {name: np.ascontiguousarray(vertex[name]) for name in names if name not in known}
    axes = next((c.rsplit(" ", 1)[1] for c in comments if c.startswith("fluidlift splats") and " axes " in c), "z_up")
    world_from_file = AXES.get(axes, AXES["z_up"]).T
    if {"vx", "vy", "vz"} <= extras.keys():
        turned = np.stack([extras[v] for v in ("vx", "vy", "vz")], axis=-1) @ world_from_file.T.astype(np.float32)
        extras |= {v: np.ascontiguousarray(turned[:, i]) for i, v in enumerate(("vx", "vy", "vz"))}
    return SplatFile(_turned(gaussians, world_from_file), extras, tuple(comments))


def read_gaussians(path: Path | str) -> Gaussians:
    """The Gaussians of a splat PLY; raises as `read_splats`."""
    return read_splats(path).gaussians


def write_points(
    path: Path | str,
    points: Float[np.ndarray, "n 3"],
    *,
    colors: Float[np.ndarray, "n 3"] | None = None,
    extras: Mapping[str, np.ndarray] | None = None,
) -> Path:
    """Write a point cloud in world axes; colours are sRGB in [0, 1]."""
    columns = _vertex_columns(points, colors) | dict(extras or {})
    _write(path, [("vertex", _records(columns, len(points)))], ["metres, z up"])
    return Path(path)


def write_mesh(path: Path | str, mesh: TriangleMesh, *, velocities: Float[np.ndarray, "v 3"] | None = None) -> Path:
    """Write a triangle mesh in world axes; velocities (m/s) become vx, vy, vz of the vertices for motion blur."""
    columns = _vertex_columns(mesh.vertices, mesh.colors)
    if velocities is not None:
        columns |= dict(zip(("vx", "vy", "vz"), np.asarray(velocities, np.float32).reshape(-1, 3).T))
    faces = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))]))
    faces["count"], faces["vertex_indices"] = 3, mesh.faces
    _write(path, [("vertex", _records(columns, len(mesh.vertices))), ("face", faces)], ["metres, z up"])
    return Path(path)


def read_mesh(path: Path | str) -> TriangleMesh:
    """Read a mesh as `write_mesh` writes it (triangles, vertex_indices as int lists of 3).

    Raises:
        InputRejected: no such file, another kind of PLY, or indices that name no vertex.
    """
    path = require_file(path, "PLY file")
    elements, _ = _read(path)
    if "vertex" not in elements or "face" not in elements or "vertex_indices" not in elements["face"].dtype.names:
        raise InputRejected(f"'{path.name}' holds no mesh", "a binary PLY with vertices and triangles")
    vertex, faces = elements["vertex"], elements["face"]["vertex_indices"].astype(np.int64)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertex)):
        raise InputRejected(f"'{path.name}' has faces that name missing vertices", "a whole mesh")
    points = np.stack([vertex[a].astype(np.float32) for a in "xyz"], axis=-1)
    colors = None
    if {"red", "green", "blue"} <= set(vertex.dtype.names):
        colors = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=-1).astype(np.float32) / 255.0
    return TriangleMesh(points, faces, colors)


def _turned(gaussians: Gaussians, rotation: np.ndarray) -> Gaussians:
    if np.array_equal(rotation, np.eye(3)):
        return gaussians
    turned = gaussians.transformed(Similarity3(rotation=rotation))
    if gaussians.sh.shape[1] == 1:
        return turned
    sh = np.einsum("ij,njc->nic", harmonics_rotation(rotation, math.isqrt(gaussians.sh.shape[1]) - 1), gaussians.sh)
    return Gaussians(turned.means, turned.quats, turned.scales, turned.opacities, sh)


def harmonics_rotation(rotation: Float[np.ndarray, "3 3"], degree: int) -> Float[np.ndarray, "k k"]:
    """The matrix that turns spherical harmonic coefficients with the body: new(R d) = old(d) for every direction d.

    Found by least squares over many directions; exact, because each degree is closed under rotation.
    """
    i = np.arange(64) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / 64), np.pi * (1 + 5**0.5) * i
    old = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    new = old @ np.asarray(rotation).T
    return np.linalg.lstsq(harmonics.basis(new, degree), harmonics.basis(old, degree), rcond=None)[0]


def _vertex_columns(points: np.ndarray, colors: np.ndarray | None) -> dict[str, np.ndarray]:
    columns = dict(zip(("x", "y", "z"), np.asarray(points, np.float32).T))
    if colors is not None:
        eight = np.round(255 * np.clip(np.asarray(colors), 0, 1)).astype(np.uint8)
        columns |= dict(zip(("red", "green", "blue"), eight.T))
    return columns


def _records(columns: Mapping[str, np.ndarray], n: int) -> np.ndarray:
    """One structured array of named columns; kinds that PLY does not know become int or float."""
    kinds = {}
    for name, column in columns.items():
        column = np.asarray(column)
        require(column.shape == (n,), f"property '{name}' of shape {column.shape}", f"({n},)")
        kind = column.dtype.str[1:]
        kinds[name] = "<" + (kind if kind in _NAMES else ("f4" if column.dtype.kind == "f" else "i4"))
    records = np.empty(n, np.dtype(list(kinds.items())))
    for name, column in columns.items():
        records[name] = column
    return records


def _write(path: Path | str, elements: Sequence[tuple[str, np.ndarray]], comments: Sequence[str]) -> None:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += ["comment " + " ".join(comment.split()) for comment in comments]
    for name, records in elements:
        lines.append(f"element {name} {len(records)}")
        if name == "face":
            lines.append("property list uchar int vertex_indices")
        else:
            lines += [f"property {_NAMES[records.dtype[p].str[1:]]} {p}" for p in records.dtype.names]
    with atomic_write(path) as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace"))
        for _, records in elements:
            file.write(records.tobytes())


def _read(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Elements by name and comments; nothing is allocated before the header is checked against the file's size."""
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER)
        end = head.find(b"end_header")
        if not head.startswith(b"ply") or end < 0 or (newline := head.find(b"\n", end)) < 0:
            raise InputRejected(f"'{path.name}' is not a PLY file", "a binary PLY", "check the file")
        order, layout, comments = _parse(path, head[:end].decode("ascii", "replace").splitlines())
        left = os.fstat(file.fileno()).st_size - (newline + 1)
        needed = sum(count * dtype.itemsize for _, count, dtype in layout)
        if needed > left:
            raise InputRejected(
                f"'{path.name}' promises {needed} bytes of data and has {left}", "a whole file", "copy it again"
            )
        file.seek(newline + 1)
        elements = {name: np.fromfile(file, dtype, count) for name, count, dtype in layout}
    for name, records in elements.items():
        lists = [f for f in records.dtype.names if f.startswith("count of ")]
        if any((records[f] != 3).any() for f in lists):
            raise InputRejected(f"'{path.name}' has elements '{name}' that are not triangles", "triangles only")
    return {name: r.astype(r.dtype.newbyteorder("=")) if order == ">" else r for name, r in elements.items()}, comments


def _parse(path: Path, lines: Sequence[str]) -> tuple[str, list[tuple[str, int, np.dtype]], list[str]]:
    """Byte order, (name, count, record) of each element, comments."""
    order, layout, comments = "", [], []
    try:
        for line in lines[1:]:
            words = line.split()
            if not words or words[0] == "obj_info":
                continue
            if words[0] == "comment":
                comments.append(line[len("comment") :].strip())
            elif words[0] == "format":
                order = {"binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
            elif words[0] == "element":
                count = int(words[2])
                if count < 0:
                    raise ValueError(f"{count} elements")
                layout.append((words[1], count, []))
            elif words[:2] == ["property", "list"]:
                name = "vertex_indices" if words[4] == "vertex_index" else words[4]
                count_kind, item_kind = order + _TYPES[words[2]], order + _TYPES[words[3]]
                layout[-1][2].extend([(f"count of {name}", count_kind), (name, item_kind, (3,))])
            elif words[0] == "property":
                layout[-1][2].append((words[2], order + _TYPES[words[1]]))
            else:
                raise ValueError(f"the line '{line[:60]}'")
        if not order:
            raise ValueError("no format line")
        if any(count and not fields for _, count, fields in layout):
            raise ValueError("an element without properties")
        return order, [(name, count, np.dtype(fields)) for name, count, fields in layout], comments
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise InputRejected(
            f"the header of '{path.name}' cannot be understood ({error})",
            "a binary PLY (little or big endian)",
            "save it as binary PLY",
        ) from None
