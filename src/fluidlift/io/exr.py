"""OpenEXR pictures, read with NumPy: one part, scan lines, uncompressed, RLE, ZIPS or ZIP.

OpenCV from PyPI is built without OpenEXR, yet depth and plates in visual effects come as .exr. The layout is that of
the file format description of openexr.com; the lossy and wavelet compressions (PIZ, PXR24, B44, DWA) are refused.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.confined import read_confined
from fluidlift.io.limits import MAX_PIXEL_BYTES, ReadLimits, require_file, require_size

_KINDS = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}
_LINES = {0: 1, 1: 1, 2: 1, 3: 16}
"""scan lines per block of the compressions that are read: none, RLE, ZIPS, ZIP"""
MAX_SIDE = 2**16 - 1
"""px"""
MAX_BYTES = 2**30
"""of a file"""
_NAMES = ("none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")


def read_channels(path: Path | str, *, limits: ReadLimits | None = None) -> dict[str, np.ndarray]:
    """Every channel of an OpenEXR file by name, float32 [H,W] of its data window.

    Raises:
        InputRejected: no such file, damaged, a compression or layout that is not read, or more pixels than
            `limits.max_pixels` or samples than `MAX_PIXEL_BYTES` for each of them; or reading it takes more than
            `io.confined` lets it take.
    """
    return read_confined(_read_channels, require_file(path, "OpenEXR file"), limits)


def _read_channels(path: Path, limits: ReadLimits) -> dict[str, np.ndarray]:
    require_size(path, MAX_BYTES, "OpenEXR file")
    return channels_in(path.read_bytes(), path.name, limits)


def channels_in(data: bytes, file: str, limits: ReadLimits) -> dict[str, np.ndarray]:
    """Every channel in the bytes of an OpenEXR file that is called `file`; raises as `read_channels`."""
    try:
        channels, compression, (x0, y0, x1, y1), at = _header(file, data)
        width, height = x1 - x0 + 1, y1 - y0 + 1
        _require_bounded(file, width, height, len(channels), limits)
        out = {name: np.zeros((height, width), np.float32) for name, _ in channels}
        blocks = -(-height // _LINES[compression])
        for offset in struct.unpack_from(f"<{blocks}Q", data, at):
            y, size = struct.unpack_from("<ii", data, offset)
            row = y - y0
            rows = min(_LINES[compression], height - row)
            if row < 0 or rows < 1 or size < 0:
                raise ValueError("a block beside the picture")
            expected = rows * width * sum(kind.itemsize for _, kind in channels)
            raw = _unpacked(data[offset + 8 : offset + 8 + size], compression, expected)
            if len(raw) != expected:
                raise ValueError("a block of the wrong size")
            line = 0
            for i in range(rows):
                for name, kind in channels:  # each scan line holds its channels one after the other
                    out[name][row + i] = np.frombuffer(raw, kind, width, line)
                    line += width * kind.itemsize
        return out
    except (struct.error, ValueError, IndexError, KeyError, OverflowError, zlib.error) as error:
        raise InputRejected(f"'{file}' is damaged ({error})", "a whole OpenEXR file", "export it again") from None


def _require_bounded(file: str, width: int, height: int, channels: int, limits: ReadLimits) -> None:
    """Nothing is allocated for a picture that is too large."""
    if min(width, height) < 1 or max(width, height) > MAX_SIDE or width * height > limits.max_pixels:
        raise InputRejected(
            f"'{file}' is {width} x {height} pixels",
            f"1 to {limits.max_pixels} pixels, and at most {MAX_SIDE} a side",
            "scale it down, or raise the limit with --set read.max_pixels=NUMBER",
        )
    most = MAX_PIXEL_BYTES * limits.max_pixels
    if 4 * width * height * channels > most:
        raise InputRejected(
            f"'{file}' has {channels} channels of {width} x {height} pixels", f"at most {most} bytes of samples",
            "export only the channels that are needed",
        )  # fmt: skip


def _header(file: str, data: bytes) -> tuple[list[tuple[str, np.dtype]], int, tuple[int, ...], int]:
    """Channels in file order, compression, data window, and where the table of offsets begins."""
    magic, version = struct.unpack_from("<II", data)
    if magic != 0x01312F76:
        raise ValueError("it does not begin as OpenEXR does")
    if version & 0x1A00:
        raise InputRejected(
            f"'{file}' is tiled, deep or multi-part",
            "one part with scan lines",
            "export it as a flat scan-line file",
        )
    at, attributes = 8, {}
    while data[at]:
        name, at = _text(data, at)
        _, at = _text(data, at)
        size = struct.unpack_from("<i", data, at)[0]
        if not 0 <= size <= len(data) - at - 4:
            raise ValueError("an attribute of the wrong size")
        attributes[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    compression = attributes["compression"][0]
    if compression not in _LINES:
        name = _NAMES[compression] if compression < len(_NAMES) else str(compression)
        raise InputRejected(f"'{file}' uses {name} compression", "ZIP, ZIPS, RLE or none", "export it with ZIP")
    channels, i = [], 0
    listed = attributes["channels"]
    while listed[i]:
        name, i = _text(listed, i)
        kind, _, across, down = struct.unpack_from("<iIii", listed, i)
        if (across, down) != (1, 1):
            raise InputRejected(f"'{file}' has subsampled channels", "full channels", "export it as RGB")
        channels.append((name, _KINDS[kind]))
        i += 16
    return channels, compression, struct.unpack("<4i", attributes["dataWindow"]), at + 1


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at, at + 256)
    return data[at:end].decode("utf-8", "replace"), end + 1


def _unpacked(block: bytes, compression: int, expected: int) -> bytes:
    """Undo the compression, the differences between neighbours, and the split into low and high bytes."""
    if compression == 0 or len(block) == expected:
        return block
    packed = _run_lengths(block, expected) if compression == 1 else zlib.decompressobj().decompress(block, expected)
    steps = np.frombuffer(packed, np.uint8).copy()
    steps[1:] -= np.uint8(128)  # sums of bytes go round, as they must
    values = np.cumsum(steps, dtype=np.uint8)
    out = np.empty(len(values), np.uint8)
    half = (len(values) + 1) // 2
    out[0::2], out[1::2] = values[:half], values[half:]
    return out.tobytes()


def _run_lengths(block: bytes, expected: int) -> bytes:
    out, at = bytearray(), 0
    while at < len(block) and len(out) <= expected:
        count = block[at] - 256 if block[at] > 127 else block[at]
        if count < 0:  # that many bytes as they are
            out += block[at + 1 : at + 1 - count]
            at += 1 - count
        else:  # one byte, again and again
            out += block[at + 1 : at + 2] * (count + 1)
            at += 2
    return bytes(out)
