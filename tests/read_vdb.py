"""An independent reader of OpenVDB files, from the format's description: every byte is accounted for."""

from __future__ import annotations

import struct
import zlib

import numpy as np


class Reader:
    """A pedestrian reader: one voxel at a time, no NumPy tricks shared with the writer."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, count: int) -> bytes:
        out = self.data[self.at : self.at + count]
        assert len(out) == count, "the file ends early"
        self.at += count
        return out

    def unpack(self, form: str):
        values = struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))
        return values[0] if len(values) == 1 else values

    def text(self) -> str:
        return self.take(self.unpack("I")).decode()

    def metadata(self) -> dict:
        out = {}
        for _ in range(self.unpack("I")):
            name, kind, size = self.text(), self.text(), self.unpack("I")
            raw = self.take(size)
            forms = {"bool": "<?", "int64": "<q", "vec3i": "<3i"}
            out[name] = raw.decode() if kind == "string" else struct.unpack(forms[kind], raw)
        return out

    def bits(self, count: int) -> list[int]:
        raw = self.take(count // 8)
        return [i for i in range(count) if raw[i // 8] >> (i % 8) & 1]

    def values(self, count: int, channels: int) -> np.ndarray:
        assert self.unpack("b") == 0, "inactive voxels must be background"
        size = self.unpack("q")
        raw = zlib.decompress(self.take(size)) if size > 0 else self.take(-size)
        return np.frombuffer(raw, "<f4").reshape(count, channels)

    def grid(self) -> dict:
        name, kind, parent = self.text(), self.text(), self.text()
        assert parent == ""
        channels = {"Tree_float_5_4_3": 1, "Tree_vec3s_5_4_3": 3}[kind]
        grid_at, blocks_at, end_at = self.unpack("3q")
        assert self.at == grid_at and self.unpack("I") == 3  # ZIP and active mask
        meta = self.metadata()
        assert self.text() == "UniformScaleTranslateMap"
        maps = [self.unpack("3d") for _ in range(6)]
        assert self.unpack("i") == 1
        background = self.unpack(f"{channels}f")
        leaves = self.topology(channels)
        assert self.at == blocks_at
        voxels = {}
        for corner, on in leaves:
            assert self.bits(512) == on
            for i, value in zip(on, self.values(len(on), channels)):
                voxels[corner[0] + i // 64, corner[1] + i // 8 % 8, corner[2] + i % 8] = value
        assert self.at == end_at
        return {"name": name, "meta": meta, "maps": maps, "background": background, "voxels": voxels}

    def topology(self, channels: int) -> list:
        leaves = []
        tiles, children = self.unpack("2I")
        assert tiles == 0
        seen = []
        for _ in range(children):
            root = self.unpack("3i")
            seen.append(root)
            assert all(c % 4096 == 0 for c in root)
            upper = self.node(32**3, channels)
            for a in upper:
                middle = [r + 128 * x for r, x in zip(root, (a // 1024, a // 32 % 32, a % 32))]
                for b in self.node(16**3, channels):
                    corner = [m + 8 * x for m, x in zip(middle, (b // 256, b // 16 % 16, b % 16))]
                    leaves.append((corner, self.bits(512)))
        assert seen == sorted(set(seen)), "the library reads the buffers in this order"
        return leaves

    def node(self, size: int, channels: int) -> list[int]:
        children = self.bits(size)
        assert self.bits(size) == []
        assert len(self.values(0, channels)) == 0
        return children


def read_vdb(path) -> list[dict]:
    """All grids of a file."""
    reader = Reader(path.read_bytes())
    assert reader.unpack("q") == 0x56444220 and reader.unpack("I") == 224
    reader.take(8)
    assert reader.unpack("B") == 1
    assert reader.take(36).count(b"-") == 4
    reader.metadata()
    grids = [reader.grid() for _ in range(reader.unpack("i"))]
    assert reader.at == len(reader.data)
    return grids
