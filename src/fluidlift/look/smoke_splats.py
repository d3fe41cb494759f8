"""Smoke as splats: how wide and how opaque they are for all of them together to be as thin as what was filmed.

Splats share the optical depth of their line of sight out among them (Beer and Lambert): a splat of opacity a takes
-log(1 - a) of it at its middle, and less beside it as its Gaussian falls off. The same splats from another side have
the density that this means.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numba import njit
from scipy import ndimage

from fluidlift.look.surface_map import sampled

REACH = 2.5
"""standard deviations of a splat that count"""

TOGETHER = 5.0
"""splats that overlap at a place at least, about: with fewer the smoke is spotted"""

FINEST = 0.7
"""standard deviation of a splat at least, px: with what the rasteriser adds, 0.9 of a pixel"""

FAINTEST = 0.03
"""optical depth of a splat, about, that still is worth drawing: files keep opacities in 255 steps, and rasterisers draw
nothing below 1/255. Where there are more splats than it takes at this depth, some are left out for the others"""

DRAWN = 1 / 255
"""opacity of the least part of a splat that rasterisers draw (`numerics.splatting_projection.ALPHA_MIN`)"""

ROUNDS = 3
"""steps of the correction that brings the splats' sum to the film's depth"""

LEAST = 1e-3
"""optical depth from which a splat is corrected at least, for smoke to be seen where there was none at first"""

BLUR = 0.3
"""variance (px^2) that the rasteriser adds to each splat (`numerics.splatting_projection.BLUR`)"""


def drawn_splats(
    uv: Float[np.ndarray, "n 2"],
    widest: Float[np.ndarray, " n"],
    depth: Float[np.ndarray, "h w"],
    chance: Float[np.ndarray, " n"],
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Which splats are drawn, and their standard deviation, px: as many at a place as its optical depth takes, so wide
    that `TOGETHER` of them overlap. Beside the picture all are, as wide as they may be.

    Args:
        uv: where they are seen, px.
        widest: at most, px.
        depth: optical depth of each pixel, about.
        chance: 0 to 1, a number of each splat that stays the same over the frames: it says which are left out.
    """
    widest = np.maximum(widest, FINEST)
    at, beside = uv[:, ::-1] - 0.5, ~np.all((uv >= 0) & (uv <= np.array(depth.shape[::-1])), axis=1)
    if beside.all():
        return beside, widest
    here = sampled(np.asarray(depth, np.float32), at)
    overlap = 2.0 * np.pi * FINEST**2 * sampled(_crowd(uv, depth.shape, FINEST), at)
    drawn = beside | (chance * overlap < np.maximum(here / FAINTEST, TOGETHER))
    smooth = float(np.median(widest[~beside]))
    overlap = 2.0 * np.pi * np.square(widest) * sampled(_crowd(uv[drawn], depth.shape, smooth), at)
    found = np.clip(widest * np.sqrt(TOGETHER / np.maximum(overlap, 1e-6)), FINEST, widest)
    return drawn, np.where(beside, widest, found)


def _crowd(uv: np.ndarray, shape: tuple[int, ...], sigma: float) -> np.ndarray:
    """Splats per pixel, smooth."""
    cell = np.floor(uv).astype(np.int64)
    inside = ((cell >= 0) & (cell < np.array(shape[::-1]))).all(axis=1)
    count = np.bincount(cell[inside, 1] * shape[1] + cell[inside, 0], minlength=shape[0] * shape[1])
    return ndimage.gaussian_filter(count.reshape(shape).astype(np.float32), sigma, mode="constant")


def depth_of(
    uv: Float[np.ndarray, "n 2"], widths: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"],
    size: tuple[int, int],
) -> Float[np.ndarray, "h w"]:  # fmt: skip
    """Optical depth of a picture of splats, about: were they so many that none hides another.

    Args:
        uv: where they are seen, px.
        widths: their standard deviation, px.
        weight: optical depth at the middle of each.
        size: of the picture, px: width, height.
    """
    total = np.zeros((size[1], size[0]))
    _spread(uv, np.sqrt(np.square(widths) + BLUR), weight, total)
    return total


def shared_depth(
    uv: Float[np.ndarray, "n 2"],
    widths: Float[np.ndarray, " n"],
    depth: Float[np.ndarray, "h w"],
    first: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Optical depth at the middle of each splat, for all of them together to have that of a picture.

    A multiplicative correction (Richardson 1972, Lucy 1974), `ROUNDS` times: splats behind each other keep the
    proportion that they had. None is made denser than its own place is: what the picture shows beside them stays
    without. Splats beside the picture stay as they are.

    Args:
        uv: where they are seen, px.
        widths: their standard deviation, px.
        depth: optical depth of each pixel.
        first: optical depth of each splat to begin with.
    """
    size, drawn = (depth.shape[1], depth.shape[0]), np.sqrt(np.square(widths) + BLUR)
    weight, mean, at = np.maximum(first, LEAST), np.empty(len(uv)), uv[:, ::-1] - 0.5
    for _ in range(ROUNDS):
        total = depth_of(uv, widths, weight, size)
        _gathered(uv, drawn, depth / np.maximum(total, np.maximum(LEAST * depth, 1e-9)), mean)
        weight = np.where(mean >= 0, weight * mean, first)
        over = depth_of(uv, widths, weight, size) / np.maximum(depth, 1e-9)
        weight = np.where(mean >= 0, weight / np.maximum(sampled(over.astype(np.float32), at), 1.0), first)
    return weight


def opacity_of(weight: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Opacity of splats of an optical depth at their middle.

    A rasteriser draws nothing of a splat below `DRAWN`. Of one of opacity a that leaves a - `DRAWN` of its sum over the
    pixels (of a Gaussian in two dimensions), so as much is added; those under a quarter of it are left out.
    """
    return np.where(weight > 0.25 * DRAWN, DRAWN - np.expm1(-weight), 0.0)


@njit(cache=True, nogil=True)
def _falls_off(middle, sigma, size, out):
    """exp(-d^2 / 2 sigma^2) along one axis, at the middles of the pixels within `REACH` sigma of a place, into `out`;
    the first of them and the one after the last."""
    first = max(int(np.ceil(middle - REACH * sigma)), 0)
    end = min(int(np.floor(middle + REACH * sigma)), size - 1) + 1
    for k in range(first, end):
        out[k - first] = np.exp(-0.5 * ((k - middle) / sigma) ** 2)
    return first, end


@njit(cache=True, nogil=True)
def _spread(uv, sigma, weight, out):
    """Adds weight x exp(-d^2 / 2 sigma^2) of each splat to the middles of the pixels within `REACH` sigma."""
    height, width = out.shape
    across, down = np.empty(width), np.empty(height)
    for i in range(len(uv)):
        left, right = _falls_off(uv[i, 0] - 0.5, sigma[i], width, across)
        top, bottom = _falls_off(uv[i, 1] - 0.5, sigma[i], height, down)
        for r in range(top, bottom):
            part = weight[i] * down[r - top]
            for c in range(left, right):
                out[r, c] += part * across[c - left]


@njit(cache=True, nogil=True)
def _gathered(uv, sigma, field, out):
    """Mean of a field over each splat, with the weights of `_spread`; -1 beside the picture."""
    height, width = field.shape
    across, down = np.empty(width), np.empty(height)
    for i in range(len(uv)):
        left, right = _falls_off(uv[i, 0] - 0.5, sigma[i], width, across)
        top, bottom = _falls_off(uv[i, 1] - 0.5, sigma[i], height, down)
        total, weights = 0.0, 0.0
        for r in range(top, bottom):
            for c in range(left, right):
                part = down[r - top] * across[c - left]
                total += part * field[r, c]
                weights += part
        out[i] = total / weights if weights > 0.0 else -1.0
