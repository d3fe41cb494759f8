"""Pictures on surfaces."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8


def sample_texture(texture: UInt8[np.ndarray, "h w 3"], uv: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 3"]:
    """Bilinear colours in [0, 1] at texture coordinates from the upper left corner (0, 0) to the lower right (1, 1).

    Values lie in the middles of the texels; beyond the outermost ones the rim goes on.
    """
    height, width = texture.shape[:2]
    at = np.asarray(uv, np.float64) * (width, height) - 0.5
    at = np.clip(at, 0.0, (width - 1, height - 1))
    first = np.minimum(at.astype(np.int64), (max(width - 2, 0), max(height - 2, 0)))
    share = (at - first)[..., None, :]
    col, row = first[..., 0], first[..., 1]
    right, below = np.minimum(col + 1, width - 1), np.minimum(row + 1, height - 1)
    u, v = share[..., 0], share[..., 1]
    upper = (1 - u) * texture[row, col] + u * texture[row, right]
    lower = (1 - u) * texture[below, col] + u * texture[below, right]
    return (((1 - v) * upper + v * lower) / 255.0).astype(np.float32)
