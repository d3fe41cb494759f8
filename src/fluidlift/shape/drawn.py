"""What a person drew on a frame, as pixels, and carried to the other frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.types import Label
from fluidlift.types.hints import Point, Region

LABELS = {
    "fluid": Label.FLUID, "not fluid": Label.BACKGROUND, "rock": Label.SOLID, "sky": Label.BACKGROUND,
    "ledge": Label.FLUID, "pool": Label.FLUID,
}  # fmt: skip
_SHIFT = 4
"""bits behind the point of the corners that OpenCV draws: a sixteenth of a pixel"""


def drawn_pixels(
    line: Sequence[Point], width: float | None, shape: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:  # fmt: skip
    """Pixels inside an area, or under a brush.

    Args:
        line: px, corners of the area or the way of the brush.
        width: px of the brush; None: an area.
        shape: rows and columns of the picture.
    """
    canvas = np.zeros(shape, np.uint8)
    # pixel (i, j) has its centre at (j + 0.5, i + 0.5), and at (j, i) for OpenCV; far corners would overflow there
    at = np.clip(np.asarray(line, float), -1e4, 1e5) - 0.5
    corners = np.round(at * 2**_SHIFT).astype(np.int32)
    if width is None:
        cv2.fillPoly(canvas, [corners], 1, lineType=cv2.LINE_8, shift=_SHIFT)
        return canvas > 0
    thick = max(1, round(width))
    if thick > 1:
        for x, y in corners:
            cv2.circle(canvas, (int(x), int(y)), round(0.5 * width * 2**_SHIFT), 1, -1, shift=_SHIFT)
    cv2.polylines(canvas, [corners], False, 1, thick, cv2.LINE_8, _SHIFT)
    return canvas > 0


def carried(
    mask: Bool[np.ndarray, "h w"], displacement: Float[np.ndarray, "t-1 h w 2"], begin: int
) -> Iterator[tuple[int, Bool[np.ndarray, "h w"]]]:
    """(frame, pixels) of what was drawn at one frame, taken along by the optical flow, for all frames.

    Each step looks up where a pixel was: forwards by the flow of the pair, backwards against it. What leaves the
    picture is gone.

    Args:
        mask: what was drawn.
        displacement: px per frame.
        begin: frame that it was drawn on.
    """
    height, width = mask.shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))

    def looked_up(now: np.ndarray, way: np.ndarray, sign: float) -> np.ndarray:
        step = sign * np.asarray(way, np.float32)
        # the motion of the fluid under the mask, carried out to where it goes: beyond its edge there may be none
        inside = now > 0.5
        mean = np.median(step[inside], axis=0) if inside.any() else np.zeros(2, np.float32)
        step = np.where(cv2.blur(now, (5, 5))[..., None] > 0.0, step, mean)
        return cv2.remap(now, columns + step[..., 0], rows + step[..., 1], cv2.INTER_LINEAR, borderValue=0.0)

    yield begin, mask
    now = mask.astype(np.float32)
    for t in range(begin + 1, len(displacement) + 1):
        now = looked_up(now, displacement[t - 1], -1.0)
        yield t, now > 0.5
    now = mask.astype(np.float32)
    for t in range(begin - 1, -1, -1):
        now = looked_up(now, displacement[t], 1.0)
        yield t, now > 0.5


def frame_at(times: Float[np.ndarray, " t"], time: float) -> int:
    """The frame that is shown at a time, s; the first or last one outside the clip's times."""
    return int(np.abs(np.asarray(times) - time).argmin())


def region_pixels(regions: Sequence[Region], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Pixels of all regions together."""
    found = np.zeros(shape, bool)
    for region in regions:
        found |= drawn_pixels(region.line, region.width, shape)
    return found
