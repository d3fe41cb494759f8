"""Edges of a picture that a stabilizer filled with the mirror image of what lies within.

Where a frame is moved to lie on the others, it leaves a strip of the picture uncovered. Stabilizers fill it with the
frame's own mirror image across its edge (FFmpeg's `deshake` does by default; OpenCV calls it `BORDER_REFLECT`). That
strip moves against everything else, so it looks like a stream of its own, and it shows nothing that is there.

A mirror is told by the match of the strip with its reflection in one line near the edge of the picture, and in that
line only: a smooth or striped picture matches its reflection in many. A bar, the frame of a window say, is its own
reflection in the line along its middle, so that what changes along the line has to match by itself as well.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

LONGEST = 320
"""px of the longer side at which edges are looked at: a strip of a fiftieth has six rows"""
GRAIN = 3.0
"""px there, standard deviation of the smoothing that is taken off: shading alone is alike on both sides of any line"""
NARROWEST, WIDEST = 0.02, 0.15
"""of the picture's extent across the edge: how wide a strip is; a narrower one has too few rows to compare, and
stabilizers crop or give up before a seventh"""
TILTS = np.arange(-4.0, 4.1, 1.0)
"""degrees between the edge of the moved frame and that of the picture: what a hand turns a camera by in a clip"""
FINER = 0.5
"""degrees to either side of the best of them, tried as well"""
MATCH = 0.8
"""2 a b / (a^2 + b^2) of a strip a and the reflection b, from which they are the same (1: equal, 0: not alike)"""
SHARP = 0.4
"""by which the match in every line `AWAY` px off and more is worse"""
AWAY = 3
FEWEST = 3
"""rows of a strip that are compared: fewer may be alike by chance"""
COLUMNS = 2
"""of which one is compared: neighbours say the same"""
PARTS = 4
"""along the edge, whose median counts: one thing before a plain wall may look like its reflection"""
LEAST = 2.0
"""grey levels, standard deviation of what is compared: less is noise of compression"""
BESIDE = 2
"""rows beyond the line that are given up as well: optical flow mixes both motions there"""
LOOKS = 9
"""frames of a clip that are looked at"""
OFTEN = 2
"""of them that show a mirror at the same edge, at least"""


def mirrored_edges(frames: UInt8[np.ndarray, "t h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that are a mirror image of what lies within, in some of the frames that are looked at, and those beside.

    Args:
        frames: sRGB.
    """
    height, width = frames.shape[1:3]
    scale = min(1.0, LONGEST / max(height, width))
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    found = np.zeros(size[::-1], bool)
    looked = np.unique(np.linspace(0, len(frames) - 1, min(LOOKS, len(frames))).astype(int))
    fine = [_fine(cv2.resize(frames[i], size, interpolation=cv2.INTER_AREA)) for i in looked]
    for turns in range(4):  # the edge that is looked at lies on top
        strips = [s for picture in fine if (s := _strip(np.rot90(picture, turns))) is not None]
        if len(strips) >= OFTEN:
            found |= np.rot90(np.any(strips, axis=0), -turns)
    return cv2.resize(found.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0


def _fine(picture: np.ndarray) -> np.ndarray:
    """Its brightness without the shading."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return grey - cv2.GaussianBlur(grey, (0, 0), GRAIN)


def _strip(picture: np.ndarray) -> np.ndarray | None:
    """Pixels of the strip at the top that mirrors what lies below it; None where there is none."""
    height, width = picture.shape
    rows = np.arange(max(round(NARROWEST * height), FEWEST + AWAY), round(WIDEST * height) + 1)
    if len(rows) == 0:
        return None
    found = [_best_line(picture, tilt, rows) for tilt in TILTS]
    middle = TILTS[int(np.argmax([match for match, _ in found]))]
    found += [_best_line(picture, middle + step, rows) for step in (-FINER, FINER)]
    n = int(np.argmax([match for match, _ in found]))
    if found[n][0] < MATCH:
        return None
    turn = _turn(picture, (*TILTS, middle - FINER, middle + FINER)[n])
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    return turn[1, 0] * column + turn[1, 1] * row + turn[1, 2] < found[n][1] + BESIDE


def _best_line(picture: np.ndarray, tilt: float, rows: np.ndarray) -> tuple[float, int]:
    """Match, and rows above the line, of the one line of a tilt in which the picture is mirrored; 0 where many are."""
    level, there = _turned(picture, _turn(picture, tilt), 2 * (int(rows[-1]) + AWAY))
    widths = np.arange(FEWEST, rows[-1] + AWAY + 1)
    found = _matches(level, there, widths)
    k = int(np.argmax(np.where(np.isin(widths, rows), found, -1.0)))
    others = np.abs(np.arange(len(found)) - k) >= AWAY
    if float(found[others].max()) >= float(found[k]) - SHARP:
        return 0.0, int(widths[k])
    along = _matches(_along(level, there), there, widths[k : k + 1])
    return float(min(found[k], along[0])), int(widths[k])


def _turn(picture: np.ndarray, tilt: float) -> np.ndarray:
    """[2, 3] about the middle of the upper edge, degrees."""
    return cv2.getRotationMatrix2D((0.5 * picture.shape[1] - 0.5, 0.0), float(tilt), 1.0)


def _turned(picture: np.ndarray, turn: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """The upper rows of a turned picture, and which pixels of them it covers; what is turned out above is left out."""
    size = picture.shape[1], rows
    picture = np.ascontiguousarray(picture)
    there = cv2.warpAffine(np.ones_like(picture), turn, size, flags=cv2.INTER_LINEAR) > 0.99
    return cv2.warpAffine(picture, turn, size, flags=cv2.INTER_LINEAR), there


def _starts(level: np.ndarray) -> np.ndarray:
    """First columns of the parts."""
    return np.arange(PARTS) * level.shape[1] // PARTS


def _along(level: np.ndarray, there: np.ndarray) -> np.ndarray:
    """What changes along the rows of each part."""
    starts = _starts(level)
    level = (level * there).astype(np.float32)
    mean = np.add.reduceat(level, starts, axis=1) / np.maximum(np.add.reduceat(there, starts, axis=1, dtype=float), 1.0)
    return level - np.repeat(mean, np.diff([*starts, level.shape[1]]), axis=1)


def _matches(level: np.ndarray, there: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Of as many upper rows as each width says with the reflection of those below them; -1 where nothing tells."""
    level, covered = (picture[:, ::COLUMNS].astype(np.float32) for picture in (level * there, there))
    square, starts = np.square(level), _starts(level)
    found = np.full((len(widths), PARTS), -1.0)

    def total(one: np.ndarray, other: np.ndarray, k: int) -> np.ndarray:
        return np.add.reduceat(np.einsum("ij,ij->j", one[:k], other[k : 2 * k][::-1]), starts)

    for n, k in enumerate(widths):
        count, alike = total(covered, covered, k), total(level, level, k)
        both = total(square, covered, k) + total(covered, square, k)
        lively = both > 2.0 * LEAST**2 * count
        found[n] = np.where(lively, 2.0 * alike / np.maximum(both, 1e-9), -1.0)
        found[n, count < 0.5 * k * level.shape[1] / PARTS] = np.nan  # more than half was turned out of the picture
    few = np.isfinite(found).sum(axis=1) < PARTS // 2
    return np.where(few, -1.0, np.nanmedian(np.where(few[:, None], -1.0, found), axis=1))
