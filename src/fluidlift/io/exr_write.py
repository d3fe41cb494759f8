"""OpenEXR pictures, written with NumPy: float32 channels of any name, scan lines, ZIP compression.

The twin of `io.exr`. The layout is that of the file format description of openexr.com.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.io.atomic import write_bytes

_ZIP, _LINES = 3, 16
"""the number of the compression, and scan lines per block of it"""


def write_channels(path: Path | str, channels: Mapping[str, Float[np.ndarray, "h w"]]) -> Path:
    """Write float channels of one size under their names, all at once.

    Args:
        path: of the file.
        channels: by name of at most 31 bytes; "layer.name" makes a layer.

    Raises:
        ValueError: no channel, channels of several sizes, or a name that OpenEXR does not take.
        InputRejected: the disk does not take the file.
    """
    shapes = {np.shape(values) for values in channels.values()}
    require(len(shapes) == 1 and len(next(iter(shapes))) == 2, f"channels of {shapes}", "one size, [H,W]")
    require(all(0 < len(n.encode()) < 32 and "\0" not in n for n in channels), f"names {list(channels)}", "1-31 bytes")
    height, width = next(iter(shapes))
    names = sorted(channels, key=str.encode)  # the order that the format asks for
    lines = np.stack([np.asarray(channels[n], "<f4") for n in names], axis=1)  # [H,C,W]: line by line, then channels
    header = _header(names, width, height)
    blocks = [_block(y, lines[y : y + _LINES]) for y in range(0, height, _LINES)]
    starts = np.cumsum([len(header) + 8 * len(blocks), *map(len, blocks[:-1])]).astype("<u8")
    return write_bytes(path, header + starts.tobytes() + b"".join(blocks))


def _header(names: list[str], width: int, height: int) -> bytes:
    listed = b"".join(n.encode() + b"\0" + struct.pack("<iB3xii", 2, 0, 1, 1) for n in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        ("channels", "chlist", listed),
        ("compression", "compression", bytes([_ZIP])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    )
    body = b"".join(
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
        for name, kind, value in attributes
    )
    return struct.pack("<II", 0x01312F76, 2) + body + b"\0"


def _block(y: int, lines: np.ndarray) -> bytes:
    """Low and high bytes apart, differences between neighbours, deflated; as it is where that is not smaller."""
    raw = lines.tobytes()
    split = np.frombuffer(raw, np.uint8)
    split = np.concatenate([split[0::2], split[1::2]])
    steps = split.copy()
    steps[1:] = split[1:] - split[:-1] + np.uint8(128)  # wraps round, as the format means it
    packed = zlib.compress(steps.tobytes(), 4)
    data = packed if len(packed) < len(raw) else raw
    return struct.pack("<ii", y, len(data)) + data
