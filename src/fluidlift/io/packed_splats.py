"""Frames of a simulation, packed: a sixth of the size of a PLY, with a bound on what is lost of each number.

Layout of a `.flsp` file, little-endian, version 1. A head of 12 bytes (`_HEAD`: magic `FLSP`, version, degree of the
harmonics, two bytes 0, number of splats n), a record of 28 bytes (`_RECORD`: step, lowest code, bytes of four planes)
for each column, then the planes, column by column in the order of `COLUMNS`. A column is an array of whole codes [k, n]
above its lowest one, some as differences: minus the code of the splat before, modulo 2^32, zigzag-coded. A plane holds
one byte of all its codes, the lowest byte first: as it is where it takes k n bytes, else as a zlib stream; one of zeros
takes none. What neighbours have in common is in the higher planes.

| column | k | a code stands for | lost at most |
|---|---|---|---|
| position | 3, differences | step: a power of two (m), at most 1/50 of the splats' median smallest axis | half a step |
| velocity | 3, differences | step: a power of two (m/s), at most 1/500 of the root of the mean square | half a step |
| scale | 3 | logarithm in steps of 1/1024 | 0.05 % |
| color | 3 | rgb = 0.5 + 0.28209 sh[0] in steps of 1/255 | 1/510 |
| turn | 3 | components w x y z after the largest (made positive), cyclically, in steps of sqrt(1/2)/511 | 0.0007 |
| largest | 1 | which component that is; its size follows from the others | 0.0021 |
| opacity | 1 | bits of a half-precision number | 1/2048 of itself, or 3e-8 |
| id | 1, differences | itself | nothing |
| harmonic | 3 for each above degree 0 | sh in steps of 1/128, all coefficients of red, of green, of blue | 1/256 |

No step of a position or velocity is finer than single precision is at the largest of them.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import InputRejected, require
from fluidlift.io.atomic import atomic_write
from fluidlift.io.frames import FluidFrame
from fluidlift.io.limits import require_file
from fluidlift.machine import cores
from fluidlift.types import Gaussians
from fluidlift.types.gaussians import SH_C0

SUFFIX = ".flsp"
"""of a packed frame"""
VERSION = 1
MAX_PACKED = 5_000_000
"""splats of a file, times harmonics of each: reading them takes 1.1 GB of memory, and the file may be very small"""

POSITION_SHARE = 1 / 50
"""of the median smallest axis, in a step: what is lost is at most a hundredth of it"""
VELOCITY_SHARE = 1 / 500
"""of the root of the mean square, in a step: what is lost is at most a thousandth of it"""
SCALE_STEP = 1 / 1024
"""of the logarithm of a scale: skins and white water are told from other splats by theirs, to a thousandth"""
COLOR_STEP = 1 / 255
"""of r, g, b: what screens show"""
TURN_STEP = math.sqrt(0.5) / 511
"""of a quaternion's components; none but the largest exceeds sqrt(1/2): 10 bits hold them"""
HARMONIC_STEP = 1 / 128
"""of the harmonics above degree 0, as SPZ has it"""

_MAGIC = b"FLSP"
_HEAD = struct.Struct("<4sBBHI")
_RECORD = struct.Struct("<di4I")
_SINGLE = 2.0**-26
"""of the largest number, in a step at least: single precision has 24 bits"""
_SMALLEST_STEP = 2.0**-100
_LARGEST_LOG = 60.0
"""of a scale: e^60 is finite in single precision, and no splat"""
_SMALLEST_SCALE = 1e-20
"""m; those below are kept as this, as in a PLY"""
_FARTHEST = 1e30
"""m and m/s: nothing is farther or faster, and its code still is a finite number"""
_LARGEST_HARMONIC = 1e6
"""of a colour that can be packed; real ones are below 10"""
_RATIO = 1032
"""bytes that deflate makes of one at most"""
_NOISE = 7.6
"""bits of entropy per byte, from which on a plane is kept as it is: packing would save 5 % at most"""
_LOOKED_AT = 16
"""of so many bytes one is counted for that"""


class _Column(NamedTuple):
    """One quantity of the splats, as it is packed."""

    name: str
    width: int
    """codes of a splat; 0: three for each harmonic above degree 0"""
    differences: bool = False


COLUMNS = (
    _Column("position", 3, True), _Column("velocity", 3, True), _Column("scale", 3), _Column("color", 3),
    _Column("turn", 3), _Column("largest", 1), _Column("opacity", 1), _Column("id", 1, True), _Column("harmonic", 0),
)  # fmt: skip
"""in the order of the file"""


class _Codes(NamedTuple):
    """A column's numbers: (lowest + codes) * step."""

    codes: np.ndarray
    """uint32 [k,n]"""
    lowest: int
    step: float

    @staticmethod
    def of(values: np.ndarray, step: float) -> _Codes:
        """Values [k,n] over a step, rounded."""
        whole = values if values.dtype.kind in "iu" else np.rint(values * np.float32(1.0 / step)).astype(np.int32)
        lowest = int(whole.min()) if whole.size else 0
        return _Codes(whole.view(np.uint32) - np.uint32(lowest & 0xFFFFFFFF), lowest, step)

    def whole(self) -> np.ndarray:
        """int32 [k,n]"""
        return (self.codes + np.uint32(self.lowest & 0xFFFFFFFF)).view(np.int32)

    def values(self) -> np.ndarray:
        """float32 [k,n]"""
        # of a power of two every code is exact; products of others are rounded once
        return (self.whole() * self.step).astype(np.float32)


def packable(gaussians: Gaussians, velocities: Float[np.ndarray, "n 3"]) -> bool:
    """Whether a frame can be packed: few enough splats, and numbers that mean something."""
    g = gaussians
    if len(g) * g.sh.shape[1] > MAX_PACKED:
        return False
    if len(g) == 0:
        return True
    # what is not a number is none of these
    turned = float(np.einsum("ij,ij->i", g.quats, g.quats).min()) > 1e-6
    scaled = float(g.scales.max()) < math.exp(_LARGEST_LOG) and math.isfinite(float(g.scales.min()))
    seen = float(g.opacities.min()) >= 0.0 and float(g.opacities.max()) <= 1.0
    small = all(
        -limit < float(a.min()) and float(a.max()) < limit
        for a, limit in ((g.means, _FARTHEST), (velocities, _FARTHEST), (g.sh, _LARGEST_HARMONIC), (g.quats, 1e6))
    )
    return turned and scaled and seen and small


def write_packed(
    path: Path | str,
    gaussians: Gaussians,
    *,
    ids: Int[np.ndarray, " n"],
    velocities: Float[np.ndarray, "n 3"],
) -> Path:
    """Write one frame.

    Args:
        path: of the file.
        gaussians: world, m.
        ids: of 32 bits.
        velocities: m/s.

    Raises:
        ValueError: a frame that is not `packable`.
        InputRejected: the disk does not take it.
    """
    require(packable(gaussians, velocities), "a frame of too many splats or with numbers that mean nothing",
            f"finite numbers of at most {MAX_PACKED} splats")  # fmt: skip
    wanted = _to_pack(gaussians, np.asarray(ids), np.asarray(velocities))
    with _threads() as pool:
        kept = list(pool.map(lambda column: _kept(column, wanted[column.name]()), COLUMNS))
    degree = math.isqrt(gaussians.sh.shape[1]) - 1
    head = _HEAD.pack(_MAGIC, VERSION, degree, 0, len(gaussians))
    with atomic_write(path) as file:
        file.write(b"".join([head, *(record for record, _ in kept), *(p for _, planes in kept for p in planes)]))
    return Path(path)


def read_packed(path: Path | str) -> FluidFrame:
    """Read one frame: Gaussians in world axes (m), ids int32 [n], velocities float32 [n,3] (m/s).

    Raises:
        InputRejected: no such file, another format or version, damaged, cut off, more splats than `MAX_PACKED`, or
            numbers that mean nothing.
    """
    path = require_file(path, "packed frame")
    with path.open("rb") as file:
        count, degree, records = _read_head(path, file)
        kept = [[file.read(size) for size in sizes] for _, _, *sizes in records]
    with _threads() as pool:
        shapes = [(_width(column, degree), count) for column in COLUMNS]
        codes = pool.map(lambda column, planes, shape: _codes(path, column, planes, shape), COLUMNS, kept, shapes)
        found = {c.name: _Codes(codes, t[1], t[0]) for c, t, codes in zip(COLUMNS, records, codes)}
    with np.errstate(over="ignore", invalid="ignore"):
        frame = _unpacked(found)
    # most turns beyond the four components would go unseen, and a width of nothing is no splat
    known = 0 <= found["largest"].whole().min(initial=0) and found["largest"].whole().max(initial=0) <= 3
    if not (known and packable(frame.gaussians, frame.velocities) and frame.gaussians.scales.min(initial=1.0) > 0.0):
        raise _damaged(path, "numbers that no splat has")
    return frame


def _read_head(path: Path, file: IO[bytes]) -> tuple[int, int, list[tuple[Any, ...]]]:
    """Number of splats, degree, and the records of the columns, which fit the file's size and each other."""
    size = os.fstat(file.fileno()).st_size
    head, records = file.read(_HEAD.size), file.read(len(COLUMNS) * _RECORD.size)
    if not head.startswith(_MAGIC):
        raise InputRejected(
            f"'{path.name}' does not begin as a packed frame does", "a frame as the simulation writes it"
        )
    if len(head) + len(records) < _HEAD.size + len(COLUMNS) * _RECORD.size:
        raise _damaged(path, "it breaks off")
    _, version, degree, _, count = _HEAD.unpack(head)
    if version != VERSION:
        raise InputRejected(f"'{path.name}' is a packed frame of version {version}", f"version {VERSION}",
                            "read it with the version of fluidlift that wrote it, or a newer one")  # fmt: skip
    if degree > 3 or count * (degree + 1) ** 2 > MAX_PACKED:
        raise InputRejected(f"'{path.name}' says {count} splats of degree {degree}",
                            f"at most {MAX_PACKED}, of degree 0 to 3")  # fmt: skip
    told = list(_RECORD.iter_unpack(records))
    if len(head) + len(records) + sum(sum(t[2:]) for t in told) != size:
        raise _damaged(path, "its size is not what it says")
    for column, (step, _, *sizes) in zip(COLUMNS, told):
        plane = _width(column, degree) * count
        if not (_SMALLEST_STEP <= step < _FARTHEST and all(s <= plane <= _RATIO * s for s in sizes if s)):
            raise _damaged(path, f"its column '{column.name}' cannot be what it says")
    return count, degree, told


def _threads() -> ThreadPoolExecutor:
    """For the columns, each of which is packed and unpacked by itself: zlib takes most of the time, and lets others
    work meanwhile."""
    return ThreadPoolExecutor(min(cores(), 4), "packed frame")


def _kept(column: _Column, told: _Codes) -> tuple[bytes, list[bytes]]:
    """The record and the four planes of a column, as they are kept."""
    planes = [_deflated(plane) for plane in _planes(_zigzag(told.codes) if column.differences else told.codes)]
    return _RECORD.pack(told.step, told.lowest, *map(len, planes)), planes


def _codes(path: Path, column: _Column, kept: list[bytes], shape: tuple[int, int]) -> np.ndarray:
    """uint32 [k,n] of a column's planes."""
    spread = np.zeros((*shape, 4), np.uint8)
    for place, data in enumerate(kept):
        if data:
            plane = data if len(data) == math.prod(shape) else _inflated(path, data, math.prod(shape))
            spread[..., place] = np.frombuffer(plane, np.uint8).reshape(shape)
    codes = spread.view("<u4")[..., 0].astype(np.uint32, copy=False)
    return _unzigzag(codes) if column.differences else codes


def _inflated(path: Path, packed: bytes, size: int) -> bytes:
    """What a stream holds, where that is `size` bytes; no more is unpacked than these."""
    inflate = zlib.decompressobj()
    try:
        data = inflate.decompress(packed, size)
        rest = inflate.decompress(inflate.unconsumed_tail, 1)
    except zlib.error as error:
        raise _damaged(path, str(error)) from None
    if len(data) != size or rest or not inflate.eof or inflate.unused_data:
        raise _damaged(path, "a column is not as long as it says")
    return data


def _to_pack(g: Gaussians, ids: np.ndarray, velocities: np.ndarray) -> dict[str, Callable[[], _Codes]]:
    """How the codes of each column are made."""

    def position() -> _Codes:
        smallest = float(np.median(_columns(g.scales).min(axis=0))) if len(g) else 1.0
        return _Codes.of(_columns(g.means), _step(POSITION_SHARE * smallest, g.means))

    def velocity() -> _Codes:
        speeds = _columns(velocities)
        fastest = float(np.abs(speeds).max(initial=0.0)) or 1.0  # squares of small numbers are 0 in single precision
        speed = fastest * float(np.sqrt(np.mean(np.square(speeds / fastest)) * 3)) if len(g) else 1.0
        return _Codes.of(speeds, _step(VELOCITY_SHARE * speed, speeds))

    def rest() -> np.ndarray:
        higher = g.sh.shape[1] - 1
        return np.ascontiguousarray(g.sh[:, 1:].transpose(2, 1, 0)).reshape(3 * higher, len(g))

    return {
        "position": position,
        "velocity": velocity,
        "scale": lambda: _Codes.of(np.log(np.maximum(_columns(g.scales), np.float32(_SMALLEST_SCALE))), SCALE_STEP),
        "color": lambda: _Codes.of(np.float32(0.5) + np.float32(SH_C0) * _columns(g.sh[:, 0]), COLOR_STEP),
        "turn": lambda: _Codes.of(_left_turns(_columns(g.quats)), TURN_STEP),
        "largest": lambda: _Codes.of(_largest(_columns(g.quats))[None], 1.0),
        "opacity": lambda: _Codes.of(g.opacities.astype(np.float16).view(np.uint16).astype(np.int32)[None], 1.0),
        "id": lambda: _Codes.of(ids.astype(np.int32)[None], 1.0),
        "harmonic": lambda: _Codes.of(rest(), HARMONIC_STEP),
    }


def _largest(quats: np.ndarray) -> np.ndarray:
    """Which component of quaternions [4,n] is the largest by size, int32 [n]."""
    size = np.abs(quats)
    low, high = size[1] > size[0], size[3] > size[2]
    later = np.maximum(size[2], size[3]) > np.maximum(size[0], size[1])
    return np.where(later, 2 + high, low).astype(np.int32)


def _left_turns(quats: np.ndarray) -> np.ndarray:
    """Of quaternions float32 [4,n], made unit ones with the largest component positive, the three [3,n] after it."""
    rows, flat, n = np.arange(quats.shape[1]), quats.ravel(), quats.shape[1]
    largest = _largest(quats)
    sign = np.copysign(1.0 / np.sqrt(np.einsum("in,in->n", quats, quats)), flat[largest * n + rows])
    return np.stack([flat[(largest + i & 3) * n + rows] for i in (1, 2, 3)]) * sign


def _columns(table: np.ndarray) -> np.ndarray:
    """float32 [k,n] of [n,k]."""
    return np.ascontiguousarray(table.T, np.float32)


def _unpacked(found: dict[str, _Codes]) -> FluidFrame:
    """What the columns say; `read_packed` judges it."""
    n = found["id"].codes.shape[1]
    turn, largest, rows = found["turn"].values(), (found["largest"].whole()[0] & 3).astype(np.int64), np.arange(n)
    q = np.empty(4 * n, np.float32)
    q[largest * n + rows] = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("in,in->n", turn, turn)))
    for i in (1, 2, 3):
        q[(largest + i & 3) * n + rows] = turn[i - 1]
    q = q.reshape(4, n)
    q /= np.sqrt(np.einsum("in,in->n", q, q))
    rest = found["harmonic"].values()
    sh = np.empty((n, 1 + len(rest) // 3, 3), np.float32)
    sh[:, 0] = ((found["color"].values() - np.float32(0.5)) / np.float32(SH_C0)).T
    sh[:, 1:] = rest.reshape(3, len(rest) // 3, n).transpose(2, 1, 0)
    opacities = found["opacity"].whole()[0].astype(np.uint16).view(np.float16).astype(np.float32)
    gaussians = Gaussians(found["position"].values().T, q.T, np.exp(found["scale"].values()).T, opacities, sh)
    return FluidFrame(gaussians, found["id"].whole()[0], np.ascontiguousarray(found["velocity"].values().T))


def _step(wanted: float, values: np.ndarray) -> float:
    """The largest power of two that is not above what is wanted; or as fine as single precision is."""
    least = max(_SINGLE * float(np.abs(values).max(initial=0.0)), _SMALLEST_STEP)
    return 2.0 ** math.floor(math.log2(max(wanted, least)))


def _zigzag(codes: np.ndarray) -> np.ndarray:
    """Differences along the splats, modulo 2^32, small ones of either sign as small numbers: 0, -1, 1, -2, ..."""
    change = np.diff(codes, axis=1, prepend=np.uint32(0)).view(np.int32)
    return ((change << 1) ^ (change >> 31)).view(np.uint32)


def _unzigzag(codes: np.ndarray) -> np.ndarray:
    change = (codes >> np.uint32(1)) ^ (np.uint32(0) - (codes & np.uint32(1)))
    return np.cumsum(change, axis=1, dtype=np.uint32)


def _planes(codes: np.ndarray) -> list[np.ndarray]:
    """Four uint8 [k,n]: the bytes of the codes, the lowest first."""
    spread = np.ascontiguousarray(codes, "<u4").view(np.uint8).reshape(*codes.shape, 4)
    return [np.ascontiguousarray(spread[..., i]) for i in range(4)]


def _deflated(plane: np.ndarray) -> bytes:
    """A plane as it is kept: nothing for zeros, as it is where that is no longer."""
    if not plane.any():
        return b""
    counts = np.bincount(plane.ravel()[::_LOOKED_AT], minlength=256)
    share = counts[counts > 0] / counts.sum()
    if -(share * np.log2(share)).sum() > _NOISE:
        return plane.tobytes()
    # runs and frequent bytes are all there is to find: longer repetitions take twice the time, and find no more
    packer = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_RLE)
    packed = packer.compress(plane.tobytes()) + packer.flush()
    return packed if len(packed) < plane.size else plane.tobytes()


def _width(column: _Column, degree: int) -> int:
    """Codes of a splat in a column."""
    return column.width or 3 * ((degree + 1) ** 2 - 1)


def _damaged(path: Path, why: str) -> InputRejected:
    return InputRejected(
        f"'{path.name}' cannot be read ({why})", "an undamaged frame", "copy it again, or simulate again"
    )
