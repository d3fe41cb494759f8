"""Binary PLY files as fluidlift writes them, read with NumPy: thousands of vertices in milliseconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "ushort": "<u2",
    "int": "<i4", "int32": "<i4", "uint": "<u4", "float": "<f4", "float32": "<f4", "double": "<f8",
}  # fmt: skip
_HEADER = 65536
"""bytes within which a header ends"""


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices as a structured array, and triangles [f,3] (none: [0,3]).

    Raises:
        ValueError: no binary little-endian PLY, a list other than triangles, or a file that ends too early.
    """
    data = Path(path).read_bytes()
    end = data.find(b"end_header\n", 0, _HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise ValueError(f"{path}: no PLY file")
    at = end + len(b"end_header\n")
    vertices, faces = np.zeros(0), np.zeros((0, 3), np.int64)
    for name, count, columns in _elements(data[:end].decode("ascii", "replace"), path):
        kind = np.dtype(columns)
        if at + count * kind.itemsize > len(data):
            raise ValueError(f"{path}: ends before its {count} entries of '{name}'")
        table = np.frombuffer(data, kind, count, at)
        at += count * kind.itemsize
        if name == "vertex":
            vertices = table
        elif name == "face":
            if count and (table["corners"] != 3).any():
                raise ValueError(f"{path}: faces that are no triangles")
            faces = table["index"].astype(np.int64).reshape(-1, 3)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):  # Blender would read beyond its memory
        raise ValueError(f"{path}: faces of vertices that it does not have")
    return vertices, faces


def _elements(header: str, path: Path) -> list[tuple[str, int, list[tuple]]]:
    found: list[tuple[str, int, list[tuple]]] = []
    for words in (line.split() for line in header.splitlines()[1:]):
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and words[1] != "binary_little_endian":
            raise ValueError(f"{path}: {words[1]}, needed is a binary little-endian PLY")
        if words[0] == "element":
            found.append((words[1], int(words[2]), []))
        elif words[0] == "property" and words[1] == "list":
            found[-1][2].extend([("corners", _TYPES[words[2]]), ("index", _TYPES[words[3]], (3,))])
        elif words[0] == "property":
            found[-1][2].append((words[2], _TYPES[words[1]]))
    return found


def columns(table: np.ndarray, *names: str) -> np.ndarray | None:
    """float32 [n,k] of some columns; None where one is missing."""
    if table.dtype.names is None or any(n not in table.dtype.names for n in names):
        return None
    return np.stack([table[n] for n in names], axis=1).astype(np.float32)


def whole_numbers(table: np.ndarray, name: str) -> np.ndarray | None:
    """int32 [n] of a column, held at the ends of that range; None where it is missing."""
    if table.dtype.names is None or name not in table.dtype.names:
        return None
    ends, exact = np.iinfo(np.int32), np.nan_to_num(table[name].astype(np.float64))
    return np.clip(exact, ends.min, ends.max).astype(np.int32)
