"""What a picture is and how large it becomes, told by its first bytes before anything is decoded.

PNG, JPEG, BMP, TIFF, WebP and OpenEXR; a file's name says nothing. What has no such header is not decoded at all.
"""

from __future__ import annotations

import struct
from typing import NamedTuple


class PictureHeader(NamedTuple):
    """Of one picture."""

    kind: str
    """PNG, JPEG, BMP, TIFF, WebP or OpenEXR"""
    width: int
    height: int
    pixel_bytes: int
    """of a pixel when it is decoded; 0 where the header does not say it (OpenEXR, which is read by `io.exr`)"""


def picture_header(data: bytes) -> PictureHeader:
    """The header of a picture.

    Args:
        data: the whole file.

    Raises:
        ValueError: of another kind, or a header that makes no sense.
    """
    try:
        for magic, read in _READERS:
            if data.startswith(magic):
                found = read(data)
                if found.kind != "OpenEXR" and min(found.width, found.height) < 1:
                    raise ValueError(f"{found.width} x {found.height} pixels")
                return found
    except (struct.error, IndexError) as error:
        raise ValueError(f"its header breaks off ({error})") from None
    raise ValueError("it does not begin as PNG, JPEG, BMP, TIFF, WebP or OpenEXR do")


def require_whole_chunks(data: bytes) -> None:
    """Decoders make room for what a chunk of a PNG claims: one file of 65 bytes took 2 GB.

    Raises:
        ValueError: a chunk that claims more than the file has.
    """
    at = 8
    while at + 8 <= len(data):
        length = struct.unpack_from(">I", data, at)[0]
        if length > len(data):
            raise ValueError(f"a chunk claims {length} bytes of {len(data)}")
        at += 12 + length


def _png(data: bytes) -> PictureHeader:
    width, height, bits, color = struct.unpack_from(">IIBB", data, 16)
    channels = {0: 1, 2: 3, 3: 4, 4: 4, 6: 4}.get(color, 4)  # palettes and grey with alpha become four
    return PictureHeader("PNG", width, height, channels * (2 if bits > 8 else 1))


def _jpeg(data: bytes) -> PictureHeader:
    """By the frame header, however far behind other segments it stands."""
    at = 2
    while True:
        at = data.index(b"\xff", at)  # decoders pass over what stands between segments, too
        while data[at + 1] == 0xFF:  # filled up
            at += 1
        marker = data[at + 1]
        if marker in (0x01, *range(0xD0, 0xD8)):  # markers without a segment
            at += 2
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            _, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            return PictureHeader("JPEG", width, height, max(channels, 1))
        if marker in (0xD9, 0xDA) or length < 2:
            raise ValueError("no frame header")
        at += 2 + length


def _bmp(data: bytes) -> PictureHeader:
    (size,) = struct.unpack_from("<I", data, 14)
    if size == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
    else:
        width, height, _, bits = struct.unpack_from("<iiHH", data, 18)
    return PictureHeader("BMP", abs(width), abs(height), 4 if bits == 32 else 3)


def _webp(data: bytes) -> PictureHeader:
    if data[8:12] != b"WEBP":
        raise ValueError("RIFF, but no WebP")
    kind = data[12:16]
    if kind == b"VP8X":
        wide, high = (int.from_bytes(data[a : a + 3], "little") for a in (24, 27))
        return PictureHeader("WebP", wide + 1, high + 1, 4)
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return PictureHeader("WebP", (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1, 4)
    if kind != b"VP8 ":
        raise ValueError("WebP of another kind")
    width, height = struct.unpack_from("<HH", data, 26)
    return PictureHeader("WebP", width & 0x3FFF, height & 0x3FFF, 3)


_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 16: 8}
"""bytes of a value of TIFF's whole-number types"""
_WIDTH, _HEIGHT, _BITS, _CHANNELS, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 277, 322, 323


def _tiff(data: bytes) -> PictureHeader:
    """By the first directory. Tiles are decoded whole, so that the picture counts as at least one of them."""
    order = "<" if data[:2] == b"II" else ">"
    (version,) = struct.unpack_from(order + "H", data, 2)
    if version == 43:  # BigTIFF
        count_form, offset_form, entry = "Q", "Q", 20
        (at,) = struct.unpack_from(order + "Q", data, 8)
    else:
        count_form, offset_form, entry = "H", "I", 12
        (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + count_form, data, at)
    if count > 4096:
        raise ValueError(f"{count} entries")
    at += struct.calcsize(count_form)
    tags: dict[int, int] = {}
    for k in range(count):
        here = at + entry * k
        tag, kind, number = struct.unpack_from(order + "HH" + offset_form, data, here)
        if tag in (_WIDTH, _HEIGHT, _BITS, _CHANNELS, _TILE_WIDTH, _TILE_HEIGHT):
            size = _SIZES.get(kind)
            if size is None or number < 1:
                raise ValueError("a size that is no whole number")
            place, room = here + 4 + struct.calcsize(offset_form), struct.calcsize(offset_form)
            if size * number > room:
                (place,) = struct.unpack_from(order + offset_form, data, place)
            form = order + {1: "B", 2: "H", 4: "I", 8: "Q"}[size]
            values = [struct.unpack_from(form, data, place + size * i)[0] for i in range(min(number, 16))]
            tags[tag] = max(tags.get(tag, 0), *values)
    width, height = tags.get(_WIDTH, 0), tags.get(_HEIGHT, 0)
    channels, bits = max(tags.get(_CHANNELS, 1), 3), max(tags.get(_BITS, 8), 8)
    wide, high = max(width, tags.get(_TILE_WIDTH, 0)), max(height, tags.get(_TILE_HEIGHT, 0))
    if min(width, height) < 1 or wide > 2 * width + 1024 or high > 2 * height + 1024:
        raise ValueError(f"{width} x {height} pixels in tiles of {wide} x {high}")
    return PictureHeader("TIFF", width, height, channels * -(-bits // 8))


def _exr(data: bytes) -> PictureHeader:
    return PictureHeader("OpenEXR", 0, 0, 0)


_READERS = (
    (b"\x89PNG\r\n\x1a\n", _png), (b"\xff\xd8", _jpeg), (b"BM", _bmp), (b"RIFF", _webp),
    (b"II*\0", _tiff), (b"MM\0*", _tiff), (b"II+\0", _tiff), (b"MM\0+", _tiff), (b"\x76\x2f\x31\x01", _exr),
)  # fmt: skip
