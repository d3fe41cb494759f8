"""Similarities of the picture plane as matrices [2,3] that act on pixel indices (as cv2.warpAffine takes them)."""

from __future__ import annotations

import numpy as np


def composed(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The similarity [2,3] that does `first`, then `second`."""
    return np.hstack([second[:, :2] @ first[:, :2], (second[:, :2] @ first[:, 2] + second[:, 2])[:, None]])


def inverse(motion: np.ndarray) -> np.ndarray:
    """The similarity [2,3] that takes `motion` back."""
    back = np.linalg.inv(motion[:, :2])
    return np.hstack([back, -(back @ motion[:, 2])[:, None]])
