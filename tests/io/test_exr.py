"""OpenEXR files of another writer (FFmpeg) and hand-made ones are read exactly, or refused."""

from __future__ import annotations

import struct
import zlib
from fractions import Fraction

import av
import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.exr import read_channels
from fluidlift.io.images import read_depth
from fluidlift.io.limits import ReadLimits
from fluidlift.io.video import read_clip


def ffmpeg_exr(path, planes: np.ndarray, compression: str, kind: str) -> None:
    """Write float32 [3,H,W] (G, B, R planes) with FFmpeg's own encoder."""
    context = av.CodecContext.create("exr", "w")
    context.height, context.width, context.pix_fmt = planes.shape[1], planes.shape[2], "gbrpf32le"
    context.options = {"compression": compression, "format": kind}
    context.time_base = Fraction(1, 25)
    frame = av.VideoFrame(planes.shape[2], planes.shape[1], "gbrpf32le")
    for plane, values in zip(frame.planes, planes):
        padded = np.zeros((plane.height, plane.line_size // 4), np.float32)
        padded[:, : plane.width] = values
        plane.update(padded.tobytes())
    path.write_bytes(b"".join(bytes(p) for p in (*context.encode(frame), *context.encode(None))))


def hand_made(channels: dict[str, np.ndarray], compression: int = 0, first_row: int = 0) -> bytes:
    """A scan-line file with float32 channels, blocks of 16 lines for ZIP."""
    height, width = next(iter(channels.values())).shape

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    listed = b"".join(n.encode() + b"\0" + struct.pack("<iIii", 2, 0, 1, 1) for n in sorted(channels)) + b"\0"
    window = struct.pack("<4i", 0, first_row, width - 1, first_row + height - 1)
    header = struct.pack("<II", 0x01312F76, 2) + attribute("channels", "chlist", listed)
    header += attribute("compression", "compression", bytes([compression])) + attribute("dataWindow", "box2i", window)
    header += b"\0"
    step = 16 if compression == 3 else 1
    blocks = []
    for y in range(0, height, step):
        rows = range(y, min(y + step, height))
        raw = b"".join(channels[n][r].astype("<f4").tobytes() for r in rows for n in sorted(channels))
        if compression == 3:
            split = np.frombuffer(raw, np.uint8)
            split = np.concatenate([split[0::2], split[1::2]]).astype(int)
            steps = np.concatenate([split[:1], (np.diff(split) + 128) & 255]).astype(np.uint8)
            packed = zlib.compress(steps.tobytes())
            raw = packed if len(packed) < len(raw) else raw
        blocks.append(struct.pack("<ii", first_row + y, len(raw)) + raw)
    at, table = len(header) + 8 * len(blocks), b""
    for block in blocks:
        table += struct.pack("<Q", at)
        at += len(block)
    return header + table + b"".join(blocks)


@pytest.mark.parametrize("compression", ["none", "rle", "zip1", "zip16"])
@pytest.mark.parametrize("kind", ["half", "float"])
def test_files_of_another_writer_are_read_exactly(tmp_path, compression, kind):
    y, x = np.mgrid[:37, :53].astype(np.float32)
    planes = np.stack([x / 8, np.floor(y / 10), np.sin(x * y)])  # smooth, flat (long runs), noisy
    if kind == "half":  # numbers that half precision holds: FFmpeg cuts off where others round
        planes = planes.astype(np.float16).astype(np.float32)
    ffmpeg_exr(tmp_path / "a.exr", planes, compression, kind)
    channels = read_channels(tmp_path / "a.exr")
    for name, plane in zip("GBR", planes):
        np.testing.assert_array_equal(channels[name], plane)


@pytest.mark.parametrize("compression", [0, 3])
def test_a_depth_channel_is_depth(tmp_path, compression):
    depth = np.linspace(1, 9, 48 * 64, dtype=np.float32).reshape(48, 64)
    holes = depth.copy()
    holes[:4] = 1e10
    picture = {"Z": holes, "R": np.zeros_like(depth), "A": np.ones_like(depth)}
    (tmp_path / "d.exr").write_bytes(hand_made(picture, compression, first_row=5))
    read = read_depth(tmp_path / "d.exr", (64, 48))
    np.testing.assert_array_equal(read[4:], depth[4:])
    assert np.isnan(read[:4]).all()


def test_linear_plates_become_srgb_frames(tmp_path):
    for i in range(2):
        ffmpeg_exr(tmp_path / f"{i}.exr", np.full((3, 20, 30), 0.214 + 0.01 * i, np.float32), "zip16", "float")
    clip = read_clip(tmp_path, fps=24)
    assert clip.frames.shape == (2, 20, 30, 3) and abs(int(clip.frames[0, 5, 5, 0]) - 128) <= 1  # sRGB 0.5


def test_what_cannot_be_read_is_refused(tmp_path):
    good = hand_made({"Z": np.ones((20, 30), np.float32)}, 3)
    name = good.index(b"compression\0compression\0") + len(b"compression\0compression\0") + 4
    cases = {
        "PIZ": good[:name] + b"\x04" + good[name + 1 :],
        "tiled": good[:4] + struct.pack("<I", 2 | 0x200) + good[8:],
        "damaged": good[:-10],
        "max_pixels": good.replace(struct.pack("<4i", 0, 0, 29, 19), struct.pack("<4i", 0, 0, 99999, 99999)),
    }
    for reason, data in cases.items():
        (tmp_path / "a.exr").write_bytes(data)
        with pytest.raises(InputRejected, match=reason):
            read_channels(tmp_path / "a.exr", limits=ReadLimits())
