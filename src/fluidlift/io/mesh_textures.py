"""Colours of meshes of strangers: the materials of an OBJ and of a binary glTF, as one picture and vertex colours."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.limits import require_size
from fluidlift.io.pictures import eight_bit, fitted_size, read_picture, resample
from fluidlift.numerics.textures import sample_texture

MAX_SIDE = 4096
"""px of the one picture; larger ones are scaled down"""
MAX_REPEATS = 256
"""of a picture in a direction; what is repeated more often is too fine to be seen and becomes its mean"""
MAX_MATERIALS = 64
"""with a picture"""
_MAX_BYTES = 128 * 2**20
"""of a picture or a list of materials"""
_FLAT = 16
"""px of a material without a picture, beside others that have one"""
_SLACK = 1e-3
"""of texture coordinates beyond the edge: rounding, no repeat"""


@dataclass(frozen=True)
class Paint:
    """A material: its picture, or a colour where it has none."""

    color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    """sRGB, 0 to 1"""
    picture: np.ndarray | None = None
    """u8 [h,w,3] sRGB"""


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
        ValueError: coordinates that are not finite, or more than `MAX_MATERIALS` materials with a picture.
    """
    used: list[int] = np.unique(which).tolist()
    pictured = [k for k in used if paints[k].picture is not None]
    if not pictured:
        return None, None
    if len(pictured) > MAX_MATERIALS:
        raise ValueError(f"{len(pictured)} pictures; at most {MAX_MATERIALS} are taken")
    if not np.isfinite(uv).all():
        raise ValueError("texture coordinates that are not finite")
    side = int(MAX_SIDE / max(1.0, len(pictured) ** 0.5))
    tiles, places = [], np.empty(uv.shape, np.float64)
    top = 0
    for k in used:
        mine = which == k
        tile, at = _tile(paints[k], uv[mine], side)
        height, width = tile.shape[:2]
        # half a pixel inside: what is between two pixels would take from the picture below
        places[mine] = np.clip(at * (width, height), 0.5, (width - 0.5, height - 0.5)) + (0, top)
        tiles.append(tile)
        top += height
    widest = max(t.shape[1] for t in tiles)
    whole = np.concatenate([np.pad(t, ((0, 0), (0, widest - t.shape[1]), (0, 0)), "edge") for t in tiles])
    fitted = resample(whole, (min(widest, MAX_SIDE), min(top, MAX_SIDE)))
    return fitted, (places / (widest, top)).astype(np.float32)


def _tile(paint: Paint, uv: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """A material's picture with its repeats, and coordinates in it, 0 to 1."""
    if paint.picture is None:
        return _flat(255 * np.clip(paint.color, 0, 1)), np.full(uv.shape, 0.5)
    low = np.floor(uv.reshape(-1, 2).min(axis=0) + _SLACK)
    high = np.maximum(np.ceil(uv.reshape(-1, 2).max(axis=0) - _SLACK), low + 1)
    repeats = high - low
    if repeats.max() > MAX_REPEATS:
        return _flat(paint.picture.reshape(-1, 3).mean(axis=0)), np.full(uv.shape, 0.5)
    nx, ny = (int(r) for r in repeats)
    height, width = paint.picture.shape[:2]
    size = (max(1, min(width, side // nx)), max(1, min(height, side // ny)))
    return np.tile(resample(paint.picture, size), (ny, nx, 1)), (uv - low) / repeats


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


def picture_file(path: Path) -> np.ndarray:
    """A picture as u8 [h,w,3], at most `MAX_SIDE` px.

    Raises:
        InputRejected: no picture, damaged, or too large.
    """
    require_size(path, _MAX_BYTES, "texture")
    picture, _ = eight_bit(read_picture(path))
    return resample(picture, fitted_size(picture.shape[1::-1], MAX_SIDE))


def picture_bytes(data: bytes, kind: str) -> np.ndarray:
    """The same of a picture inside another file; `kind` is its MIME type.

    Raises:
        ValueError: of another kind than PNG or JPEG.
    """
    suffix = {"image/png": ".png", "image/jpeg": ".jpg"}.get(kind)
    if suffix is None:
        raise ValueError(f"a texture of the kind '{str(kind)[:40]}'; PNG and JPEG are known")
    with tempfile.NamedTemporaryFile(suffix=suffix) as file:
        file.write(data)
        file.flush()
        return picture_file(Path(file.name))


def materials_of(folder: Path, name: str) -> dict[str, Paint]:
    """The materials of an .mtl file beside an OBJ by their names: `Kd` and `map_Kd`, both taken as sRGB.

    Nothing where there is no such file: an OBJ alone is a shape without colours. A picture is looked for under its
    name beside the OBJ or in folders below; a path that leads elsewhere is looked for by its last part.

    Raises:
        InputRejected: a picture that is not there, or none.
    """
    path = _beside(folder, name)
    if path is None:
        return {}
    require_size(path, _MAX_BYTES, "list of materials")
    found: dict[str, Paint] = {}
    current = ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split()
        if len(words) < 2:
            continue
        if words[0] == "newmtl":
            current = line.split(None, 1)[1].strip()
            found[current] = Paint()
        elif words[0] == "Kd" and current in found and len(words) >= 4:
            r, g, b = (float(w) for w in words[1:4])
            found[current] = Paint((r, g, b), found[current].picture)
        elif words[0] == "map_Kd" and current in found:
            asked = words[-1] if words[1].startswith("-") else line.split(None, 1)[1].strip()
            picture = _beside(folder, asked)
            if picture is None:
                raise InputRejected(
                    f"'{path.name}' names the picture '{asked[:80]}', which is not beside it",
                    "all files of the mesh", "copy it there, or take the line map_Kd out",
                )  # fmt: skip
            found[current] = Paint(found[current].color, picture_file(picture))
    return found


def _beside(folder: Path, name: str) -> Path | None:
    """The file of that name in a folder, or of its last part; never one that lies elsewhere."""
    from fluidlift.io.asset_paths import asset_file

    for asked in (name, name.replace("\\", "/").rpartition("/")[2]):
        try:
            path = asset_file(folder, asked)
        except InputRejected:
            continue
        if path.is_file():
            return path
    return None
