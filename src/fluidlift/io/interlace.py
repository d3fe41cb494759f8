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
COMBED = 1.4
"""ratio of curvature across neighbouring rows to that within a field. It is 1 for white noise, less for any picture
that a lens has drawn, and well above for rows of two instants"""


def is_combed(pictures: Iterable[UInt8[np.ndarray, "h w 3"]]) -> bool | None:
    """Whether consecutive frames at full height are interlaced; None where too little moves to tell.

    Args:
        pictures: sRGB, as decoded, not scaled.
    """
    across = within = 0.0
    count, before = 0, None
    for picture in pictures:
        grey = picture[..., 1].astype(np.int16)  # green carries most of the brightness, at full resolution
        if before is not None and before.shape == grey.shape and len(grey) > 4:
            middle = slice(2, -2)
            moving = np.abs(grey - before)[middle] > MOVING
            near = np.abs(grey[1:-3] + grey[3:-1] - 2 * grey[middle])
            far = np.abs(grey[:-4] + grey[4:] - 2 * grey[middle])
            across += float(near[moving].sum())
            within += float(far[moving].sum())
            count += int(moving.sum())
        before = grey
    if count < LEAST_MOVING or within <= 0.0:
        return None
    return across > COMBED * within


def first_field(picture: np.ndarray) -> np.ndarray:
    """The rows of one instant: [ceil(H/2), W, ...], a view."""
    return picture[::2]
