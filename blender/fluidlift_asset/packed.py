"""Packed frames of splats as fluidlift writes them (.flsp), read with NumPy: docs/asset_format.md has the layout."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

SUFFIX = ".flsp"
VERSION = 1
MOST = 5_000_000
"""splats of a file, times harmonics of each"""
_HEAD = struct.Struct("<4sBBHI")
_RECORD = struct.Struct("<di4I")
_RATIO = 1032
"""bytes that deflate makes of one at most"""
_HARMONIC = 0.28209479177387814
COLUMNS = (
    ("position", 3, True), ("velocity", 3, True), ("scale", 3, False), ("color", 3, False), ("turn", 3, False),
    ("largest", 1, False), ("opacity", 1, False), ("id", 1, True),
)  # fmt: skip
"""name, codes of a splat, whether they are differences; what follows (harmonics above degree 0) is not shown here"""


def read_packed(path: Path) -> np.ndarray:
    """What a PLY of the same frame holds: a structured array with x y z, vx vy vz, f_dc_*, scale_* (logarithms),
    opacity (logits) and id.

    Raises:
        ValueError: another format or version, damaged, or cut off.
    """
    data = Path(path).read_bytes()
    at = _HEAD.size + (len(COLUMNS) + 1) * _RECORD.size
    if len(data) < at or not data.startswith(b"FLSP"):
        raise ValueError(f"{path}: no packed frame")
    _, version, degree, _, count = _HEAD.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"{path}: packed frame of version {version}, needed is {VERSION}: take a newer extension")
    if degree > 3 or count * (degree + 1) ** 2 > MOST:
        raise ValueError(f"{path}: says {count} splats of degree {degree}")
    found = {}
    for k, (name, width, differences) in enumerate(COLUMNS):
        step, lowest, *sizes = _RECORD.unpack_from(data, _HEAD.size + k * _RECORD.size)
        codes = np.zeros((width, count, 4), np.uint8)
        for place, size in enumerate(sizes):
            if size:
                codes[..., place] = _plane(path, data[at : at + size], width * count).reshape(width, count)
            at += size
        found[name] = (_whole(codes, differences) + np.uint32(lowest & 0xFFFFFFFF)).view(np.int32), step
    return _table(found, count)


def _plane(path: Path, data: bytes, size: int) -> np.ndarray:
    """One byte of all codes of a column: as it is, or a zlib stream, of which no more is unpacked than `size` bytes."""
    if len(data) != size:
        if size > _RATIO * len(data):
            raise ValueError(f"{path}: is damaged")
        try:
            data = zlib.decompressobj().decompress(data, size)
        except zlib.error as error:
            raise ValueError(f"{path}: is damaged ({error})") from None
    if len(data) != size:
        raise ValueError(f"{path}: ends too early")
    return np.frombuffer(data, np.uint8)


def _whole(planes: np.ndarray, differences: bool) -> np.ndarray:
    """uint32 codes [k,n] of their bytes [k,n,4]."""
    codes = planes.view("<u4")[..., 0].astype(np.uint32)
    if not differences:
        return codes
    change = (codes >> np.uint32(1)) ^ (np.uint32(0) - (codes & np.uint32(1)))
    return np.cumsum(change, axis=1, dtype=np.uint32)


def _table(found: dict[str, tuple[np.ndarray, float]], count: int) -> np.ndarray:
    names = {"position": "x y z", "velocity": "vx vy vz", "scale": "scale_0 scale_1 scale_2",
             "color": "f_dc_0 f_dc_1 f_dc_2"}  # fmt: skip
    kinds = [(name, "<f4") for words in names.values() for name in words.split()]
    table = np.zeros(count, np.dtype([*kinds, ("opacity", "<f4"), ("id", "<i4")]))
    for column, words in names.items():
        codes, step = found[column]
        for name, values in zip(words.split(), codes * step):
            table[name] = (values - 0.5) / _HARMONIC if column == "color" else values
    opacity = found["opacity"][0][0].astype(np.uint16).view(np.float16).astype(np.float64)
    opacity = np.clip(np.nan_to_num(opacity), 1e-6, 1 - 1e-6)
    table["opacity"] = np.log(opacity / (1 - opacity))
    table["id"] = found["id"][0][0]
    return table
