"""OpenVDB files written with NumPy: float and vector grids of cubic voxels, ZIP-compressed, active voxels only.

PyPI has no OpenVDB. The format (file version 224) is simple where a grid has the standard tree (5, 4, 3): children of
the root of 4096 voxels a side, internal nodes of 128, leaves of 8. The centre of voxel (i, j, k) is at
translation + spacing (i, j, k).
"""

from __future__ import annotations

import hashlib
import struct
import uuid
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.io.atomic import atomic_write
from fluidlift.types import FaceVelocity, Grid

_FILE_VERSION, _LIBRARY_VERSION = 224, (10, 0)
_ZIP, _ACTIVE_MASK = 1, 2
_LEAF, _LOWER, _ROOT = 3, 7, 12
"""log2 of the voxels a side of a leaf, of an internal node of leaves, and of a child of the root"""


@dataclass(frozen=True)
class VolumeGrid:
    """One named grid for a VDB file."""

    name: str
    """density, vel, surface: the names that artists' tools know"""
    values: Float[np.ndarray, "nx ny nz *c"]
    """float [nx,ny,nz] or [nx,ny,nz,3]"""
    spacing: float
    """m"""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """low corner of voxel (0, 0, 0), m"""
    active: Bool[np.ndarray, "nx ny nz"] | None = None
    """voxels that are stored; None stores those that differ from the background"""
    first_index: tuple[int, int, int] = (0, 0, 0)
    """index that the file gives to voxel (0, 0, 0); may be negative; does not move the voxel"""
    grid_class: str = "fog volume"
    """"fog volume", "level set" or "unknown" (velocities)"""
    background: float = 0.0

    def __post_init__(self) -> None:
        v = self.values
        require(v.ndim == 3 or (v.ndim == 4 and v.shape[3] == 3), f"values {v.shape}", "[nx,ny,nz] or [nx,ny,nz,3]")
        require(bool(np.isfinite(v).all()), f"grid '{self.name}' with numbers that are not finite")
        require(self.active is None or self.active.shape == v.shape[:3], "a mask of another shape than the values")


def velocity_grid(
    velocity: FaceVelocity, grid: Grid, *, active: Bool[np.ndarray, "nx ny nz"] | None = None
) -> VolumeGrid:
    """The grid `vel` (m/s at cell centres) of a face velocity."""
    return VolumeGrid("vel", velocity.at_centers(), grid.spacing, grid.origin, active, grid_class="unknown")


def write_vdb(path: Path | str, grids: Sequence[VolumeGrid]) -> Path:
    """Write grids with different names into one VDB file; equal grids give equal files.

    Raises:
        InputRejected: the disk is full or may not be written.
    """
    require(len({g.name for g in grids}) == len(grids), "grids with the same name")
    with atomic_write(path) as file:
        file.write(struct.pack("<q3IB", 0x56444220, _FILE_VERSION, *_LIBRARY_VERSION, 1))
        file.write(str(_identity(grids)).encode())
        file.write(_metadata({"creator": "fluidlift"}))
        file.write(struct.pack("<i", len(grids)))
        for grid in grids:
            _write_grid(file, grid)
    return Path(path)


def _identity(grids: Sequence[VolumeGrid]) -> uuid.UUID:
    """The file's identifier, by which readers tell files apart: from what is in it."""
    digest = hashlib.sha256()
    for grid in grids:
        values = np.ascontiguousarray(grid.values, np.float32)
        active = b"" if grid.active is None else np.packbits(grid.active).tobytes()
        facts = (grid.name, grid.spacing, grid.origin, values.shape, grid.active is None)
        for part in (repr(facts).encode(), values.tobytes(), active):
            digest.update(part)
    return uuid.UUID(bytes=digest.digest()[:16], version=4)


def _write_grid(file: IO[bytes], grid: VolumeGrid) -> None:
    """Descriptor with the offsets of its parts, metadata, transform, topology, buffers."""
    vector = grid.values.ndim == 4
    leaves = _Leaves.of(grid)
    file.write(_string(grid.name) + _string(f"Tree_{'vec3s' if vector else 'float'}_5_4_3") + _string(""))
    offsets_at = file.tell()
    file.write(bytes(24))
    grid_at = file.tell()
    file.write(struct.pack("<I", _ZIP | _ACTIVE_MASK))
    low, high = leaves.bounds()
    facts = {
        "class": grid.grid_class,
        "name": grid.name,
        "file_bbox_min": low,
        "file_bbox_max": high,
        "file_compression": "zip + active values",
        "file_voxel_count": int(leaves.masks.sum()),
        "is_saved_as_half_float": False,
    }
    if vector:
        facts["vector_type"] = "contravariant relative"
    file.write(_metadata(facts))
    file.write(_transform(grid))
    background = np.full(3 if vector else 1, grid.background, "<f4").tobytes()
    file.write(struct.pack("<i", 1) + background)
    leaves.write_topology(file)
    blocks_at = file.tell()
    for mask, block in zip(leaves.masks, leaves.values):
        file.write(_bits(mask) + b"\0" + _zipped(block[mask]))
    end_at = file.tell()
    file.seek(offsets_at)
    file.write(struct.pack("<3q", grid_at, blocks_at, end_at))
    file.seek(end_at)


@dataclass(frozen=True)
class _Leaves:
    """The leaves that hold active voxels, in the order of the tree."""

    corners: np.ndarray
    """int64 [m,3], voxel index of the low corner"""
    masks: np.ndarray
    """bool [m,512]"""
    values: np.ndarray
    """float32 [m,512] or [m,512,3]"""

    @classmethod
    def of(cls, grid: VolumeGrid) -> _Leaves:
        """Cut the dense array into blocks of 8^3 at multiples of 8 of the file's indices, and drop the empty ones."""
        values = np.asarray(grid.values, np.float32)
        active = grid.active
        if active is None:
            differs = values != np.float32(grid.background)
            active = differs.any(axis=-1) if values.ndim == 4 else differs
        first = np.asarray(grid.first_index, np.int64)
        before = first % 8
        after = -(before + active.shape) % 8
        pad = list(zip(before, after))
        counts = (before + active.shape + after) // 8
        cut = [x for n in counts for x in (n, 8)]
        masks = np.pad(active, pad).reshape(cut).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 512)
        kept = np.flatnonzero(masks.any(axis=1))
        corners = np.stack(np.unravel_index(kept, counts), axis=-1) * 8 + (first - before)
        padded = np.pad(values, pad + [(0, 0)] * (values.ndim - 3))
        blocks = padded.reshape(*cut, *values.shape[3:])
        blocks = blocks.transpose(0, 2, 4, 1, 3, 5, *range(6, blocks.ndim)).reshape(-1, 512, *values.shape[3:])
        order = np.lexsort((_offset(corners, _LEAF, _LOWER), _offset(corners, _LOWER, _ROOT), *_root(corners).T[::-1]))
        return cls(corners[order], masks[kept[order]], blocks[kept[order]])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest index of active voxels."""
        if not len(self.corners):
            return np.zeros(3, np.int64), np.zeros(3, np.int64)
        m = self.masks.reshape(-1, 8, 8, 8)
        low, high = [], []
        for axis in range(3):
            line = np.any(m, axis=tuple(a + 1 for a in range(3) if a != axis))
            low.append((self.corners[:, axis] + line.argmax(axis=1)).min())
            high.append((self.corners[:, axis] + 7 - line[:, ::-1].argmax(axis=1)).max())
        return np.array(low), np.array(high)

    def write_topology(self, file: IO[bytes]) -> None:
        """Root, internal nodes (masks of children; no tiles) and the masks of the leaves, depth first."""
        roots, starts = np.unique(_root(self.corners), axis=0, return_index=True)
        file.write(struct.pack("<2I", 0, len(roots)))
        ends = [*starts[1:], len(self.corners)]
        for root, start, end in zip(roots, starts, ends):
            file.write(np.asarray(root, "<i4").tobytes())
            lower = _offset(self.corners[start:end], _LOWER, _ROOT)
            offsets, lower_starts = np.unique(lower, return_index=True)
            file.write(_node(offsets, 32**3))
            lower_ends = [*lower_starts[1:], end - start]
            for i, j in zip(lower_starts + start, np.asarray(lower_ends) + start):
                file.write(_node(_offset(self.corners[i:j], _LEAF, _LOWER), 16**3))
                for mask in self.masks[i:j]:
                    file.write(_bits(mask))


def _root(corners: np.ndarray) -> np.ndarray:
    return corners & ~(2**_ROOT - 1)


def _offset(corners: np.ndarray, child: int, parent: int) -> np.ndarray:
    """Place of each corner's child node in its parent's table, x slowest (also right for negative indices)."""
    i = (corners & (2**parent - 1)) >> child
    width = parent - child
    return (i[:, 0] << 2 * width) | (i[:, 1] << width) | i[:, 2]


def _node(children: np.ndarray, size: int) -> bytes:
    """An internal node: mask of children, empty mask of tiles, and no values."""
    mask = np.zeros(size, bool)
    mask[children] = True
    return _bits(mask) + bytes(size // 8) + b"\0" + _zipped(np.zeros(0, np.float32))


def _bits(mask: np.ndarray) -> bytes:
    return np.packbits(mask, bitorder="little").tobytes()


def _zipped(values: np.ndarray) -> bytes:
    """Length and zlib data; a negative length says that the bytes are as they were."""
    raw = np.ascontiguousarray(values, "<f4").tobytes()
    packed = zlib.compress(raw, 1)
    return struct.pack("<q", len(packed)) + packed if len(packed) < len(raw) else struct.pack("<q", -len(raw)) + raw


def _string(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def _metadata(items: dict[str, object]) -> bytes:
    out = struct.pack("<I", len(items))
    for name, value in items.items():
        if isinstance(value, bool):
            kind, data = "bool", struct.pack("<B", value)
        elif isinstance(value, int):
            kind, data = "int64", struct.pack("<q", value)
        elif isinstance(value, str):
            kind, data = "string", value.encode()
        else:
            kind, data = "vec3i", np.asarray(value, "<i4").tobytes()
        out += _string(name) + _string(kind) + struct.pack("<I", len(data)) + data
    return out


def _transform(grid: VolumeGrid) -> bytes:
    """Uniform scale, then translation to the centre of voxel index (0, 0, 0) of the file."""
    h = float(grid.spacing)
    translation = np.asarray(grid.origin, float) + h * (0.5 - np.asarray(grid.first_index, float))
    numbers = [translation, [h] * 3, [h] * 3, [1 / h] * 3, [1 / h**2] * 3, [0.5 / h] * 3]
    return _string("UniformScaleTranslateMap") + np.concatenate(numbers).astype("<f8").tobytes()
