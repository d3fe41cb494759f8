"""Interlaced video: two instants in one frame, on alternate rows. Whether it is there, and one instant of it.

What moves is combed then: each row differs from its neighbours and agrees with the rows one farther away. That is
seen in the pixels, for the flag in the file is often wrong in either direction.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8

MOVING = 12
"""grey levels between frames above which a pixel counts as moving"""
LEAST_MOVING = 200
"""moving pixels (in all) below which nothing can be told"""
COMBED = 1.2
"""ratio of curvature across neighbouring rows to that within a field. It is 1 for white noise, known to 5 % from
`LEAST_MOVING` pixels (this is four times that above), less for any picture that a lens has drawn (0.4 for texture of
1 px), and above for rows of two instants (1.27 where such texture moves by 2 px between them, 1.5 by 3 px)"""
ROWS_ALONE = 1.5
"""the same ratio over that of columns: noise and sharpening raise both, combing (3.4 and 3.9 there) that of rows. A
sharpened clip of a river has ratios of 1.09 and 0.78"""


def is_combed(pictures: Iterable[UInt8[np.ndarray, "h w 3"]]) -> bool | None:
    """Whether consecutive frames at full height are interlaced; None where too little moves to tell.

    Args:
        pictures: sRGB, as decoded, not scaled.
    """
    rows, columns = np.zeros(2), np.zeros(2)
    count, before = 0, None
    for picture in pictures:
        grey = picture[..., 1].astype(np.int16)  # green carries most of the brightness, at full resolution
        if before is not None and before.shape == grey.shape and min(grey.shape) > 4:
            moving = np.abs(grey - before) > MOVING
            rows += curvature(grey, moving)
            columns += curvature(grey.T, moving.T)
            count += int(moving.sum())
        before = grey
    if count < LEAST_MOVING or rows[1] <= 0 or columns[1] <= 0:
        return None
    combing = rows[0] / rows[1]
    return bool(combing > COMBED and combing > ROWS_ALONE * columns[0] / columns[1])


def curvature(grey: np.ndarray, where: np.ndarray) -> tuple[float, float]:
    """Sums of second differences down the columns of int16 [H,W], to the next rows and to those beyond them."""
    middle = slice(2, -2)
    near = np.abs(grey[1:-3] + grey[3:-1] - 2 * grey[middle])
    far = np.abs(grey[:-4] + grey[4:] - 2 * grey[middle])
    return float(near[where[middle]].sum()), float(far[where[middle]].sum())


def first_field(picture: np.ndarray) -> np.ndarray:
    """The rows of one instant: [ceil(H/2), W, ...], a view."""
    return picture[::2]
