"""Binary glTF 2.0, part by part: arrays go in as accessors, what refers to them as plain dictionaries."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import require
from fluidlift.io.atomic import atomic_write

_KINDS = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
VERTICES, INDICES = 34962, 34963
"""what a buffer view is for"""


class Glb:
    """A glTF that grows: `document` is its JSON, to which users of this class add what refers to the arrays."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "fluidlift"}}
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, kind: str, item: dict[str, Any]) -> int:
        """One more of `nodes`, `meshes`, `materials` and so on; its index."""
        items = self.document.setdefault(kind, [])
        items.append(item)
        return len(items) - 1

    def extension(self, name: str) -> None:
        """Say that an extension is used."""
        used = self.document.setdefault("extensionsUsed", [])
        if name not in used:
            used.append(name)

    def array(self, values: np.ndarray, *, target: int = VERTICES, normalized: bool = False, bounds=False) -> int:
        """An accessor of float32, uint32, uint16 or uint8 numbers [n] or [n,2..4]; with `bounds` it says its own.

        Raises:
            ValueError: nothing in it, another kind of number, or rows that are no multiple of four bytes.
        """
        values = np.ascontiguousarray(values)
        name, width = values.dtype.name, values.shape[1] if values.ndim == 2 else 1
        require(name in _KINDS and width in _TYPES and len(values) > 0, f"{name} {values.shape}", "numbers for glTF")
        row = values.dtype.itemsize * width
        require(target == INDICES or row % 4 == 0, f"rows of {row} bytes", "multiples of 4")
        view = self._view(values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes(), target)
        accessor: dict[str, Any] = {"bufferView": view, "componentType": _KINDS[name], "count": len(values),
                                    "type": _TYPES[width]}  # fmt: skip
        if normalized:
            accessor["normalized"] = True
        if bounds:
            low, high = values.min(axis=0), values.max(axis=0)
            accessor |= {"min": np.atleast_1d(low).tolist(), "max": np.atleast_1d(high).tolist()}
        return self.add("accessors", accessor)

    def picture(self, data: bytes, mime: str) -> int:
        """A texture of an encoded picture inside the file."""
        image = self.add("images", {"bufferView": self._view(data, None), "mimeType": mime})
        sampler = self.add("samplers", {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071})
        return self.add("textures", {"source": image, "sampler": sampler})

    def _view(self, data: bytes, target: int | None) -> int:
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        pad = -len(data) % 4
        self._parts += [data, bytes(pad)]
        self._size += len(data) + pad
        return self.add("bufferViews", view)

    def write(self, path: Path | str) -> Path:
        """Write the file; every node that no other has as a child is in its one scene.

        Raises:
            InputRejected: the disk does not take it.
        """
        nodes = range(len(self.document.get("nodes", ())))
        below = {c for n in self.document.get("nodes", ()) for c in n.get("children", ())}
        document = self.document | {"scene": 0, "scenes": [{"nodes": [n for n in nodes if n not in below]}]}
        if self._parts:
            document["buffers"] = [{"byteLength": self._size}]
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        body = 8 + self._size if self._parts else 0
        with atomic_write(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + body))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            if self._parts:
                file.write(struct.pack("<I4s", self._size, b"BIN\0"))
                file.writelines(self._parts)
        return Path(path)
