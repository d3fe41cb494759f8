"""Grain out of path-traced pictures, as far as the paths themselves tell what is grain."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.errors import require

REACH = 5
"""px, half width of the window in which alike pixels are looked for"""
PATCH = 3
"""px, width of what is compared"""
STRENGTH = 0.55
"""standard deviations that pixels may differ by before they count as different"""
SPARK = 4.0
"""times the light of its surroundings from which a part's pixel is a spark: a path that met a light by rare chance"""


def without_sparks(parts: Float[np.ndarray, "k h w 3"]) -> Float[np.ndarray, "k h w 3"]:
    """Each part's pixels cut to `SPARK` times what is usual there: the median, over all parts, of the 3 x 3 pixels
    around, or their mean where that is more. A highlight that is there in every part stays; some light is lost.

    Args:
        parts: pictures of the same view from paths of their own, linear.
    """
    lightness = parts.mean(axis=-1)
    usual = ndimage.median_filter(np.median(lightness, axis=0), size=3, mode="nearest")
    # the mean without the brightest part: one spark must not excuse itself
    rest = (lightness.sum(axis=0) - lightness.max(axis=0)) / max(len(parts) - 1, 1)
    limit = SPARK * np.maximum(usual, ndimage.median_filter(rest, size=3, mode="nearest")) + 1e-4
    return parts * np.minimum(1.0, limit / np.maximum(lightness, 1e-12))[..., None]


def denoised(parts: Float[np.ndarray, "k h w c"]) -> Float[np.ndarray, "h w c"]:
    """The mean of parts of a picture with less grain.

    Non-local means with the variance of the pixels (Rousselle, Knaus and Zwicker 2012, Adaptive rendering with
    non-local means filtering): every half of the parts is averaged over pixels that look alike in the other half, so
    that grain does not choose itself. Where the parts agree, nothing changes.

    Args:
        parts: at least 4 pictures of the same view from paths of their own, linear.

    Raises:
        ValueError: fewer.
    """
    require(len(parts) >= 4, f"{len(parts)} parts of a picture", "at least 4")
    half = len(parts) // 2
    ways = []
    for some in (parts[:half], parts[half:]):
        ways.append((some.mean(axis=0).astype(np.float32), (some.var(axis=0, ddof=1) / len(some)).astype(np.float32)))
    # from few parts each variance is itself grain
    variances = [ndimage.uniform_filter(v, (3, 3, 0), mode="nearest") for _, v in ways]
    images = [i for i, _ in ways]
    out = [_averaged(images[1 - k], images[k], variances[k]) for k in (0, 1)]
    first, second = len(parts) - half, half
    return ((first * out[0] + second * out[1]) / len(parts)).astype(np.float32)


def _averaged(image: np.ndarray, guide: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """`image` averaged over pixels whose surroundings in `guide` differ by no more than its variance explains."""
    height, width = image.shape[:2]
    r = REACH
    wide = [np.pad(a, ((r, r), (r, r), (0, 0)), mode="reflect" if min(height, width) > r else "edge")
            for a in (image, guide, variance)]  # fmt: skip
    total, weights = np.zeros_like(image), np.zeros((height, width, 1), np.float32)
    for dy in range(2 * r + 1):
        for dx in range(2 * r + 1):
            at = np.s_[dy : dy + height, dx : dx + width]
            other, seen, noise = (a[at] for a in wide)
            both = variance + noise
            apart = ((guide - seen) ** 2 - (variance + np.minimum(variance, noise))) / (1e-8 + STRENGTH**2 * both)
            apart = ndimage.uniform_filter(apart.mean(axis=-1), PATCH, mode="nearest")
            weight = np.exp(-np.maximum(apart, 0.0))[..., None]
            total += weight * other
            weights += weight
    return total / weights
