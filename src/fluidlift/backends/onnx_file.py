"""ONNX files, looked at before a runtime gets them: whole, not too large, and with all their numbers inside.

A tensor of an ONNX file may say that its numbers lie in another file, at a path of its choice. Such files are refused.
Only as much of the format (protocol buffers) is read here as that takes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fluidlift.errors import InputRejected

MOST_BYTES = 2**31 - 1
"""of a file: what protocol buffers allow"""
DEEPEST = 12
"""graphs within nodes of graphs: a conditional within a loop takes four levels each"""

# field numbers of onnx.proto (ONNX 1.x), by message: which fields hold which messages
_INSIDE = {
    "model": {7: "graph", 25: "function"},
    "function": {7: "node"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
_GRAPH = 7
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14
_VARINT, _EIGHT, _SIZED, _FOUR = 0, 1, 2, 5


def read_onnx(path: Path, purpose: str) -> bytes:
    """The bytes of an ONNX file that holds all it needs.

    Args:
        path: of the file.
        purpose: which model this is, for messages.

    Raises:
        InputRejected: no such file, a link or folder, too large, no ONNX file, cut, or with numbers in other files.
    """
    if not path.is_file():
        raise InputRejected(f"no file '{path}'", f"{purpose}: an .onnx file", "check the name")
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise InputRejected(f"'{path.name}' has {size} bytes", f"at most {MOST_BYTES} bytes of one ONNX file")
    data = path.read_bytes()
    try:
        outside = _outside(memoryview(data), "model", 0)
        graphs = sum(number == _GRAPH for number, _, _ in _fields(memoryview(data)))
    except ValueError as error:
        raise InputRejected(
            f"'{path.name}' is no whole ONNX file ({error})", f"{purpose}: an .onnx file", "copy it again"
        ) from None
    if graphs != 1:
        raise InputRejected(
            f"'{path.name}' holds {graphs} graphs", f"{purpose}: an .onnx file with one", "copy it again"
        )
    if outside:
        raise InputRejected(
            f"'{path.name}' keeps its numbers in other files", f"{purpose}: an .onnx file with all of them inside",
            "save it anew without external data",
        )  # fmt: skip
    return data


def _outside(message: memoryview, kind: str, depth: int) -> bool:
    """Whether a tensor of a message lies in another file."""
    if depth > 4 * DEEPEST:
        raise ValueError("graphs within graphs without end")
    for number, wire, value in _fields(message):
        if kind == "tensor":
            if number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value != 0):
                return True
        elif number in _INSIDE[kind]:
            if wire != _SIZED or not isinstance(value, memoryview):
                raise ValueError(f"field {number} of a {kind} is no message")
            if _outside(value, _INSIDE[kind][number], depth + 1):
                return True
    return False


def _fields(message: memoryview) -> Iterator[tuple[int, int, int | memoryview]]:
    """Number, wire type and value of each field of a message; `ValueError` where it is cut or no message."""
    at, end = 0, len(message)
    while at < end:
        key, at = _number(message, at)
        number, wire = key >> 3, key & 7
        if wire == _VARINT:
            value, at = _number(message, at)
            yield number, wire, value
            continue
        if wire == _SIZED:
            length, at = _number(message, at)
        elif wire in (_EIGHT, _FOUR):
            length = 8 if wire == _EIGHT else 4
        else:
            raise ValueError(f"unknown wire type {wire}")
        if number == 0 or length > end - at:
            raise ValueError("it ends too early")
        yield number, wire, message[at : at + length]
        at += length


def _number(message: memoryview, at: int) -> tuple[int, int]:
    """A number of variable length (7 bits a byte), and where the next thing begins."""
    value = 0
    for k in range(10):
        if at + k >= len(message):
            raise ValueError("it ends too early")
        byte = message[at + k]
        value |= (byte & 0x7F) << (7 * k)
        if byte < 0x80:
            return value, at + k + 1
    raise ValueError("a number without end")
