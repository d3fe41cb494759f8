"""Sheets of pictures with a line of text above each, as small JPEG files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

GAP, LINE = 6, 20
"""px between tiles, and of the line of text above each"""
QUALITY = 85
"""of the JPEG files: a page of two dozen stays below 3 MB"""
FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True)
class Tile:
    """A picture and what it shows."""

    text: str
    picture: UInt8[np.ndarray, "h w 3"]
    """sRGB"""


def sheet(tiles: Sequence[Tile], columns: int, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """Tiles row by row on white, each `width` px wide; a row is as high as its highest tile."""
    rows = [tiles[k : k + columns] for k in range(0, len(tiles), columns)]
    return np.concatenate([_row(row, columns, width) for row in rows])


def _row(row: Sequence[Tile], columns: int, width: int) -> np.ndarray:
    fitted = [fit(t.picture, width) for t in row]
    height = max(p.shape[0] for p in fitted)
    out = np.full((LINE + height + GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for k, (tile, picture) in enumerate(zip(row, fitted, strict=True)):
        left = k * (width + GAP)
        out[LINE : LINE + picture.shape[0], left : left + width] = picture
        cv2.putText(out, tile.text, (left + 1, LINE - 6), FONT, 0.42, (40, 40, 40), 1, cv2.LINE_AA)
    return out


def fit(picture: UInt8[np.ndarray, "h w 3"], width: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Resampled to a width."""
    height, before = picture.shape[:2]
    size = (width, max(round(height * width / before), 1))
    how = cv2.INTER_AREA if width < before else cv2.INTER_CUBIC
    return cv2.resize(picture, size, interpolation=how)


def cut(picture: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
    """Rows and columns [y0, y1) x [x0, x1) of a picture."""
    y0, y1, x0, x1 = box
    return picture[y0:y1, x0:x1]


def framed(picture: UInt8[np.ndarray, "h w 3"], box: tuple[int, int, int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """A yellow frame around what a close-up shows."""
    y0, y1, x0, x1 = box
    return cv2.rectangle(picture.copy(), (x0, y0), (x1 - 1, y1 - 1), (255, 220, 0), 2)


def coloured(
    values: Float[np.ndarray, "h w"], top: float, *, ground: np.ndarray | None = None, times: int = 1
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """A field from 0 to `top` as colours, white where it is NaN and grey on `ground`; each value `times` px wide."""
    scaled = np.clip(np.nan_to_num(values) / max(top, 1e-12), 0, 1)
    colours = cv2.applyColorMap((255 * scaled).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    out = np.where(np.isnan(values)[..., None], np.uint8(255), colours)
    if ground is not None:
        out = np.where(ground[..., None], np.uint8(110), out)
    return np.ascontiguousarray(np.repeat(np.repeat(out, times, axis=0), times, axis=1))


def arrows(
    picture: UInt8[np.ndarray, "h w 3"],
    field: Float[np.ndarray, "h w 2"],
    where: np.ndarray,
    *,
    step: int,
    scale: float,
    times: int = 1,
    colour: tuple[int, int, int] = (255, 255, 255),
) -> UInt8[np.ndarray, "h w 3"]:
    """Arrows of a field (right, down) of every `step`-th value; `scale` px of the field per unit of it."""
    out = picture.copy()
    for y in range(step // 2, field.shape[0], step):
        for x in range(step // 2, field.shape[1], step):
            if not where[y, x]:
                continue
            a = times * (np.array([x, y]) + 0.5)
            b = a + times * scale * field[y, x]
            cv2.arrowedLine(out, _point(a), _point(b), colour, 1, cv2.LINE_AA, tipLength=0.3)
    return out


def _point(place: np.ndarray) -> tuple[int, int]:
    return int(round(place[0])), int(round(place[1]))


def flow_colours(flow: Float[np.ndarray, "h w 2"], mask: np.ndarray, top: float) -> UInt8[np.ndarray, "h w 3"]:
    """Hue is direction, strength is speed up to `top` px per frame; light grey outside the mask."""
    speed = np.hypot(flow[..., 0], flow[..., 1])
    hsv = np.stack([
        (np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) % 360) / 2, 255 * np.clip(speed / top, 0, 1),
        np.full(speed.shape, 255.0),
    ], axis=-1)  # fmt: skip
    colours = cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB)
    return np.where(mask[..., None], colours, np.uint8(215))


def save(path: Path, picture: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a JPEG, or a PNG by its name.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if path.suffix == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    if not cv2.imwrite(str(path), picture[..., ::-1], options):
        raise OSError(f"{path.name} cannot be written")
