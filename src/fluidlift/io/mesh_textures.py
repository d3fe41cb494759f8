"""Colours of meshes of strangers: the materials of an OBJ and of a binary glTF, as one picture and vertex colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.limits import ReadLimits, require_file, require_size
from fluidlift.io.pictures import checked_header, eight_bit, fitted_size, picture_in, resample
from fluidlift.numerics.textures import sample_texture

MAX_SIDE = 4096
"""px of the one picture; larger ones are scaled down"""
MAX_REPEATS = 256
"""of a picture in a direction; what is repeated more often is too fine to be seen and becomes its mean"""
MAX_MATERIALS = 64
"""with a picture"""
MAX_PLAIN = 16 * MAX_MATERIALS
"""materials in all"""
MAX_PIXELS = 300_000_000
"""of all pictures of a mesh, before they are scaled down"""
_MAX_BYTES = 128 * 2**20
"""of a picture"""
_MAX_LIST = 4 * 2**20
"""bytes of a list of materials"""
_FLAT = 16
"""px of a material without a picture, beside others that have one"""
_SLACK = 1e-3
"""of texture coordinates beyond the edge: rounding, no repeat"""


@dataclass(frozen=True)
class Paint:
    """A material: its picture, or a colour where it has none."""

    color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    """sRGB, 0 to 1"""
    source: Path | memoryview | None = None
    """the file of its picture, or where it lies in the mesh's own; decoded only where the material is used"""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """factor of the picture, on its sRGB values: nearly that in linear light, as a power law's factor"""


class _Pictures:
    """The pictures of some materials, each decoded once, and kept no larger than it will be needed."""

    def __init__(self, paints: Sequence[Paint], side: int) -> None:
        sources = {paint.source for paint in paints if paint.source is not None}
        pixels = sum(_pixels_of(source) for source in sources)
        if pixels > MAX_PIXELS:
            raise ValueError(f"{len(sources)} pictures of {pixels} pixels in all; at most {MAX_PIXELS} are taken")
        self._side, self._decoded = side, dict[Path | memoryview, np.ndarray]()

    def of(self, paint: Paint) -> np.ndarray:
        """u8 [h,w,3] sRGB."""
        source = paint.source
        assert source is not None
        if source not in self._decoded:
            picture, _ = eight_bit(picture_in(_content(source), _name_of(source), ReadLimits()))
            self._decoded[source] = resample(picture, fitted_size(picture.shape[1::-1], self._side))
        return self._decoded[source]


def _content(source: Path | memoryview) -> bytes:
    if isinstance(source, memoryview):
        return bytes(source)
    require_size(source, _MAX_BYTES, "texture")
    return source.read_bytes()


def _name_of(source: Path | memoryview) -> str:
    return "a picture inside the mesh" if isinstance(source, memoryview) else source.name


def _pixels_of(source: Path | memoryview) -> int:
    """Before it is decoded; raises InputRejected for what is no picture, or too large."""
    data = _content(source if isinstance(source, memoryview) else require_file(source, "texture"))
    head = checked_header(data, _name_of(source), ReadLimits())
    return head.width * head.height


def one_picture(
    paints: Sequence[Paint], which: np.ndarray, uv: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """All pictures in one, below each other, and the texture coordinates [f,3,2] in it; nothing where none has one.

    Pictures that are repeated are repeated in it.

    Args:
        paints: materials.
        which: [f], the material of each triangle.
        uv: [f,3,2], (0, 0) is a picture's upper left corner; whole numbers more are the next repeat.

    Raises:
        InputRejected: a picture that is none, damaged, or too large.
        ValueError: coordinates that are not finite, more than `MAX_MATERIALS` materials with a picture, or more than
            `MAX_PIXELS`.
    """
    used: list[int] = np.unique(which).tolist()
    pictured = [k for k in used if paints[k].source is not None]
    if not pictured:
        return None, None
    if len(pictured) > MAX_MATERIALS:
        raise ValueError(f"{len(pictured)} pictures; at most {MAX_MATERIALS} are taken")
    if not np.isfinite(uv).all():
        raise ValueError("texture coordinates that are not finite")
    side = int(MAX_SIDE / max(1.0, len(pictured) ** 0.5))
    pictures = _Pictures([paints[k] for k in pictured], side)
    tiles, places = [], np.empty(uv.shape, np.float64)
    top = 0
    for k in used:
        mine = which == k
        tile, at = _tile(paints[k], pictures, uv[mine], side)
        height, width = tile.shape[:2]
        # half a pixel inside: what is between two pixels would take from the picture below
        places[mine] = np.clip(at * (width, height), 0.5, (width - 0.5, height - 0.5)) + (0, top)
        tiles.append(tile)
        top += height
    widest = max(t.shape[1] for t in tiles)
    whole = np.concatenate([np.pad(t, ((0, 0), (0, widest - t.shape[1]), (0, 0)), "edge") for t in tiles])
    fitted = resample(whole, (min(widest, MAX_SIDE), min(top, MAX_SIDE)))
    return fitted, (places / (widest, top)).astype(np.float32)


def _tile(paint: Paint, pictures: _Pictures, uv: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """A material's picture with its repeats, and coordinates in it, 0 to 1."""
    if paint.source is None:
        return _flat(255 * np.clip(paint.color, 0, 1)), np.full(uv.shape, 0.5)
    picture = pictures.of(paint)
    low = np.floor(uv.reshape(-1, 2).min(axis=0) + _SLACK)
    high = np.maximum(np.ceil(uv.reshape(-1, 2).max(axis=0) - _SLACK), low + 1)
    repeats = high - low
    if repeats.max() > MAX_REPEATS:
        return _flat(picture.reshape(-1, 3).mean(axis=0) * paint.tint), np.full(uv.shape, 0.5)
    nx, ny = (int(r) for r in repeats)
    height, width = picture.shape[:2]
    tile = resample(picture, (max(1, min(width, side // nx)), max(1, min(height, side // ny))))
    if min(paint.tint) < 1:
        tile = np.round(tile * np.array(paint.tint)).astype(np.uint8)
    return np.tile(tile, (ny, nx, 1)), (uv - low) / repeats


def _flat(color: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.round(color).astype(np.uint8), (_FLAT, _FLAT, 3))


def vertex_colors(count: int, faces: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """[count,3] means of what the corners [f,3,3] of the triangles at each vertex show; those of none are grey."""
    total, share = np.zeros((count, 3)), np.bincount(faces.ravel(), minlength=count)[:, None]
    for channel in range(3):
        total[:, channel] = np.bincount(faces.ravel(), corners[..., channel].ravel(), minlength=count)
    return np.where(share > 0, total / np.maximum(share, 1), 0.5).astype(np.float32)


def corner_colors(paints: Sequence[Paint], which: np.ndarray, uv: np.ndarray, texture: np.ndarray | None) -> np.ndarray:
    """[f,3,3] sRGB at the corners of triangles: of the one picture, or of plain materials."""
    if texture is not None:
        return sample_texture(texture, uv)
    plain = np.array([p.color for p in paints], np.float64).reshape(-1, 3)
    return np.repeat(plain[which][:, None], 3, axis=1)


def materials_of(folder: Path, name: str) -> dict[str, Paint]:
    """The materials of an .mtl file beside an OBJ by their names: `Kd` and `map_Kd`, both taken as sRGB.

    Nothing where there is no such file: an OBJ alone is a shape without colours. A picture is looked for under its
    name beside the OBJ or in folders below; a path that leads elsewhere is looked for by its last part.

    Raises:
        InputRejected: a picture that is not there.
        ValueError: more than `MAX_PLAIN` materials, or numbers that are none.
    """
    path = _beside(folder, name)
    if path is None:
        return {}
    require_size(path, _MAX_LIST, "list of materials")
    found: dict[str, Paint] = {}
    current = ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split()
        if len(words) < 2:
            continue
        if words[0] == "newmtl":
            current = line.split(None, 1)[1].strip()
            found[current] = Paint()
            if len(found) > MAX_PLAIN:
                raise ValueError(f"more than {MAX_PLAIN} materials")
        elif words[0] == "Kd" and current in found and len(words) >= 4:
            r, g, b = (float(w) for w in words[1:4])
            found[current] = Paint((r, g, b), found[current].source)
        elif words[0] == "map_Kd" and current in found:
            asked = words[-1] if words[1].startswith("-") else line.split(None, 1)[1].strip()
            picture = _beside(folder, asked)
            if picture is None:
                raise InputRejected(
                    f"'{path.name}' names the picture '{asked[:80]}', which is not beside it",
                    "all files of the mesh", "copy it there, or take the line map_Kd out",
                )  # fmt: skip
            found[current] = Paint(found[current].color, picture)
    return found


def _beside(folder: Path, name: str) -> Path | None:
    """The file of that name in a folder, or of its last part; never one that lies elsewhere."""
    for asked in (name, name.replace("\\", "/").rpartition("/")[2]):
        try:
            path = asset_file(folder, asked)
        except InputRejected:
            continue
        if path.is_file():
            return path
    return None
