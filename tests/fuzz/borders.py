"""Changes at the borders of a format: of chunks, of members of an archive, of numbers in a table, of nested lists.

Single bytes (`mutation`) hardly ever hit a border, and what is drawn by form (`structures`) keeps lengths sound. Here
files are cut and joined exactly where one part ends, lengths change their sign, tables hold what no measurement gives,
and an archive says of its members what is not so.
"""

from __future__ import annotations

import io
import json
import re
import struct
import warnings
import zipfile
from collections.abc import Callable
from random import Random

import numpy as np

Change = Callable[[bytes, Random], bytes | None]
"""a changed file, or None where the file is not of that format"""

_FLOATS = (np.nan, np.inf, -np.inf, -0.0, 1e-45, 3.4e38, -3.4e38, 0.0)
"""no number, no end, minus nothing, denormal, and the largest of single precision"""
_KINDS = ("<f2", ">f4", "<f8", "<c8", "|u1", "<i2", ">i8", "<u8", "|b1", "|S4", "<U3", "|V4", "<M8[s]", "<f16")
_MEMBERS = (
    "../x.npy", "/etc/passwd.npy", "a/../b.npy", "U.NPY", "\u202e.npy", "fu\u0308.npy", "", ".npy", "n" * 60000,
    "a\\b.npy", "d/", "u .npy",
)  # fmt: skip
_LEVELS = (40, 101, 450, 900, 990)
"""of nesting: more than a reader should walk, and up to what Python's own parser still takes"""


def _table(array: np.ndarray, random: Random) -> np.ndarray:
    """Some numbers, or all, as no measurement has them."""
    array = np.array(array)
    flat = array.reshape(-1)
    for _ in range(random.choice((1, 3, 50)) if flat.size else 0):
        at = random.randrange(flat.size)
        if array.dtype.kind == "f":
            flat[at] = random.choice(_FLOATS)
        elif array.dtype.kind in "iu":
            bounds = np.iinfo(array.dtype)
            flat[at] = random.choice((bounds.min, bounds.max, 0, 1))
    if random.random() < 0.2 and array.dtype.kind == "f":
        flat[:] = random.choice(_FLOATS)
    return array


def array(data: bytes, random: Random) -> bytes | None:
    """A .npy: other numbers, another type, shape or order, all in sound form."""
    if not data.startswith(b"\x93NUMPY"):
        return None
    try:
        found = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, OSError, EOFError, SyntaxError):
        return None
    changes: tuple[Callable[[np.ndarray], np.ndarray], ...] = (
        lambda a: _table(a, random), lambda a: _table(a, random), lambda a: a.astype(random.choice(_KINDS)),
        np.asfortranarray, lambda a: a.T, lambda a: a[None], lambda a: a[:0], lambda a: a.reshape(-1)[:1].reshape(()),
        lambda a: np.resize(a, [random.choice((0, 1, 2, 3, 7, 64)) for _ in range(random.randrange(6))]),
    )  # fmt: skip
    out = io.BytesIO()
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            np.lib.format.write_array(out, random.choice(changes)(found), allow_pickle=False)
        except (ValueError, TypeError, IndexError):
            return None
    return out.getvalue()


def archive(data: bytes, random: Random) -> bytes | None:
    """A zip: members exchanged, left out, two of one name, names that lead elsewhere, numbers of its directory."""
    if not data.startswith(b"PK"):
        return None
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as found:
            members = [(name, found.read(name)) for name in found.namelist()]
    except (zipfile.BadZipFile, RuntimeError, ValueError, OSError, NotImplementedError, EOFError, struct.error):
        return None
    if not members:
        return None
    at, what = random.randrange(len(members)), random.randrange(7)
    name, content = members[at]
    if what <= 1:
        members[at] = name, array(content, random) or content
    elif what == 2:
        members.append((name, array(content, random) or content))
    elif what == 3:
        members.append((random.choice(_MEMBERS), content))
    elif what == 4:
        members[at] = name.swapcase(), content
    elif what == 5:
        members[at], members[0] = (name, members[0][1]), (members[0][0], content)
    out = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of two members of one name
        with zipfile.ZipFile(out, "w") as made:
            for name, content in members:
                head = zipfile.ZipInfo(name)
                head.compress_type = random.choice((zipfile.ZIP_DEFLATED,) * 4 + (zipfile.ZIP_LZMA, zipfile.ZIP_STORED))
                with made.open(head, "w", force_zip64=random.random() < 0.3) as stream:
                    stream.write(content)
    return _directory(out.getvalue(), random) if what == 6 else out.getvalue()


def _directory(data: bytes, random: Random) -> bytes:
    """Numbers in the heads of the members and in the directory: sizes, sums, flags, offsets."""
    out = bytearray(data)
    heads = [m.start() for m in re.finditer(rb"PK(\x01\x02|\x03\x04|\x05\x06|\x06\x06|\x06\x07)", data)]
    for _ in range(random.choice((1, 1, 2))):
        at, form = random.choice(heads) + 4 + 2 * random.randrange(21), random.choice(("<H", "<I"))
        if at + struct.calcsize(form) <= len(out):
            _renumbered(out, at, form, random)
    return bytes(out)


def _renumbered(out: bytearray, at: int, form: str, random: Random) -> None:
    """A whole number with its sign flipped, off by one, or at an end of its range."""
    span = 256 ** struct.calcsize(form)
    (value,) = struct.unpack_from(form, out, at)
    others = (-value, ~value, value + 1, value - 1, 2 * value, value ^ 1, 0, 1, span // 2, span - 1)
    struct.pack_into(form, out, at, random.choice(others) % span)


def parts(data: bytes) -> list[tuple[int, int]]:
    """Where the chunks of a file begin and end; empty where it has none that are known here."""
    if data.startswith(b"\x89PNG"):
        return _chunks(data, 8, ">I", 12)
    if data.startswith(b"glTF"):
        return _chunks(data, 12, "<I", 8)
    if data.startswith(b"RIFF"):
        return _chunks(data, 12, "<I", 8)
    if data[4:8] == b"ftyp":
        return _chunks(data, 0, ">I", 0)
    if data.startswith(b"ply"):
        ends = [m.end() for m in re.finditer(rb"\n", data[: data.find(b"end_header\n") + len(b"end_header\n")])]
        return list(zip([0, *ends], [*ends, len(data)], strict=True))
    return []


def _chunks(data: bytes, first: int, form: str, more: int) -> list[tuple[int, int]]:
    """Chunks that begin with their length, which leaves out `more` bytes of them."""
    found = [(0, first)] if first else []
    at = first
    while at + 8 <= len(data):
        size = struct.unpack_from(form, data, at)[0] + more
        if size < 8:
            break
        found.append((at, min(at + size, len(data))))
        at += size
    return found


def chunk(data: bytes, random: Random) -> bytes | None:
    """A chunked file cut at a border, with chunks left out, doubled, exchanged or in another order, or of a length that
    is not theirs."""
    found = parts(data)
    if len(found) < 2:
        return None
    (begin, end), what = random.choice(found), random.randrange(6)
    if what == 0:
        return data[: max(end + random.choice((-1, 0, 1, 4)), 0)]
    if what == 1:
        return data[:begin] + data[end:]
    if what == 2:
        return data[:end] + data[begin:end] * random.choice((1, 2, 300)) + data[end:]
    if what == 3:
        other = random.choice(found)
        return data[:begin] + data[other[0] : other[1]] + data[end:]
    if what == 4 and begin + 4 <= len(data):
        out = bytearray(data)
        _renumbered(out, begin, "<I" if data.startswith((b"glTF", b"RIFF")) else ">I", random)
        return bytes(out)
    first, *rest = (data[a:b] for a, b in found)
    random.shuffle(rest)
    return first + b"".join(rest)


def length(data: bytes, random: Random) -> bytes | None:
    """What looks like a length, in either order of bytes, becomes another."""
    found = [(at, form) for at in range(max(min(len(data) - 4, 2000), 0)) for form in ("<I", ">I")
             if 0 < struct.unpack_from(form, data, at)[0] <= len(data)]  # fmt: skip
    if not found:
        return None
    out = bytearray(data)
    _renumbered(out, *random.choice(found), random)
    return bytes(out)


def floats(data: bytes, random: Random) -> bytes | None:
    """Numbers of a table in single precision, wherever it lies."""
    table = np.frombuffer(data[: len(data) // 4 * 4], "<f4")
    with np.errstate(all="ignore"):
        places = np.flatnonzero((np.abs(table) > 1e-4) & (np.abs(table) < 1e4))
    if len(places) < 4:
        return None
    table = table.copy()
    table[random.sample(list(places), min(len(places), random.choice((1, 4, 400))))] = random.choice(_FLOATS)
    return table.tobytes() + data[len(data) // 4 * 4 :]


def nesting(data: bytes, random: Random) -> bytes | None:
    """JSON with a value inside of many lists, or with one name twice, or in other bytes."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return None
    if not isinstance(document, dict | list) or not document:
        return None
    key = random.choice(sorted(document)) if isinstance(document, dict) else random.randrange(len(document))
    kept, what = document[key], random.randrange(4)
    if what == 1 and isinstance(document, dict):
        text = json.dumps(document)
        return (text[:-1] + f", {json.dumps(key)}: {random.choice(('null', '[]', 'NaN', '-1e999', '7'))}}}").encode()
    if what == 2:
        return json.dumps(document).encode(random.choice(("utf-16", "utf-32", "utf-8-sig")))
    for _ in range(random.choice(_LEVELS)):
        kept = [kept] if random.random() < 0.5 else {"a": kept}
    document[key] = kept
    try:
        return json.dumps(document).encode()
    except RecursionError:
        return None


CHANGES: tuple[Change, ...] = (array, archive, chunk, nesting, length, floats)


def changed(data: bytes, other: bytes, random: Random) -> bytes:
    """A file that is changed at a border of its format.

    Args:
        data: a sound file.
        other: another one that the same reader may get: a part of the files is the head of one and the tail of this.
        random: what is drawn from.
    """
    if random.random() < 0.1:
        ends, begins = [b for _, b in parts(data)], [a for a, _ in parts(other)]
        cut = random.choice(ends) if ends else random.randrange(len(data) + 1)
        return data[:cut] + other[random.choice(begins) if begins else random.randrange(len(other) + 1) :]
    for change in random.sample(CHANGES[:4], 4) + random.sample(CHANGES[4:], 2):
        if random.random() < 0.8 and (made := change(data, random)) is not None:
            return made
    cut = random.randrange(len(data) + 1)
    return data[:cut] + bytes(random.randrange(9)) + data[cut + random.randrange(9) :]
