"""One still picture, read with care, and resampling."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.atomic import write_bytes
from fluidlift.io.confined import read_confined
from fluidlift.io.exr import MAX_SIDE, channels_in
from fluidlift.io.limits import MAX_PIXEL_BYTES, ReadLimits, require_file, require_size
from fluidlift.io.picture_headers import PictureHeader, picture_header, require_whole_chunks
from fluidlift.numerics.srgb import srgb_from_linear

T = TypeVar("T")

PICTURE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".exr"})
MAX_BYTES = 2**30
"""of a file"""
_STRIP = 2**20
"""samples that are converted in one go"""


def read_picture(path: Path | str, *, limits: ReadLimits | None = None) -> np.ndarray:
    """Samples as they are stored: [H,W], [H,W,3] or [H,W,4] in RGB(A) order, u8, u16 or float32 (linear light).

    Raises:
        InputRejected: no such file, not a picture, damaged, or more than `limits` and `MAX_PIXEL_BYTES` let in; all
            of it before anything is decoded; or decoding takes more than `io.confined` lets it take.
    """
    return read_confined(_read_picture, require_file(path, "picture"), limits)


def _read_picture(path: Path, limits: ReadLimits) -> np.ndarray:
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise InputRejected(
            f"'{path.name}' is not a picture of a known kind", "one of " + ", ".join(sorted(PICTURE_SUFFIXES))
        )
    require_size(path, MAX_BYTES, "picture")
    return picture_in(path.read_bytes(), path.name, limits)


def picture_in(data: bytes, name: str, limits: ReadLimits) -> np.ndarray:
    """The picture in a file's bytes, as `read_picture` gives it; what it is is told by its content.

    Args:
        data: the whole file.
        name: of the file, for complaints.
        limits: on its pixels.

    Raises:
        InputRejected: as `read_picture`.
    """
    head = checked_header(data, name, limits)
    if head.kind == "OpenEXR":
        return _from_channels(name, channels_in(data, name, limits))
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        picture = None
    if picture is None:
        raise InputRejected(f"'{name}' cannot be decoded", "an undamaged picture", "export it again")
    if picture.ndim == 2:
        return picture
    order = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}.get(picture.shape[2])
    return cv2.cvtColor(picture, order) if order is not None else np.ascontiguousarray(picture[..., 0])


def checked_header(data: bytes, name: str, limits: ReadLimits) -> PictureHeader:
    """The header of a picture that may be decoded; raises as `read_picture`."""
    head = _undamaged(name, picture_header, data)
    size = head.width * head.height
    if max(head.width, head.height) > MAX_SIDE or size > limits.max_pixels:
        raise InputRejected(
            f"'{name}' is {head.width} x {head.height} pixels",
            f"at most {limits.max_pixels} pixels, and {MAX_SIDE} a side",
            "scale it down, or raise the limit with --set read.max_pixels=NUMBER",
        )
    if size * head.pixel_bytes > MAX_PIXEL_BYTES * limits.max_pixels:
        raise InputRejected(
            f"'{name}' has {head.pixel_bytes} bytes in each of its {size} pixels",
            f"at most {MAX_PIXEL_BYTES * limits.max_pixels} bytes", "export it with fewer channels, or smaller",
        )  # fmt: skip
    if head.kind == "PNG":
        _undamaged(name, require_whole_chunks, data)
    return head


def _undamaged(name: str, read: Callable[[bytes], T], data: bytes) -> T:
    """What is read; raises `InputRejected` where that is damaged."""
    try:
        return read(data)
    except ValueError as error:
        raise InputRejected(
            f"'{name}' cannot be decoded ({error})", "an undamaged picture", "export it again"
        ) from None


def _from_channels(name: str, channels: dict[str, np.ndarray]) -> np.ndarray:
    """R, G, B (and A) of an OpenEXR file, or the one channel that it has."""
    if {"R", "G", "B"} <= channels.keys():
        names = [c for c in "RGBA" if c in channels]
        picture = np.empty((*channels["R"].shape, len(names)), np.float32)
        for k, c in enumerate(names):
            picture[..., k] = channels.pop(c)  # one of them in memory twice, not all
        return picture
    for channel in ("Y", "Z", "A", *channels):
        if channel in channels:
            return channels[channel]
    raise InputRejected(f"'{name}' has no channels", "R, G, B or Y")


def eight_bit(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """u8 [H,W,3] sRGB and, where there is one, u8 [H,W] alpha of what `read_picture` gives."""
    if picture.dtype != np.uint8:
        encoded = np.empty(picture.shape, np.uint8)
        rows = max(1, _STRIP // max(1, picture[:1].size))
        for first in range(0, len(picture), rows):  # at once it would take ten times the memory of the picture
            encoded[first : first + rows] = _encoded(picture[first : first + rows])
        picture = encoded
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=-1)
    return np.ascontiguousarray(picture[..., :3]), picture[..., 3].copy() if picture.shape[2] == 4 else None


def _encoded(picture: np.ndarray) -> np.ndarray:
    """u8 of u16 samples, or of linear light."""
    if picture.dtype == np.uint16:
        return np.round(picture / 257.0).astype(np.uint8)
    light = np.clip(np.nan_to_num(picture), 0.0, 1.0)
    encoded = srgb_from_linear(light)
    if picture.ndim == 3 and picture.shape[2] == 4:
        encoded[..., 3] = light[..., 3]
    return np.round(255.0 * encoded).astype(np.uint8)


def fitted_size(size: tuple[int, int], max_size: int) -> tuple[int, int]:
    """(width, height) with the long side at most `max_size`, in the same aspect ratio; never larger."""
    scale = min(1.0, max_size / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def same_shape(source: tuple[int, int], target: tuple[int, int]) -> bool:
    """Whether pictures of these sizes (width, height) have the same aspect ratio, up to one pixel of rounding; what has
    no pixels has none."""
    small, large = sorted((source, target), key=max)
    scale = max(small) / max(large)
    return min(small) > 0 and all(abs(large[a] * scale - small[a]) <= 1.0 for a in (0, 1))


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
