"""Grain of a texture where it was not seen: random pieces of the seen one, blended so that they stay as lively.

A hole that is filled with evened-out colours reads as mud. What gravel or grass looks like is known beside it: its
deviations from the local mean are laid over the filling in pieces from random places. A plain mean of overlapping
pieces would lose contrast; a sum over the root of the squared weights keeps the variance of independent ones (Yu,
Neyret, Bruneton, Holzschuch 2011; Heitz and Neyret 2018).
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

PIECE = 0.05
"""of the map's longer side: width of a piece, some stones wide"""
SMALLEST = 8
"""texels, width of a piece"""
WHOLE = 0.5
"""share of a piece, by its weights, that must be of the source"""
FEWEST = 4
"""places that pieces can come from: with fewer one would see the same piece again and again"""
EXTREME = 2.5
"""standard deviations: a single bright speck would be strewn all over"""
HELD = 0.3
"""of the weights of a place: where pieces overlap by less, the grain is fainter"""


def grain(
    image: Float[np.ndarray, "h w 3"], mean: Float[np.ndarray, "h w 3"], source: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """What to add to evened-out colours everywhere; zeros where the source is too small to tell.

    Args:
        image: the texture, any unit.
        mean: the source's local mean.
        source: what was seen of the material.

    Returns:
        The same for the same arguments.
    """
    height, width = source.shape
    size = max(2 * round(0.5 * PIECE * max(height, width)), SMALLEST)
    if min(height, width) <= size or not source.any():
        return np.zeros(image.shape, np.float32)
    fine = np.where(source[..., None], image - mean, 0.0).astype(np.float32)
    bound = EXTREME * np.sqrt(np.square(fine[source]).mean(axis=0))
    fine = np.clip(fine, -bound, bound)
    bell = np.sin(np.pi * (np.arange(size, dtype=np.float32) + 0.5) / size) ** 2
    window = bell[:, None] * bell
    inside = source.astype(np.float32)
    full = cv2.filter2D(inside, -1, window / window.sum(), borderType=cv2.BORDER_CONSTANT)
    half = size // 2
    middles = np.argwhere(full[half : height - half, half : width - half] > WHOLE)
    if len(middles) < FEWEST * size:
        return np.zeros(image.shape, np.float32)
    rng = np.random.default_rng(0)
    # rows and columns beyond the map, cut off in the end
    out = np.zeros((height + 2 * size, width + 2 * size, 3), np.float32)
    squares = np.zeros(out.shape[:2], np.float32)
    for row in range(0, height + size, half):
        for column in range(0, width + size, half):
            i, j = middles[rng.integers(len(middles))]
            turned = slice(None, None, 1 if rng.random() < 0.5 else -1)
            weight = (window * inside[i : i + size, j : j + size])[:, turned]
            at = slice(row, row + size), slice(column, column + size)
            out[at] += weight[..., None] * fine[i : i + size, j : j + size][:, turned]
            squares[at] += weight**2
    out /= np.sqrt(np.maximum(squares, HELD**2))[..., None]
    return out[size : size + height, size : size + width]
