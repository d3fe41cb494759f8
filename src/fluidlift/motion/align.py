"""Subpixel image registration (robust Gauss-Newton) on a reference, by all pixels of the part that stands still.

Features that are found again say roughly how a camera moved; in foam, foliage and compression each reading is off by up
to a pixel, more than a hand's tremble. The robust alignment of whole pictures (Odobez, Bouthemy 1995) takes it from
there: a similarity or a turn by Gauss-Newton on the grey levels, in which pixels that do not fit (the fluid) lose their
weight.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fluidlift.numerics.homography2 import drawn_back, scaled, turn_rates, turned

WORKING_SIZE = 256
"""px, longer side of the pictures that are laid on each other"""
LEAST_GRADIENT = 2.0
"""grey levels per px; flatter pixels do not tell where they are"""
NOISE = 4.0
"""grey levels by which a still thing may differ: camera noise, compression, a lamp. The scale of the weights starts
at that of the differences at hand and goes down to it"""
RIM = 8
"""px of the border left out: what came in from outside is made up there"""
CELLS = (8, 6)
"""columns and rows of the raster on which agreement is counted"""


def refined_similarity(
    reference: UInt8[np.ndarray, "h w"],
    picture: UInt8[np.ndarray, "h w"],
    guess: Float[np.ndarray, "2 3"],
) -> tuple[Float[np.ndarray, "2 3"], float, int]:
    """The similarity [2,3] that carries pixels of the reference to the picture: `refined_turn` without perspective."""
    start = np.vstack([np.asarray(guess, np.float64), [0.0, 0.0, 1.0]])
    motion, fit, cells = refined_turn(reference, picture, start)
    return motion[:2], fit, cells


def refined_turn(
    reference: UInt8[np.ndarray, "h w"],
    picture: UInt8[np.ndarray, "h w"],
    guess: Float[np.ndarray, "3 3"],
    *,
    perspective: float = 0.0,
    iterations: int = 15,
) -> tuple[Float[np.ndarray, "3 3"], float, int]:
    """The homography of a camera that turned, which carries pixels of the reference to the picture.

    Args:
        reference: grey.
        picture: grey.
        guess: a homography that is right to a pixel or two (of `WORKING_SIZE`).
        perspective: 1 over the focal length squared, 1/px^2; 0: a similarity is looked for.
        iterations: Gauss-Newton steps; the agreement is that before the last of them.

    Returns:
        the homography (on pixel indices); the part of the textured pixels that agree with it; and in how many of the
        `CELLS` a good part of the textured pixels agrees.
    """
    scale = min(1.0, WORKING_SIZE / max(reference.shape))
    size = (max(round(reference.shape[1] * scale), 3 * RIM), max(round(reference.shape[0] * scale), 3 * RIM))
    still, moved = _smoothed(reference, size), _smoothed(picture, size)
    motion = scaled(np.asarray(guess, np.float64), scale)
    middle, bend = 0.5 * np.array(size, np.float64), perspective / scale**2
    rows = slice(RIM, -RIM), slice(RIM, -RIM)
    x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) - c for n, c in zip(size, middle)))
    rates = turn_rates(np.stack([x[rows].ravel(), y[rows].ravel()], axis=-1), bend)
    rates[2:] /= WORKING_SIZE  # so that turning and scaling count in px, as shifting does
    jacobian = np.empty((rates.shape[2], 4))
    width, fits, textured = np.inf, np.zeros(0, bool), np.zeros(0, bool)
    for _ in range(iterations):
        gx, gy, difference = (a[rows].ravel() for a in _linearised(still, moved, motion, size))
        for k, (along_x, along_y) in enumerate(rates):
            jacobian[:, k] = gx * along_x + gy * along_y
        textured = gx**2 + gy**2 > LEAST_GRADIENT**2
        if textured.sum() < 100:
            return np.asarray(guess, np.float64), 0.0, 0
        spread = 1.4826 * float(np.median(np.abs(difference[textured])))
        width = max(NOISE, min(0.7 * width, spread))
        weight = textured / (1.0 + (difference / width) ** 2) ** 2  # Geman-McClure
        fits = textured & (np.abs(difference) < 2.0 * NOISE)
        weighted = jacobian * weight[:, None]
        step = -np.linalg.solve(weighted.T @ jacobian + 1e-3 * np.eye(4), weighted.T @ difference)
        motion = motion @ turned(step / [1.0, 1.0, WORKING_SIZE, WORKING_SIZE], bend, middle)
        motion /= motion[2, 2]
        if np.abs(step).max() < 0.005 and width <= NOISE:
            break
    return scaled(motion, 1.0 / scale), float(fits.sum() / textured.sum()), _cells(fits, textured, size)


def _cells(fits: np.ndarray, textured: np.ndarray, size: tuple[int, int]) -> int:
    """Cells of the raster in which at least half of the textured pixels fit, a tenth of all pixels being textured."""
    shape = (size[1] - 2 * RIM, size[0] - 2 * RIM)
    agree, present = (
        cv2.resize(m.reshape(shape).astype(np.float32), CELLS, interpolation=cv2.INTER_AREA) for m in (fits, textured)
    )
    return int(((present > 0.1) & (agree > 0.5 * present)).sum())


def _smoothed(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    small = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 1.0)


def _linearised(
    still: np.ndarray, moved: np.ndarray, motion: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradient of the picture carried back, and its difference from the reference without a common offset."""
    back = drawn_back(moved, motion, size, interpolation=cv2.INTER_LINEAR, border=cv2.BORDER_REPLICATE)
    gx, gy = (cv2.Sobel(back, cv2.CV_32F, dx, dy, scale=1 / 8) for dx, dy in ((1, 0), (0, 1)))
    error = back - still
    return gx, gy, error - np.median(error)
