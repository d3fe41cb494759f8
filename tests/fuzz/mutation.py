"""Small changes of bytes, as a hostile or a careless writer makes them."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import NamedTuple

NUMBERS = (
    b"0", b"-1", b"1", b"nan", b"inf", b"-Infinity", b"1e999", b"1e-999", b"1e12", b"4294967295", b"2147483648",
    b"1000000000000", b"9" * 30, b"9" * 5000, b"0x7fffffff", b"1_000", b"1:30:00", b"0.5", b"-0", b"1e6",
)  # fmt: skip
TOKENS = (
    b"null", b"true", b"[]", b"{}", b'""', b'"' + b"n" * 299 + b'"', b"[[1]]", b'{"a": 1}', b"[1, 2]", b"'", b"\x00",
    b"[" * 3000, b'{"a":' * 3000, b"&a", b"*a", b"!!python/name:os.system", b"../../../../etc/passwd", b"\xff\xfe",
    b"\xed\xa0\x80", b"n" * 299, b"-", b"~", b"\r\n", b"\t", b"[" * 100 + b"]" * 100, b"/etc/passwd",
)  # fmt: skip
INTEGERS = (0, 1, 2, 3, 127, 128, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 1 << 24, 0x7FFFFFFF, 1 << 31, 0xFFFFFFFF)
_NUMBER = re.compile(rb"-?[0-9][0-9.eE+-]*")
_TOKEN = re.compile(rb'"(?:[^"\\]|\\.)*"|-?[0-9][0-9.eE+-]*|true|false|null|[\w/]+|[\[\]{}]')


class Edit(NamedTuple):
    """One change: which, where (a share of the length), and with what."""

    kind: int
    at: float
    value: int


def _bit(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + bytes([data[at] ^ (1 << value % 8)]) + data[at + 1 :]


def _byte(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + bytes([value % 256]) + data[at + 1 :]


def _cut(data: bytes, at: int, value: int) -> bytes:
    return data[:at] if value % 2 else data[at:]


def _taken_out(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + data[at + 1 + value % 64 :]


def _repeated(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + data[at : at + 1 + value % 256] * (2 + value % 7) + data[at:]


def _integer(data: bytes, at: int, value: int) -> bytes:
    number, form = INTEGERS[value % len(INTEGERS)], ("<I", ">I", "<H", ">H", "<Q")[value // 16 % 5]
    packed = struct.pack(form, number % (1 << 8 * struct.calcsize(form)))
    at -= at % len(packed) if value % 3 else 0
    return data[:at] + packed + data[at + len(packed) :]


def _near(pattern: re.Pattern[bytes], data: bytes, at: int, words: tuple[bytes, ...], value: int) -> bytes:
    found = pattern.search(data, at) or pattern.search(data)
    if found is None:
        return _inserted(data, at, value)
    return data[: found.start()] + words[value % len(words)] + data[found.end() :]


def _number(data: bytes, at: int, value: int) -> bytes:
    return _near(_NUMBER, data, at, NUMBERS, value)


def _token(data: bytes, at: int, value: int) -> bytes:
    return _near(_TOKEN, data, at, TOKENS + NUMBERS, value)


def _inserted(data: bytes, at: int, value: int) -> bytes:
    words = TOKENS + NUMBERS
    return data[:at] + words[value % len(words)] + data[at:]


def _moved(data: bytes, at: int, value: int) -> bytes:
    """A span of the file at another place of it."""
    size, other = 1 + value % 512, value * 7919 % len(data)
    return data[:at] + data[other : other + size] + data[at + size :]


def _filled(data: bytes, at: int, value: int) -> bytes:
    """A run of one byte over what was there."""
    size = 1 + value % 128
    return data[:at] + bytes([value % 256]) * size + data[at + size :]


KINDS: tuple[Callable[[bytes, int, int], bytes], ...] = (
    _bit, _byte, _cut, _taken_out, _repeated, _integer, _number, _token, _inserted, _moved, _filled,
)  # fmt: skip
LONGEST = 4 * 2**20
"""bytes of an input"""


def mutated(data: bytes, edits: list[Edit]) -> bytes:
    """The bytes after some edits."""
    for edit in edits:
        if not data:
            break
        at = min(int(edit.at * len(data)), len(data) - 1)
        data = KINDS[edit.kind % len(KINDS)](data, at, edit.value)[:LONGEST]
    return data
