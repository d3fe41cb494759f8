"""SPZ: one frame of Gaussians in a tenth of the size of a PLY, as viewers on the web and on phones take them.

The format is public (Niantic Labs, versions 2 and 3): one gzip stream with a header of 16 bytes, then positions,
opacities, colours, scales, rotations and harmonics, each for all splats, each in 8 bits but for positions (24-bit fixed
point) and the rotations of version 3 (the smallest three of the quaternion in 10 bits each). Axes are right, up, back:
y up, as in glTF. It holds one instant, no ids and no velocities.

What is lost is bounded: positions by half of 2^-`fractional_bits` m, logarithms of scales by 1/32, opacities by 1/510,
colours by 0.0037, quaternions (version 3) by 0.0007 per component, harmonics above degree 0 by 1/256.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.io.atomic import write_bytes
from fluidlift.io.limits import require_file, require_size
from fluidlift.io.ply import AXES, MAX_SPLATS
from fluidlift.types import Gaussians, Similarity3

VERSIONS = (2, 3)
"""3: rotations to 0.0007; 2: for viewers from before 2025, rotations to 0.004 and worse for turns near 180 degrees"""
_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
_COLOR_SCALE = 0.15
"""of the degree-0 harmonics; leaves room for colours a little outside 0 to 1"""
_FINEST = 16
"""most fractional bits of a position (0.015 mm)"""
MAX_BYTES = 2**31
"""of a file: `MAX_SPLATS` of degree 3 are less than that before they are packed. What comes out is bounded by the
number of splats that the header claims, and that by `MAX_SPLATS`"""
_COMPONENT = 511
"""largest size of a stored quaternion component, which stands for sqrt(1/2)"""


def write_spz(path: Path | str, gaussians: Gaussians, *, version: int = 3) -> Path:
    """Write Gaussians (world axes, m) as SPZ; harmonics turn with the axes.

    Raises:
        ValueError: another version, or positions beyond 8388 km.
        InputRejected: the disk does not take it.
    """
    require(version in VERSIONS, f"SPZ version {version}", "2 or 3")
    g = gaussians.transformed(Similarity3(rotation=AXES["y_up"]))
    bits = fractional_bits(g.means)
    n, degree = len(g), math.isqrt(g.sh.shape[1]) - 1
    fixed = np.round(g.means.astype(np.float64) * 2**bits).astype("<i4")
    parts = [
        _HEADER.pack(_MAGIC, version, n, degree, bits, 0, 0),
        np.ascontiguousarray(fixed.reshape(-1, 1).view(np.uint8)[:, :3]).tobytes(),
        _bytes(255.0 * g.opacities),
        _bytes(255.0 * (_COLOR_SCALE * g.sh[:, 0] + 0.5)),
        _bytes(16.0 * (np.log(np.maximum(g.scales, 1e-30)) + 10.0)),
        _first_three(g.quats) if version == 2 else _smallest_three(g.quats),
        _bytes(128.0 * g.sh[:, 1:] + 128.0),
    ]
    return write_bytes(path, gzip.compress(b"".join(parts), 6, mtime=0))


def fractional_bits(means: np.ndarray) -> int:
    """Bits behind the point with which all positions (m) still fit into 24 bits.

    Raises:
        ValueError: none do.
    """
    farthest = float(np.abs(means).max(initial=0.0))
    require(math.isfinite(farthest) and farthest < 2**23 - 1, f"positions up to {farthest:g} m", "less than 8388 km")
    return next(b for b in range(_FINEST, -1, -1) if farthest * 2**b < 2**23 - 1)


def read_spz(path: Path | str) -> Gaussians:
    """Read an SPZ file of version 2 or 3 into world axes (z up).

    Raises:
        InputRejected: no such file, not SPZ, another version, cut off, larger than `MAX_BYTES`, or more than
            `MAX_SPLATS` splats.
    """
    path = require_file(path, "SPZ file")
    require_size(path, MAX_BYTES, "SPZ file")
    data = path.read_bytes()
    version, n, degree, bits = _header(path, data)
    higher, turn = (degree + 1) ** 2 - 1, 3 if version == 2 else 4
    sizes = [9 * n, n, 3 * n, 3 * n, turn * n, 3 * higher * n]
    body = _inflated(path, data, _HEADER.size + sum(sizes))[_HEADER.size :]
    ends = np.cumsum(sizes)[:-1]
    place, opacity, color, scale, rotation, rest = np.split(np.frombuffer(body, np.uint8), ends)
    wide = np.zeros((3 * n, 4), np.uint8)
    wide[:, 1:] = place.reshape(-1, 3)  # the sign comes out of the shift back
    means = (wide.view("<i4").ravel() >> 8).reshape(n, 3) / 2.0**bits
    sh = np.empty((n, 1 + higher, 3), np.float32)
    sh[:, 0] = (color.reshape(n, 3) / 255.0 - 0.5) / _COLOR_SCALE
    sh[:, 1:] = (rest.reshape(n, higher, 3).astype(np.float32) - 128.0) / 128.0
    quats = _from_first_three(rotation) if version == 2 else _from_smallest_three(rotation)
    scales = np.exp(scale.reshape(n, 3) / 16.0 - 10.0)
    return Gaussians(means, quats, scales, opacity / 255.0, sh).transformed(Similarity3(rotation=AXES["y_up"].T))


def _header(path: Path, data: bytes) -> tuple[int, int, int, int]:
    """Version, count, degree and fractional bits."""
    head = _inflated(path, data, _HEADER.size)
    magic, version, n, degree, bits, _, _ = _HEADER.unpack(head)
    if magic != _MAGIC:
        raise InputRejected(f"'{path.name}' does not begin as an SPZ file does", "SPZ of version 2 or 3")
    if version not in VERSIONS:
        raise InputRejected(f"'{path.name}' is SPZ of version {version}", "version 2 or 3", "save it again as one")
    if n > MAX_SPLATS or degree > 3 or bits > 23:
        raise InputRejected(
            f"'{path.name}' says {n} splats of degree {degree} with {bits} fractional bits",
            f"at most {MAX_SPLATS} of degree 0 to 3, and 23 bits",
        )
    return version, n, degree, bits


def _inflated(path: Path, data: bytes, size: int) -> bytes:
    """The first `size` bytes of a gzip stream, and no more: what a file claims to hold is not trusted."""
    try:
        found = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(data, size)
    except zlib.error:
        raise InputRejected(f"'{path.name}' is not a gzip stream", "SPZ of version 2 or 3") from None
    if len(found) < size:
        raise InputRejected(f"'{path.name}' is cut off", f"{size} bytes inside", "copy or export it again")
    return found


def _bytes(values: np.ndarray) -> bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()


def _first_three(quats: np.ndarray) -> bytes:
    """x, y, z with w made positive."""
    q = np.where(quats[:, :1] < 0, -quats, quats)[:, 1:]
    return _bytes(127.5 * q + 127.5)


def _from_first_three(stored: np.ndarray) -> np.ndarray:
    xyz = stored.reshape(-1, 3) / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1, keepdims=True)))
    return _unit(np.concatenate([w, xyz], axis=1))


def _smallest_three(quats: np.ndarray) -> bytes:
    """Which of x, y, z, w is largest (2 bits), and sign and size of the other three, the first of them highest."""
    q = quats[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(q).argmax(axis=1)
    rows = np.arange(len(q))
    q *= np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    packed = largest.astype(np.uint32)
    kept = q[np.arange(4) != largest[:, None]].reshape(-1, 3)
    size = np.clip(np.round(_COMPONENT * math.sqrt(2.0) * np.abs(kept)), 0, _COMPONENT).astype(np.uint32)
    for i in range(3):
        packed = (packed << np.uint32(10)) | ((kept[:, i] < 0).astype(np.uint32) << np.uint32(9)) | size[:, i]
    return packed.astype("<u4").tobytes()


def _from_smallest_three(stored: np.ndarray) -> np.ndarray:
    packed = np.ascontiguousarray(stored).view("<u4")
    n, largest = len(packed), (packed >> np.uint32(30)).astype(int)
    parts = np.stack([(packed >> np.uint32(s)) & np.uint32(1023) for s in (20, 10, 0)], axis=1).astype(np.int64)
    kept = np.where(parts & 512, -1.0, 1.0) * (parts & _COMPONENT) / (_COMPONENT * math.sqrt(2.0))
    q = np.zeros((n, 4))
    q[np.arange(4) != largest[:, None]] = kept.ravel()
    q[np.arange(n), largest] = np.sqrt(np.maximum(0.0, 1.0 - (kept**2).sum(axis=1)))
    return _unit(q[:, [3, 0, 1, 2]])


def _unit(quats: np.ndarray) -> np.ndarray:
    return quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
