"""Equirectangular pictures, blurred on the sphere by a lobe that depends only on the angle.

Rows keep their distance from the pole, so along the columns such a blur is a circular convolution: a Fourier transform
of each pair of rows does it exactly, with no samples drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from fluidlift.look.environment_lookup import grid_directions, lookup

Lobe = Callable[[np.ndarray], np.ndarray]
"""weight of light that comes at an angle, from the cosine of that angle"""


def clamped_cosine(cosine: np.ndarray) -> np.ndarray:
    """Lambert's: what a diffuse surface gathers."""
    return np.maximum(cosine, 0.0)


def ggx_lobe(roughness: float) -> Lobe:
    """What a GGX mirror (alpha = roughness squared) gathers around its reflected ray, seen straight from above.

    With viewer, normal and reflected ray in one direction the half vector lies at half the angle: the light at angle t
    counts D(t / 2) cos t (Karis 2013), where D is the distribution of Walter et al. 2007 up to a factor.
    """
    alpha2 = max(roughness, 1e-3) ** 4

    def lobe(cosine: np.ndarray) -> np.ndarray:
        spread = alpha2 * 0.5 * (1.0 + cosine) + 0.5 * (1.0 - cosine)
        return np.maximum(cosine, 0.0) * (alpha2 / spread) ** 2

    return lobe


def solid_angles(rows: int) -> Float[np.ndarray, " h"]:
    """sr of a pixel of each row of an equirectangular picture, exactly."""
    edges = np.cos(np.arange(rows + 1) * math.pi / rows)
    return (edges[:-1] - edges[1:]) * math.pi / rows


def resized(picture: Float[np.ndarray, "h 2*h 3"], rows: int) -> Float[np.ndarray, "rows 2*rows 3"]:
    """The picture with another number of rows, float32: a smaller one keeps the light of every region."""
    h = len(picture)
    if h == rows:
        return picture
    if h < rows:
        return lookup(picture, grid_directions(rows))
    if h % rows == 0:  # whole blocks: the same, without copies in double precision
        k = h // rows
        across = picture.reshape(h, 2 * rows, k, 3).mean(axis=2)
        weights = solid_angles(h).reshape(rows, k).astype(np.float32)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.einsum("rkwc,rk->rwc", across.reshape(rows, k, 2 * rows, 3), weights)
    across = np.asarray(_averaged(picture.swapaxes(0, 1), 2 * rows, np.ones(2 * h)), np.float32).swapaxes(0, 1)
    return np.ascontiguousarray(_averaged(across, rows, solid_angles(h)), np.float32)


def _averaged(values: np.ndarray, count: int, weights: np.ndarray) -> np.ndarray:
    """Weighted means over `count` equal parts of the first axis; a value that lies in two parts is shared."""
    n = len(values)
    edges = np.arange(count + 1) * (n / count)
    whole = np.minimum(edges.astype(int), n - 1)
    part = edges - whole

    def up_to(v: np.ndarray) -> np.ndarray:
        total = np.concatenate([np.zeros((1, *v.shape[1:])), np.cumsum(v, axis=0, dtype=np.float64)])
        return total[whole] + part.reshape(-1, *[1] * (v.ndim - 1)) * v[whole]

    weighted = np.diff(up_to(values * weights.reshape(-1, *[1] * (values.ndim - 1))), axis=0)
    return np.maximum(weighted, 0.0) / np.diff(up_to(weights)).reshape(-1, *[1] * (values.ndim - 1))


def convolved(picture: Float[np.ndarray, "h 2*h 3"], lobe: Lobe) -> Float[np.ndarray, "h 2*h 3"]:
    """Weighted mean of the picture around every direction, float32; a constant picture stays exactly as it is."""
    h, w = picture.shape[:2]
    light = np.fft.rfft(picture, axis=1)
    polar = (np.arange(h) + 0.5) * math.pi / h
    cos, sin, turn = np.cos(polar), np.sin(polar), np.cos(np.arange(w) * 2 * math.pi / w)
    weight = solid_angles(h)[:, None]
    out = np.empty(picture.shape, np.float32)
    for row in range((h + 1) // 2):
        kernel = lobe(np.clip(cos[row] * cos[:, None] + sin[row] * sin[:, None] * turn, -1.0, 1.0)) * weight
        kernel /= kernel.sum()
        spectrum = np.fft.rfft(kernel, axis=1)[..., None]
        # the row as far from the other pole meets the same lobe upside down
        for at, met in ((row, light), (h - 1 - row, light[::-1])):
            out[at] = np.fft.irfft((spectrum * met).sum(axis=0), n=w, axis=0)
    return np.maximum(out, 0.0)
