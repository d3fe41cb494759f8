"""Binary PLY as named records, before anybody says what they mean: the header, and the numbers part by part."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.io.atomic import atomic_write

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
MAX_BYTES = 8 * 2**30
"""of one element's numbers: 30 million splats with harmonics of degree 3"""


@dataclass(frozen=True)
class Element:
    """One element of a PLY file: where its records lie, and what they are made of."""

    path: Path
    name: str
    count: int
    dtype: np.dtype
    """of one record, in the byte order of the file"""
    offset: int
    """bytes from the beginning of the file"""

    def parts(self, size: int) -> Iterator[tuple[slice, np.ndarray]]:
        """Where each part of at most `size` records stands, and its records in the machine's byte order."""
        with self.path.open("rb") as file:
            file.seek(self.offset)
            for start in range(0, self.count, size):
                wanted = min(size, self.count - start)
                records = np.fromfile(file, self.dtype, wanted)
                if len(records) != wanted:
                    raise InputRejected(f"'{self.path.name}' ended while it was read", "a file that is not written to")
                yield slice(start, start + wanted), records.astype(self.dtype.newbyteorder("="), copy=False)

    def records(self) -> np.ndarray:
        """All of them. Lists are of three items (triangles).

        Raises:
            InputRejected: a list of another length.
        """
        out = np.empty(self.count, self.dtype.newbyteorder("="))
        for where, part in self.parts(2**20):
            out[where] = part
        lists = [f for f in out.dtype.names or () if f.startswith("count of ")]
        if any((out[f] != 3).any() for f in lists):
            raise InputRejected(
                f"'{self.path.name}' has elements '{self.name}' that are not triangles", "triangles only"
            )
        return out


def open_ply(path: Path) -> tuple[dict[str, Element], list[str]]:
    """Elements by name and comments; nothing is allocated before the header is checked against the file's size.

    Raises:
        InputRejected: not a binary PLY, a header that cannot be understood, or one that promises more than the file
            holds or than is read.
    """
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER)
        size = os.fstat(file.fileno()).st_size
    end = head.find(b"\nend_header")
    if not head.startswith(b"ply") or end < 0 or (newline := head.find(b"\n", end + 1)) < 0:
        raise InputRejected(f"'{path.name}' is not a PLY file", "a binary PLY", "check the file")
    layout, comments = _parse(path, head[:end].decode("ascii", "replace").splitlines())
    needed, elements, offset = 0, {}, newline + 1
    for name, count, dtype in layout:
        elements[name] = Element(path, name, count, dtype, offset + needed)
        needed += count * dtype.itemsize
    if needed > size - offset:
        raise InputRejected(
            f"'{path.name}' promises {needed} bytes of data and has {size - offset}", "a whole file", "copy it again"
        )
    largest = max((e.count * e.dtype.itemsize for e in elements.values()), default=0)
    if largest > MAX_BYTES:
        raise InputRejected(
            f"'{path.name}' holds {largest / 2**30:.1f} GiB in one element", f"at most {MAX_BYTES / 2**30:.0f} GiB",
            "thin it, or store harmonics of a lower degree",
        )  # fmt: skip
    return elements, comments


def read_elements(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """All records of all elements, and the comments; raises as `open_ply` and `Element.records`."""
    elements, comments = open_ply(path)
    return {name: element.records() for name, element in elements.items()}, comments


def named_records(columns: Mapping[str, np.ndarray], n: int) -> np.ndarray:
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


def write_elements(path: Path | str, elements: Sequence[tuple[str, np.ndarray]], comments: Sequence[str]) -> None:
    """Write elements (name, records); those named "face" are triangles."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += ["comment " + " ".join(comment.split()) for comment in comments]
    for name, records in elements:
        lines.append(f"element {name} {len(records)}")
        if name == "face":
            lines.append("property list uchar int vertex_indices")
        else:
            lines += [f"property {_NAMES[records.dtype[p].str[1:]]} {p}" for p in records.dtype.names or ()]
    with atomic_write(path) as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace"))
        for _, records in elements:
            file.write(records.tobytes())


def _layout(lines: Sequence[str]) -> tuple[list[tuple[str, int, list]], list[str]]:
    """(name, count, fields) of each element of a header, and comments.

    Raises:
        KeyError, IndexError, ValueError: a header that is none of PLY.
    """
    order, layout, comments = "", [], []
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
    return layout, comments


def _parse(path: Path, lines: Sequence[str]) -> tuple[list[tuple[str, int, np.dtype]], list[str]]:
    """(name, count, record) of each element, and comments."""
    try:
        layout, comments = _layout(lines)
        if any(count and not fields for _, count, fields in layout):
            raise ValueError("an element without properties")
        if len({name for name, _, _ in layout}) < len(layout):
            raise ValueError("two elements of one name")
        return [(name, count, np.dtype(fields)) for name, count, fields in layout], comments
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise InputRejected(
            f"the header of '{path.name}' cannot be understood ({str(error)[:200]})",
            "a binary PLY (little or big endian)",
            "save it as binary PLY",
        ) from None
