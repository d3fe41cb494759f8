"""The still scene behind a fluid that moves through the picture, and how the fluid stands out from it."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from fluidlift.shape.evidence import Evidence


def still_background(
    evidence: Evidence, active: np.ndarray, domain: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """The picture behind the fluid, float32 [h,w,3], where it is known, bool [h,w], and a colour test of fluid.

    A pixel is taken before the fluid first reached it, or after it was last seen there. What looks more like the
    moving fluid than like the surroundings is not believed: a steady column of smoke is quiet too. The domain is
    extended, in place, over such quiet fluid where it touches the moving one.
    """
    frames = len(active)
    ever = active.any(axis=0)
    first = np.where(ever, active.argmax(axis=0), frames)
    last = np.where(ever, frames - 1 - active[::-1].argmax(axis=0), -1)
    total, count = np.zeros((*domain.shape, 3), np.float32), np.zeros(domain.shape, np.float32)
    for t in range(frames):
        free = ((t < first - 1) | (t > last + 1)).astype(np.float32)
        total += free[..., None] * evidence.pictures[t].astype(np.float32)
        count += free
    background = total / np.maximum(count, 1.0)[..., None]
    pick = np.unique(np.linspace(0, frames - 1, min(frames, 15)).round().astype(int))
    fluid = colour_histogram(evidence.pictures[pick][active[pick]])
    around = colour_histogram(evidence.pictures[pick][:, ~domain].reshape(-1, 3))

    def like_fluid(picture: np.ndarray) -> np.ndarray:
        bins = colour_bins(picture)
        return np.log((fluid[bins] + 1e-5) / (around[bins] + 1e-5))

    suspect = like_fluid(background) > np.log(2.0)
    alien = like_fluid(background) > np.log(20.0)
    parts = cv2.connectedComponents((domain | alien).astype(np.uint8), connectivity=4)[1]
    domain |= alien & np.isin(parts, np.unique(parts[domain]))
    return background, (count >= 3) & ~suspect, like_fluid


def typical_contrast(
    evidence: Evidence, active: np.ndarray, background: np.ndarray, known: np.ndarray
) -> tuple[float, float]:
    """Median difference between the moving fluid and what is behind it, grey levels, and its sign.

    The sign is +1 where the fluid is brighter than its background nearly everywhere, -1 where it is darker, else 0:
    with a clear sign, the opposite change is a shadow or a reflection of the fluid.
    """
    values = [
        (evidence.pictures[t].astype(np.float32) - background)[active[t] & known]
        for t in range(0, len(active), max(1, len(active) // 15))
    ]
    together = np.concatenate(values)
    if len(together) == 0:
        return 0.0, 0.0
    brightness = together[:, 0]
    bias = float(brightness.sum() / max(float(np.abs(brightness).sum()), 1e-6))
    return float(np.median(np.abs(together).sum(axis=-1))), float(np.sign(bias)) if abs(bias) > 0.7 else 0.0


def colour_bins(colours: np.ndarray, *, bins: int = 16) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index of each opponent colour [...,3] in a histogram of `bins` per axis."""
    scaled = np.asarray(colours, np.float32) / 256.0 + np.array([0.0, 0.5, 0.5], np.float32)
    index = np.clip((scaled * bins).astype(int), 0, bins - 1)
    return index[..., 0], index[..., 1], index[..., 2]


def colour_histogram(colours: np.ndarray, *, bins: int = 16) -> np.ndarray:
    """Smoothed density of opponent colours [n,3], float32 [bins,bins,bins]."""
    counts = np.zeros((bins, bins, bins), np.float32)
    np.add.at(counts, colour_bins(colours, bins=bins), 1.0)
    kernel = np.array([0.25, 0.5, 0.25], np.float32)
    for axis in range(3):
        counts = np.apply_along_axis(np.convolve, axis, counts, kernel, mode="same")
    return (counts / max(len(colours), 1)).astype(np.float32)
