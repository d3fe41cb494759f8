"""Homographies of the picture plane as matrices [3,3] that act on pixel indices (as cv2.warpPerspective takes them).

Those of a camera that turns about its own place are K R K^-1 (Hartley, Zisserman 2004, 8.4). With the *perspective*
q = 1 / focal^2 (1/px^2) they are the exponentials of

    [ zoom  -roll   x   ]
    [ roll   zoom   y   ]     a point moves by  (x, y) + zoom p + roll (-p_y, p_x) + q p (x p_x + y p_y),
    [ -q x  -q y    0   ]

p being its place from the middle of the picture. With q = 0 that is a similarity: of a lens as long as one likes, or of
a camera that slides before a plane.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float
from scipy.linalg import expm

from fluidlift.errors import require


def carried(motion: Float[np.ndarray, "3 3"], points: np.ndarray) -> np.ndarray:
    """Points [..., 2] where a homography brings them, float64."""
    places = np.asarray(points, np.float64) @ motion[:, :2].T + motion[:, 2]
    return places[..., :2] / places[..., 2:]


def turned(
    step: Float[np.ndarray, "4"], perspective: float, middle: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "3 3"]:
    """The homography of one turn.

    Args:
        step: shift x, y of the middle of the picture, px; zoom and roll (rad), about it.
        perspective: 1 over the focal length squared, 1/px^2; 0: a similarity.
        middle: of the picture, as a pixel index.
    """
    require(perspective >= 0.0, f"a perspective of {perspective}", "0 or more")
    x, y, zoom, roll = step
    there = np.array([[1.0, 0.0, middle[0]], [0.0, 1.0, middle[1]], [0.0, 0.0, 1.0]])
    back = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, 1.0]])
    rate = np.array([[zoom, -roll, x], [roll, zoom, y], [-perspective * x, -perspective * y, 0.0]])
    motion = there @ expm(rate) @ back
    return motion / motion[2, 2]


def turn_rates(places: Float[np.ndarray, "n 2"], perspective: float) -> Float[np.ndarray, "4 2 n"]:
    """By how much each part of a small `turned` step moves places (px from the middle of the picture) in x and in y."""
    x, y = places.T
    one, none = np.ones_like(x), np.zeros_like(x)
    bend = perspective * x * y
    return np.array([
        [one + perspective * x**2, bend], [bend, one + perspective * y**2], [x, y], [-y, x]
    ]) + none  # fmt: skip


def scaled(motion: Float[np.ndarray, "3 3"], scale: float) -> Float[np.ndarray, "3 3"]:
    """The same homography of pixel indices of pictures `scale` times as large (pixel centres lie at +0.5)."""
    offset = 0.5 * scale - 0.5
    larger = np.array([[scale, 0.0, offset], [0.0, scale, offset], [0.0, 0.0, 1.0]])
    motion = larger @ motion @ np.linalg.inv(larger)
    return motion / motion[2, 2]


def drawn_back(
    picture: np.ndarray,
    motion: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    *,
    interpolation: int,
    border: int | None = None,
) -> np.ndarray:
    """A picture carried back by a homography: what is at `motion(p)` comes to p.

    Args:
        picture: [H,W] or [H,W,C].
        motion: where the result's pixels lie in the picture.
        size: width and height of the result, px.
        interpolation: of OpenCV.
        border: what lies outside, of OpenCV; None: 0.
    """
    way, outside = interpolation | cv2.WARP_INVERSE_MAP, cv2.BORDER_CONSTANT if border is None else border
    if not motion[2, :2].any():  # a similarity or affine: faster, and the same
        return cv2.warpAffine(picture, motion[:2], size, flags=way, borderMode=outside)
    return cv2.warpPerspective(picture, motion, size, flags=way, borderMode=outside)
