"""Inputs that keep the form of their format and lie in what they say, drawn with Hypothesis.

Changes of single bytes are mostly refused at the first check, by a checksum, a length or a bracket. What is drawn here
passes those: JSON and YAML are parsed, changed at a place and written again; headers of arrays, PLY, OpenEXR and PNG
get other fields with sound lengths and checksums; texts get other lines; boxes of MP4 are moved, left out and doubled.
"""

from __future__ import annotations

import copy
import json
import struct
import zlib
from collections.abc import Callable
from typing import Any

import yaml
from hypothesis import strategies as st

from .corpus import Seed
from .mutation import INTEGERS, KINDS, NUMBERS, TOKENS, Edit, mutated

Draw = st.DrawFn

_ODD = st.sampled_from(
    [0, -1, 1, 2, 255, 2**31 - 1, 2**31, 2**63, 10**30, 0.5, -0.0, 1e308, float("nan"), float("inf")]
)
_PLAIN = st.one_of(
    st.none(), st.booleans(), _ODD, st.integers(-5, 5), st.floats(width=32), st.text(max_size=8), st.just("n" * 299)
)
VALUES = st.recursive(
    _PLAIN,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=8,
)
"""plain data as JSON and YAML have them"""


@st.composite
def _patched(draw: Draw, document: Any) -> Any:
    """A document with up to three values replaced, taken away, doubled, or put elsewhere."""
    document = copy.deepcopy(document)
    for _ in range(draw(st.integers(1, 3))):
        parent, key = None, None
        here = document
        while isinstance(here, dict | list) and here and draw(st.integers(0, 5)):
            parent = here
            key = draw(st.sampled_from(sorted(here))) if isinstance(here, dict) else draw(st.integers(0, len(here) - 1))
            here = here[key]
        if parent is None:
            return draw(VALUES)
        what = draw(st.sampled_from(("replace", "replace", "delete", "wrap", "repeat", "add")))
        if what == "replace":
            parent[key] = draw(VALUES)
        elif what == "delete":
            del parent[key]
        elif what == "wrap":
            parent[key] = [here]
        elif what == "repeat":
            parent[key] = here * draw(st.integers(2, 50)) if isinstance(here, list | str) else [here] * 3
        elif isinstance(parent, dict):
            parent[draw(st.text(max_size=6))] = draw(VALUES)
        else:
            parent.append(draw(VALUES))
        if not isinstance(document, dict | list) or not document:
            break
    return document


def _json(data: bytes) -> st.SearchStrategy[bytes] | None:
    try:
        document = json.loads(data)
    except ValueError:
        return None
    return _patched(document).map(lambda d: json.dumps(d).encode("utf-8", "surrogatepass"))


def _json_lines(data: bytes) -> st.SearchStrategy[bytes] | None:
    try:
        documents = [json.loads(line) for line in data.splitlines()]
    except ValueError:
        return None
    return _patched(documents).map(
        lambda d: b"".join(json.dumps(line).encode() + b"\n" for line in (d if isinstance(d, list) else [d]))
    )


def _yaml(data: bytes) -> st.SearchStrategy[bytes] | None:
    try:
        document = yaml.safe_load(data)
    except (yaml.YAMLError, ValueError):
        return None
    if not isinstance(document, dict | list):
        return None
    return _patched(document).map(lambda d: yaml.safe_dump(d, allow_unicode=True).encode("utf-8", "surrogatepass"))


def _array(data: bytes) -> st.SearchStrategy[bytes] | None:
    """A .npy: its header says another type, shape or order, in sound form."""
    if not data.startswith(b"\x93NUMPY"):
        return None
    (size,) = struct.unpack_from("<H", data, 8)
    body = data[10 + size :]
    sizes = st.integers(0, 70) | st.sampled_from([2**31, 2**40, 2**63, 10**30, -1])
    kinds = st.sampled_from(["<f4", ">f8", "<f2", "|u1", "<i8", "<c16", "|b1", "<U9", "|O", "|V8", "<M8[s]", "<f3", ""])

    @st.composite
    def other(draw: Draw) -> bytes:
        shape = tuple(draw(st.lists(sizes, max_size=5)))
        header = {"descr": draw(kinds), "fortran_order": draw(st.booleans()), "shape": shape}
        text = repr(header).encode() + b"\n"
        length = draw(st.integers(0, len(body) + 64))
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + (body + bytes(64))[:length]

    return other()


_WORDS = tuple(t for t in TOKENS + NUMBERS if len(t) < 300 and b"\n" not in t)


def _lines(data: bytes) -> st.SearchStrategy[bytes] | None:
    """A text, or the text before the binary part of a PLY: lines and words are doubled, left out, moved, replaced."""
    text, mark, body = data.partition(b"end_header\n")
    if not data.startswith(b"ply"):
        text, mark, body = data, b"", b""
    if not text or text.count(b"\0") or max(text) > 126:
        return None
    whole = text.split(b"\n")

    @st.composite
    def other(draw: Draw) -> bytes:
        lines = list(whole)
        for _ in range(draw(st.integers(1, 4))):
            k = draw(st.integers(0, len(lines) - 1))
            what = draw(st.sampled_from(("word", "word", "delete", "double", "swap")))
            words = lines[k].split(b" ")
            if what == "word":
                place = draw(st.integers(0, len(words) - 1))
                words[place] = draw(st.sampled_from(_WORDS) | st.sampled_from(whole[0].split(b" ") + words))
                lines[k] = b" ".join(words)
            elif what == "delete" and len(lines) > 1:
                del lines[k]
            elif what == "double":
                lines.insert(k, lines[k])
            else:
                other = draw(st.integers(0, len(lines) - 1))
                lines[k], lines[other] = lines[other], lines[k]
        return b"\n".join(lines) + mark + body

    return other()


def _numbers(data: bytes, places: range, form: str) -> st.SearchStrategy[bytes]:
    """Whole numbers of a header, replaced in place."""
    size = struct.calcsize(form)

    @st.composite
    def other(draw: Draw) -> bytes:
        out = bytearray(data)
        for _ in range(draw(st.integers(1, 3))):
            number = draw(st.sampled_from(INTEGERS) | st.integers(0, 70)) % (1 << 8 * size)
            struct.pack_into(form, out, draw(st.sampled_from(places)), number)
        return bytes(out)

    return other()


def _exr(data: bytes) -> st.SearchStrategy[bytes] | None:
    """OpenEXR: numbers of the windows, of channels and of compression, at their places, so that offsets stay right."""
    if not data.startswith(b"\x76\x2f\x31\x01"):
        return None
    end = data.index(b"\0\0", data.index(b"screenWindowWidth")) if b"screenWindowWidth" in data else len(data) // 4
    return _numbers(data, range(8, min(end + 64, len(data) - 8)), "<I") | _numbers(data, range(8, end), "<B")


_CHUNKS = (b"PLTE", b"tRNS", b"iCCP", b"zTXt", b"acTL", b"eXIf", b"IDAT")


def _png(data: bytes) -> st.SearchStrategy[bytes] | None:
    """PNG: chunks left out, doubled, moved and changed, with the checksums that belong to them."""
    if not data.startswith(b"\x89PNG"):
        return None
    chunks, at = [], 8
    while at + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size

    @st.composite
    def other(draw: Draw) -> bytes:
        parts = list(chunks)
        for _ in range(draw(st.integers(1, 3))):
            k = draw(st.integers(0, len(parts) - 1))
            kind, content = parts[k]
            what = draw(st.sampled_from(("field", "field", "delete", "double", "kind", "packed")))
            if what == "field" and content:
                place = draw(st.integers(0, min(len(content), 16) - 1))
                fields = bytearray(content)
                fields[place] = draw(st.integers(0, 255))
                parts[k] = kind, bytes(fields)
            elif what == "delete" and len(parts) > 1:
                del parts[k]
            elif what == "kind":
                parts[k] = (
                    draw(st.sampled_from((b"PLTE", b"tRNS", b"iCCP", b"zTXt", b"acTL", b"eXIf", b"IDAT"))),
                    content,
                )
            elif what == "packed":  # other rows, in a sound stream
                parts[k] = b"IDAT", zlib.compress(bytes(draw(st.integers(0, 5000))))
            else:
                parts.insert(k, parts[k])
        packed = (struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in parts)
        return data[:8] + b"".join(packed)

    return other()


_INSIDE = {b"moov", b"trak", b"mdia", b"minf", b"stbl"}
"""boxes of MP4 that hold boxes"""


def _boxes_in(data: bytes) -> list[tuple[bytes, Any]]:
    found, at = [], 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        if not 8 <= size <= len(data) - at:
            break
        body = data[at + 8 : at + size]
        found.append((kind, _boxes_in(body) if kind in _INSIDE else body))
        at += size
    return found


def _packed(boxes: list[tuple[bytes, Any]]) -> bytes:
    bodies = [(kind, _packed(body) if isinstance(body, list) else body) for kind, body in boxes]
    return b"".join(struct.pack(">I4s", 8 + len(body), kind) + body for kind, body in bodies)


def _mp4(data: bytes) -> st.SearchStrategy[bytes] | None:
    """MP4: boxes left out, doubled, moved, and with other numbers, in sound sizes."""
    if data[4:8] != b"ftyp":
        return None
    boxes = _boxes_in(data)

    @st.composite
    def other(draw: Draw) -> bytes:
        tree = copy.deepcopy(boxes)
        for _ in range(draw(st.integers(1, 3))):
            level = tree
            while True:
                k = draw(st.integers(0, len(level) - 1))
                kind, body = level[k]
                if not (isinstance(body, list) and body and draw(st.integers(0, 4))):
                    break
                level = body
            what = draw(st.sampled_from(("numbers", "numbers", "delete", "double", "swap")))
            if what == "numbers" and isinstance(body, bytes) and len(body) >= 4:
                level[k] = kind, draw(_numbers(body, range(min(len(body), 120) - 3), ">I"))
            elif what == "delete" and len(level) > 1:
                del level[k]
            elif what == "swap":
                other = draw(st.integers(0, len(level) - 1))
                level[k], level[other] = level[other], level[k]
            else:
                level.insert(k, level[k])
        return _packed(tree)

    return other()


def _header(data: bytes) -> st.SearchStrategy[bytes] | None:
    """Any other binary file: the numbers of its first bytes."""
    return _numbers(data, range(min(len(data), 64) - 7), "<I") if len(data) > 16 else None


FORMS: tuple[Callable[[bytes], st.SearchStrategy[bytes] | None], ...] = (
    _json, _json_lines, _yaml, _array, _exr, _png, _mp4, _lines, _header,
)  # fmt: skip
_EDITS = st.lists(
    st.builds(Edit, st.integers(0, len(KINDS) - 1), st.floats(0, 1, exclude_max=True), st.integers(0, 2**30)),
    min_size=1, max_size=3,
)  # fmt: skip


def inputs_of(seeds: list[Seed]) -> st.SearchStrategy[bytes]:
    """Files drawn from sound ones: by their form, some of them with changes of bytes on top."""

    def of(seed: Seed) -> st.SearchStrategy[bytes]:
        formed = next((s for s in (form(seed.data) for form in FORMS) if s is not None), st.just(seed.data))
        changed = st.builds(mutated, formed, _EDITS)
        return (formed | formed | formed | changed).map(seed.pack)

    return st.one_of([of(seed) for seed in seeds])
