"""One still picture, read with care, and resampling."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.atomic import write_bytes
from fluidlift.io.exr import read_channels
from fluidlift.io.limits import ReadLimits, require_file
from fluidlift.numerics.srgb import srgb_from_linear

PICTURE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".exr"})


def read_picture(path: Path | str, *, limits: ReadLimits | None = None) -> np.ndarray:
    """Samples as they are stored: [H,W], [H,W,3] or [H,W,4] in RGB(A) order, u8, u16 or float32 (linear light).

    Raises:
        InputRejected: no such file, not a picture, damaged, or more pixels than `limits.max_pixels`.
    """
    limits = limits or ReadLimits()
    path = require_file(path, "picture")
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise InputRejected(
            f"'{path.name}' is not a picture of a known kind", "one of " + ", ".join(sorted(PICTURE_SUFFIXES))
        )
    if path.suffix.lower() == ".exr":
        return _from_channels(path, read_channels(path, limits=limits))
    with path.open("rb") as file:
        size = _size_in_header(file.read(2**16))
    if size is not None:
        _require_pixels(path, size, limits)
    data = np.fromfile(path, np.uint8)  # imdecode takes any file name; imread does not on every system
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        picture = None
    if picture is None:
        raise InputRejected(f"'{path.name}' cannot be decoded", "an undamaged picture", "export it again")
    _require_pixels(path, picture.shape[1::-1], limits)
    if picture.ndim == 2:
        return picture
    order = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}.get(picture.shape[2])
    return cv2.cvtColor(picture, order) if order is not None else np.ascontiguousarray(picture[..., 0])


def _from_channels(path: Path, channels: dict[str, np.ndarray]) -> np.ndarray:
    """R, G, B (and A) of an OpenEXR file, or the one channel that it has."""
    if {"R", "G", "B"} <= channels.keys():
        return np.stack([channels[c] for c in "RGBA" if c in channels], axis=-1)
    for name in ("Y", "Z", "A", *channels):
        if name in channels:
            return channels[name]
    raise InputRejected(f"'{path.name}' has no channels", "R, G, B or Y")


def _require_pixels(path: Path, size: tuple[int, int], limits: ReadLimits) -> None:
    if size[0] * size[1] > limits.max_pixels:
        raise InputRejected(
            f"'{path.name}' is {size[0]} x {size[1]} pixels",
            f"at most {limits.max_pixels} pixels",
            "scale it down, or raise the limit with --set read.max_pixels=NUMBER",
        )


def _size_in_header(head: bytes) -> tuple[int, int] | None:
    """(width, height) of a PNG or JPEG before it is decoded; None for other kinds."""
    if head[:8] == b"\x89PNG\r\n\x1a\n" and len(head) >= 24:
        return struct.unpack(">II", head[16:24])
    if head[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(head) and head[at] == 0xFF:
        marker, length = head[at + 1], int.from_bytes(head[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", head[at + 5 : at + 9])
            return width, height
        at += 2 + length
    return None


def eight_bit(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """u8 [H,W,3] sRGB and, where there is one, u8 [H,W] alpha of what `read_picture` gives."""
    if picture.dtype == np.uint16:
        picture = np.round(picture / 257.0).astype(np.uint8)
    elif picture.dtype != np.uint8:
        light = np.clip(np.nan_to_num(picture), 0.0, 1.0)
        encoded = srgb_from_linear(light)
        if picture.ndim == 3 and picture.shape[2] == 4:
            encoded[..., 3] = light[..., 3]
        picture = np.round(255.0 * encoded).astype(np.uint8)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=-1)
    return np.ascontiguousarray(picture[..., :3]), picture[..., 3].copy() if picture.shape[2] == 4 else None


def fitted_size(size: tuple[int, int], max_size: int) -> tuple[int, int]:
    """(width, height) with the long side at most `max_size`, in the same aspect ratio; never larger."""
    scale = min(1.0, max_size / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def same_shape(source: tuple[int, int], target: tuple[int, int]) -> bool:
    """Whether pictures of these sizes (width, height) have the same aspect ratio, up to one pixel of rounding."""
    small, large = sorted((source, target), key=max)
    scale = max(small) / max(large)
    return all(abs(large[a] * scale - small[a]) <= 1.0 for a in (0, 1))


def resample(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Box (area) average when it gets smaller, linear when it gets larger; size is (width, height)."""
    h, w = picture.shape[:2]
    if (w, h) == size:
        return picture
    method = cv2.INTER_AREA if size[0] <= w and size[1] <= h else cv2.INTER_LINEAR
    return cv2.resize(picture, size, interpolation=method)


def resample_with_alpha(
    rgb: np.ndarray, alpha: np.ndarray | None, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray | None]:
    """The same for straight alpha: colours are weighted with it, so that nothing bleeds out of transparent pixels."""
    if alpha is None or rgb.shape[1::-1] == size:
        return resample(rgb, size), alpha
    weight = alpha.astype(np.float32) / 255.0
    small_weight = resample(weight, size)
    weighted = resample(rgb * weight[..., None], size) / np.maximum(small_weight, 1e-3)[..., None]
    mixed = np.where(small_weight[..., None] > 1e-3, weighted, resample(rgb, size))
    return np.round(np.clip(mixed, 0, 255)).astype(np.uint8), np.round(255 * small_weight).astype(np.uint8)


def write_png(path: Path | str, picture: np.ndarray) -> Path:
    """Write u8 or u16 [H,W], [H,W,3] (RGB) or [H,W,4] (RGBA), or bool [H,W] as 0/255, all at once."""
    picture = np.ascontiguousarray(picture)
    if picture.dtype == bool:
        picture = picture.astype(np.uint8) * 255
    if picture.dtype not in (np.uint8, np.uint16) or picture.ndim not in (2, 3):
        raise ValueError(f"a picture {picture.shape} {picture.dtype}; needed: u8, u16 or bool [H,W(,3|4)]")
    if picture.ndim == 3:
        order = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}[picture.shape[2]]
        picture = cv2.cvtColor(picture, order)
    ok, data = cv2.imencode(".png", picture)
    if not ok:
        raise ValueError(f"a picture {picture.shape} that cannot be encoded")
    return write_bytes(path, data.tobytes())
