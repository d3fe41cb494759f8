"""Arrays of .npy and .npz files that may come from anyone: no pickles, and nothing is taken on a header's word alone.

Every reader of such files goes through here. What is wrong with one is a ValueError (`DAMAGE` has what the packages
below raise besides), which the readers turn into their own words.
"""

from __future__ import annotations

import math
import mmap
import struct
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.limits import require_file

DAMAGE = (
    ValueError, OSError, EOFError, KeyError, TypeError, IndexError, OverflowError, MemoryError, NotImplementedError,
    RuntimeError, SyntaxError, RecursionError, zipfile.BadZipFile, zlib.error, struct.error,
    tokenize.TokenError,
)  # fmt: skip
"""what zipfile, zlib and NumPy raise for damaged, encrypted or hostile files"""
MOST_MEMBERS = 10_000
"""of an npz"""

_MAX_ARRAYS = 2**30
"""bytes of all arrays of a part of an asset"""
IN_MEMORY = 64 * 2**20
"""bytes of an array; larger ones of an npz are unpacked into a file without a name, and mapped"""
_UNPACKED = 4
"""times the size of a file of packed arrays that they may take, if that is more than `_MAX_ARRAYS`"""
_TRIED = 2**16
"""bytes of an array that tell whether packing pays"""
_PIECE = 2**20
_HEADS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class Header(NamedTuple):
    """What stands before the numbers of an array."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype
    nbytes: int
    """of the numbers"""


def read_header(stream: IO[bytes], size: int, kinds: str = "fiub") -> Header:
    """The header of an .npy file, compared with the size of what follows.

    Args:
        stream: at the file's beginning; left at its first number.
        size: bytes of the whole file.
        kinds: of numbers that are taken, as NumPy's `dtype.kind`.

    Raises:
        ValueError: no such header, objects, or more numbers than the file has room for.
    """
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADS:
            raise ValueError(f"NumPy format {version}")
        shape, fortran, dtype = _HEADS[version](stream)
    except DAMAGE as error:
        raise ValueError(f"no header of an array ({str(error)[:100]})") from None
    if dtype.kind not in kinds or dtype.hasobject:
        raise ValueError(f"an array of {dtype}")
    if any(type(n) is not int or n < 0 for n in shape) or len(shape) > 32:
        raise ValueError(f"an array of the shape {str(shape)[:100]}")
    nbytes = math.prod(shape) * dtype.itemsize
    if nbytes > size or max(shape, default=0) > 2**62:
        raise ValueError(f"an array that promises {nbytes} bytes of {dtype} and has {size}")
    return Header(shape, fortran, dtype, nbytes)


def mapped_array(path: Path, mode: str = "r", kinds: str = "fiub") -> np.memmap:
    """An .npy file, mapped: nothing is read but its header.

    Raises:
        ValueError: as `read_header`.
    """
    with path.open("rb") as file:
        head = read_header(file, path.stat().st_size, kinds)
        offset = file.tell()
        if offset + head.nbytes > path.stat().st_size:
            raise ValueError("it breaks off")
    order = "F" if head.fortran else "C"
    return np.memmap(path, head.dtype, mode, offset, head.shape, order)  # type: ignore[call-overload]


def release_pages(array: np.ndarray) -> None:
    """Give back the memory of a mapped array that was only looked at; what is looked at again is read again."""
    mapped = array
    while isinstance(mapped, np.ndarray):
        mapped = mapped.base
    if isinstance(mapped, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        mapped.madvise(mmap.MADV_DONTNEED)


def members_of(archive: zipfile.ZipFile, max_bytes: int) -> dict[str, zipfile.ZipInfo]:
    """The arrays of an npz by their names, before anything is unpacked.

    Raises:
        InputRejected: more than `max_bytes` in all.
        ValueError: too many, encrypted, or packed in a way that NumPy does not pack.
    """
    found = archive.infolist()
    total = sum(m.file_size for m in found)
    if total > max_bytes:
        name = Path(str(archive.filename)).name
        raise InputRejected(f"'{name}' unpacks to too much ({total} bytes)", f"at most {max_bytes} bytes")
    if len(found) > MOST_MEMBERS:
        raise ValueError(f"{len(found)} arrays")
    for member in found:
        if member.flag_bits & 1 or member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"'{member.filename[:40]}' is encrypted, or packed in another way than by deflate")
        if not member.filename.endswith(".npy"):
            raise ValueError(f"'{member.filename[:40]}', which is no array")
    return {m.filename.removesuffix(".npy"): m for m in found}


def array_in(archive: zipfile.ZipFile, member: zipfile.ZipInfo, kinds: str = "fiub") -> np.ndarray:
    """One array of an npz; a large one lies in a file without a name that goes with it, and is mapped.

    Raises:
        ValueError: as `read_header`, or it breaks off; what zipfile raises for damage (`DAMAGE`).
    """
    with archive.open(member) as stream:
        head = read_header(stream, member.file_size, kinds)
        order: Any = "F" if head.fortran else "C"
        if head.nbytes > IN_MEMORY:
            with tempfile.TemporaryFile() as file:  # written, not mapped: a full disk raises, where a map would kill
                for piece in _pieces(stream, head.nbytes, member.filename):
                    file.write(piece)
                file.flush()
                return np.memmap(file, head.dtype, "c", 0, head.shape, order)
        data = bytearray(head.nbytes)
        at = 0
        for piece in _pieces(stream, head.nbytes, member.filename):
            data[at : at + len(piece)] = piece
            at += len(piece)
    return np.ndarray(head.shape, head.dtype, data, order=order)


def _pieces(stream: IO[bytes], size: int, name: str) -> Iterator[bytes]:
    """The numbers of an array, and the stream's end: only there its checksum is looked at."""
    left = size
    while left:
        piece = stream.read(min(_PIECE, left))
        if not piece:
            raise ValueError(f"'{name[:40]}' breaks off")
        left -= len(piece)
        yield piece
    while stream.read(_PIECE):
        pass


def write_packed_arrays(file: IO[bytes], arrays: Mapping[str, np.ndarray]) -> None:
    """An npz whose arrays are packed where that makes them smaller: pictures and masks, and not the noise of most
    floats. What `most_unpacked` allows is kept to.

    Args:
        file: at its beginning.
        arrays: of numbers, by their names.
    """
    total = sum(np.asarray(a).nbytes for a in arrays.values())
    for packed in (True, False):
        file.seek(0)
        file.truncate()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, compresslevel=1) as archive:
            for name, array in arrays.items():
                member = zipfile.ZipInfo(f"{name}.npy")
                member.compress_type = zipfile.ZIP_DEFLATED if packed and packs_to(array, 0.75) else zipfile.ZIP_STORED
                with archive.open(member, "w", force_zip64=True) as stream:
                    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=False)
        if total <= most_unpacked(file.tell()):
            return


def most_unpacked(size: int) -> int:
    """Bytes that the arrays of a file of `write_packed_arrays` may take in all."""
    return max(_UNPACKED * size, _MAX_ARRAYS)


def packs_to(array: np.ndarray, share: float) -> bool:
    """Whether deflate leaves less than a share of an array, tried on a part from its middle."""
    array = np.asarray(array)
    flat = array.reshape(-1) if array.flags.c_contiguous else array.ravel()
    wanted = _TRIED // max(array.itemsize, 1)
    start = max((flat.size - wanted) // 2, 0)
    part = flat[start : start + wanted].tobytes()
    return len(zlib.compress(part, 1)) < share * len(part)


def read_packed_arrays(path: Path, kinds: str = "fiub") -> dict[str, np.ndarray]:
    """What `write_packed_arrays` wrote.

    Raises:
        InputRejected: more than `most_unpacked` allows.
        ValueError: as `members_of` and `array_in`; what zipfile raises for damage (`DAMAGE`).
    """
    with zipfile.ZipFile(path) as archive:
        members = members_of(archive, most_unpacked(path.stat().st_size))
        return {name: array_in(archive, member, kinds) for name, member in members.items()}


def read_arrays(path: Path, needed: Sequence[str]) -> dict[str, np.ndarray]:
    """The arrays of an npz; pickles and oversize content are refused before anything is unpacked.

    Args:
        path: of the file.
        needed: names that must be there.

    Raises:
        InputRejected: a damaged or oversize file, one without a needed array, or numbers that are not finite.
    """
    require_file(path, "part of an asset")
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = {n: array_in(archive, m) for n, m in members_of(archive, _MAX_ARRAYS).items()}
    except DAMAGE as error:
        why = str(error)[:200]
        raise InputRejected(f"'{path.name}' cannot be read ({why})", "an undamaged asset", "make it again") from None
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise InputRejected(f"'{path.name}' lacks {', '.join(missing)}", "a whole asset", "make it again")
    bad = [n for n, a in arrays.items() if a.dtype.kind == "f" and not np.isfinite(a).all()]
    if bad:
        raise InputRejected(f"'{path.name}' holds {', '.join(bad)} with no finite numbers", "a whole asset")
    return arrays
