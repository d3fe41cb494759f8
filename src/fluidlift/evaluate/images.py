"""Figures on pictures: motion, masks, likeness. Pure functions on arrays."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8
from scipy import ndimage

from fluidlift.errors import require

MOVING_PX = 0.1
"""px/frame: slower truth has no direction worth scoring"""


def resample_nearest(
    maps: Shaped[np.ndarray, "..."], size: tuple[int, int], axes: tuple[int, int] = (-2, -1)
) -> Shaped[np.ndarray, "..."]:
    """Maps on another pixel raster: each new pixel centre takes the old pixel that it lies in.

    Nothing is mixed across the edge of a mask. Displacements keep their old unit (scale them by new / old size).

    Args:
        maps: any array with two picture axes.
        size: new (width, height).
        axes: which axes are rows and columns.
    """
    out = maps
    for axis, new in ((axes[0], size[1]), (axes[1], size[0])):
        old = maps.shape[axis]
        if new != old:
            out = np.take(out, np.minimum(((np.arange(new) + 0.5) * old / new).astype(np.int64), old - 1), axis=axis)
    return out


def end_point_error(
    flow: Float[np.ndarray, "*t h w 2"], truth: Float[np.ndarray, "*t h w 2"], mask: Bool[np.ndarray, "*t h w"]
) -> float | None:
    """Mean length of the difference of two displacement fields (px/frame) over a mask; None where it is empty."""
    require(flow.shape == truth.shape, f"flow {flow.shape}", str(truth.shape))
    if not mask.any():
        return None
    return float(np.linalg.norm(flow[mask].astype(np.float64) - truth[mask], axis=-1).mean())


def end_point_percentile(
    flow: Float[np.ndarray, "*t h w 2"],
    truth: Float[np.ndarray, "*t h w 2"],
    mask: Bool[np.ndarray, "*t h w"],
) -> float | None:
    """The length (px/frame) that nine tenths of the differences stay below; None where the mask is empty."""
    require(flow.shape == truth.shape, f"flow {flow.shape}", str(truth.shape))
    if not mask.any():
        return None
    return float(np.percentile(np.linalg.norm(flow[mask].astype(np.float64) - truth[mask], axis=-1), 90.0))


def mean_cosine(
    flow: Float[np.ndarray, "*t h w 2"],
    truth: Float[np.ndarray, "*t h w 2"],
    mask: Bool[np.ndarray, "*t h w"],
) -> float | None:
    """Mean cosine of the angle between two fields where the truth exceeds `MOVING_PX`; a zero vector scores 0."""
    require(flow.shape == truth.shape, f"flow {flow.shape}", str(truth.shape))
    a, b = flow[mask].astype(np.float64), truth[mask].astype(np.float64)
    speed = np.linalg.norm(b, axis=-1)
    a, b, speed = a[speed > MOVING_PX], b[speed > MOVING_PX], speed[speed > MOVING_PX]
    if len(a) == 0:
        return None
    length = np.linalg.norm(a, axis=-1)
    return float(np.where(length > 0, (a * b).sum(-1) / np.maximum(length * speed, 1e-12), 0.0).mean())


def mask_iou(mask: Bool[np.ndarray, "*t h w"], truth: Bool[np.ndarray, "*t h w"]) -> Float[np.ndarray, "*t"]:
    """Intersection over union of each picture; 1 where both are empty."""
    require(mask.shape == truth.shape, f"mask {mask.shape}", str(truth.shape))
    both = (mask & truth).sum(axis=(-2, -1))
    either = (mask | truth).sum(axis=(-2, -1))
    return np.where(either > 0, both / np.maximum(either, 1), 1.0)


def psnr(image: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"], mask: np.ndarray | None = None) -> float:
    """Peak signal to noise ratio, dB, of 8-bit pictures, over a mask bool [H,W] if given; inf if they are equal."""
    require(image.shape == truth.shape, f"image {image.shape}", str(truth.shape))
    error = image.astype(np.float64) - truth
    if mask is not None:
        error = error[mask]
    mse = float((error**2).mean()) if error.size else float("nan")
    return float("inf") if mse == 0 else 10 * float(np.log10(255.0**2 / mse))


def ssim(image: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"]) -> float:
    """Structural similarity (Wang et al. 2004) of the luma: Gaussian window of 1.5 px, K1 = 0.01, K2 = 0.03."""
    require(image.shape == truth.shape, f"image {image.shape}", str(truth.shape))
    luma = np.array([0.299, 0.587, 0.114])
    x, y = image.astype(np.float64) @ luma, truth.astype(np.float64) @ luma

    def blur(a: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(a, 1.5, truncate=3.5)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    return float((((2 * mx * my + c1) * (2 * cov + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))).mean())


def depth_scale(
    depth: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> float | None:
    """truth metres per metre of `depth`: the median ratio over the mask where both are known; None where none is."""
    known = mask & np.isfinite(depth) & (depth > 0) & (truth > 0)
    return float(np.median(truth[known].astype(np.float64) / depth[known])) if known.any() else None


def depth_error(
    depth: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], scale: float
) -> tuple[float, float, float] | None:
    """Mean |scale depth - truth| in m; the same over the mean absolute deviation of the truth from its median; and the
    median of |scale depth - truth| / truth.

    The second figure is 1 for a flat picture (one depth everywhere) and 0 for a perfect relief.
    """
    known = mask & np.isfinite(depth) & (depth > 0) & (truth > 0)
    if not known.any():
        return None
    t = truth[known].astype(np.float64)
    off = np.abs(scale * depth[known] - t)
    error, relief = float(off.mean()), float(np.abs(t - np.median(t)).mean())
    return error, error / max(relief, 1e-9), float(np.median(off / t))
