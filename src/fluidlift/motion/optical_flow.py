"""Optical flow between neighbouring frames (paper: V_2D), how far to trust it, and its mean over steady motion.

Flow fails where the picture is smooth: it then returns something near zero, or what its smoothness term makes up.
Two tests, both soft, find such places without any knowledge of the scene: following the flow forward and then
backward must lead home (Sundaram, Brox, Keutzer 2010), and there must be texture to follow in every direction
(smaller eigenvalue of the structure tensor; Shi, Tomasi 1994).
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.errors import require
from fluidlift.seams import FlowEstimator
from fluidlift.types import PixelFlow

Progress = Callable[[int, int], None]
"""called with (steps done, steps in all)"""

ROUND_TRIP_FLOOR = 0.3
"""px: forward-backward error that even good flow shows (noise, compression)"""
ROUND_TRIP_SHARE = 0.2
"""part of the motion by which forward and backward flow may disagree: a fluid deforms within a frame"""
TEXTURE_FLOOR = 1.5
"""grey levels per px: gradients of this size are compression and camera noise"""
TEXTURE_WINDOW = 15
"""px, side of the window in which texture is gathered; about the patch that the estimators look at"""


class DenseInverseSearch(FlowEstimator):
    """Dense inverse search with variational refinement (Kroeger et al. 2016).

    OpenCV's medium preset stops at half resolution; eddies are small, so the search goes on to full resolution with
    denser patches (about 10 % less end-point error on simulated rivers and honey).
    """

    def __init__(self) -> None:
        self._algorithm = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._algorithm.setFinestScale(0)
        self._algorithm.setPatchStride(3)

    def displacement(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """float32 [H,W,2], px: where each pixel of `first` (u8 [H,W,3] or grey [H,W]) went in `second`."""
        return self._algorithm.calc(_grey(first), _grey(second), None)


class Farneback(FlowEstimator):
    """Polynomial expansion (Farneback 2003), the estimator that the paper names."""

    def displacement(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """float32 [H,W,2], px: where each pixel of `first` (u8 [H,W,3] or grey [H,W]) went in `second`."""
        return cv2.calcOpticalFlowFarneback(
            _grey(first), _grey(second), None, 0.5, 5, 21, 5, 5, 1.1, cv2.OPTFLOW_FARNEBACK_GAUSSIAN
        )


ESTIMATORS: dict[str, type[FlowEstimator]] = {"dis": DenseInverseSearch, "farneback": Farneback}


def estimate_flow(
    frames: UInt8[np.ndarray, "t h w 3"],
    *,
    method: str | FlowEstimator = "dis",
    progress: Progress | None = None,
) -> PixelFlow:
    """Forward flow of every neighbouring pair with its confidence.

    Args:
        frames: sRGB.
        method: "dis", "farneback", or an estimator of one's own.
        progress: called after each pair.

    Returns:
        displacement float32 [T-1,H,W,2] px/frame, confidence float16 [T-1,H,W]. Beyond the result, memory is that of
        a few pictures.

    Raises:
        ValueError: fewer than two frames, frames of the wrong type, or an unknown method.
    """
    frames = np.asarray(frames)
    require(
        frames.ndim == 4 and frames.shape[-1] == 3 and frames.dtype == np.uint8,
        f"frames {frames.shape} {frames.dtype}",
        "u8 [T,H,W,3]",
    )
    require(len(frames) >= 2, f"{len(frames)} frame", "at least two")
    if isinstance(method, FlowEstimator):
        estimator = method
    else:
        require(method in ESTIMATORS, f"flow method '{method}'", "one of " + ", ".join(ESTIMATORS))
        estimator = ESTIMATORS[method]()
    pairs, (h, w) = len(frames) - 1, frames.shape[1:3]
    displacement = np.empty((pairs, h, w, 2), np.float32)
    confidence = np.empty((pairs, h, w), np.float16)
    for t in range(pairs):
        forward = estimator.displacement(frames[t], frames[t + 1])
        backward = estimator.displacement(frames[t + 1], frames[t])
        displacement[t] = np.nan_to_num(forward, nan=0.0, posinf=0.0, neginf=0.0)
        confidence[t] = flow_confidence(frames[t], displacement[t], backward)
        if progress is not None:
            progress(t + 1, pairs)
    return PixelFlow(displacement, confidence)


def flow_confidence(
    first: UInt8[np.ndarray, "h w 3"],
    forward: Float[np.ndarray, "h w 2"],
    backward: Float[np.ndarray, "h w 2"],
) -> Float[np.ndarray, "h w"]:
    """Trust in `forward`, float32 from 0 (failed) to 1.

    The product of two terms of the form 1 / (1 + error^2 / tolerance^2): the round trip error against a tolerance
    that grows with the motion, and noise against the texture at hand. Flow that leaves the picture has confidence 0.
    """
    h, w = forward.shape[:2]
    u, v = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    u, v = u + forward[..., 0], v + forward[..., 1]
    back = cv2.remap(np.ascontiguousarray(backward), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    error = ((forward + back) ** 2).sum(axis=-1)
    tolerance = ROUND_TRIP_FLOOR**2 + ROUND_TRIP_SHARE**2 * (forward**2).sum(axis=-1)
    texture = texture_strength(first) ** 2
    inside = (u >= -0.5) & (u <= w - 0.5) & (v >= -0.5) & (v <= h - 0.5)
    return (inside * tolerance / (tolerance + error) * texture / (texture + TEXTURE_FLOOR**2)).astype(np.float32)


def texture_strength(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Root mean square gradient in the direction with least texture, grey levels per px, float32.

    It is the root of the smaller eigenvalue of the structure tensor over `TEXTURE_WINDOW`; an edge without texture
    along it counts as nothing (aperture problem).
    """
    grey = cv2.GaussianBlur(_grey(image), (0, 0), 1.0).astype(np.float32)
    gx = cv2.Scharr(grey, cv2.CV_32F, 1, 0, scale=1 / 32)
    gy = cv2.Scharr(grey, cv2.CV_32F, 0, 1, scale=1 / 32)
    side = (TEXTURE_WINDOW, TEXTURE_WINDOW)
    xx, yy, xy = (cv2.boxFilter(p, cv2.CV_32F, side) for p in (gx * gx, gy * gy, gx * gy))
    smaller = 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4 * xy**2))
    return np.sqrt(np.maximum(smaller, 0.0))


def mean_flow(
    flow: PixelFlow,
    mask: Bool[np.ndarray, "*t h w"] | None = None,
    *,
    trim: float = 2.5,
    evidence: float = 0.5,
) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
    """The mean motion of a steady fluid over all pairs of `flow`, robust against failures of single frames.

    The mean at a pixel is weighted with confidence; then frames further than `trim` times the pixel's own spread from
    it are left out, and the mean is taken once more. Spread, and not a fixed distance, decides: real fluctuation
    widens the spread and stays in, so a turbulent mean is not dragged to its mode.

    Args:
        flow: the window of frames.
        mask: the fluid [H,W] or [T',H,W] with T' at least the number of pairs; where absent the pixel counts nothing.
        trim: in standard deviations.
        evidence: sum of confidences at which the mean deserves a confidence of one half. A pixel that is textured in
            a few frames only, as foam passes, is known from those frames.

    Returns:
        displacement float32 [H,W,2] px/frame and confidence float32 [H,W]: that of the frames which count, lowered
        where they add up to little evidence and where the standard error of the mean is large.
    """
    d = flow.displacement
    weight = flow.confidence.astype(np.float32)
    if mask is not None:
        mask = np.asarray(mask, bool)
        weight = weight * (mask[: len(d)] if mask.ndim == 3 else mask[None])
    # failures are many and alike (near zero motion): squaring keeps a crowd of them from outvoting good frames
    weight **= 2
    mean = _weighted_mean(d, weight)
    for _ in range(2):
        distance = ((d - mean) ** 2).sum(axis=-1)
        total = np.maximum(weight.sum(axis=0), 1e-6)
        spread = (weight * distance).sum(axis=0) / total
        kept = np.where(distance <= trim**2 * np.maximum(spread, 0.05**2), weight, 0.0)
        mean = _weighted_mean(d, kept)
    total = kept.sum(axis=0)
    held = np.maximum(total, 1e-6)
    typical = (kept * flow.confidence).sum(axis=0) / held
    deviation = (kept * ((d - mean) ** 2).sum(axis=-1)).sum(axis=0) / held
    frames = total**2 / np.maximum((kept**2).sum(axis=0), 1e-6)
    tolerance = ROUND_TRIP_FLOOR**2 + ROUND_TRIP_SHARE**2 * (mean**2).sum(axis=-1)
    certain = tolerance / (tolerance + deviation / np.maximum(frames, 1.0))
    return mean, (typical * certain * total / (total + evidence**2)).astype(np.float32)


def _weighted_mean(d: np.ndarray, weight: np.ndarray) -> np.ndarray:
    total = np.maximum(weight.sum(axis=0), 1e-6)
    return np.stack([(weight * d[..., c]).sum(axis=0) / total for c in (0, 1)], axis=-1).astype(np.float32)


def flow_picture(
    displacement: Float[np.ndarray, "h w 2"],
    mask: Bool[np.ndarray, "h w"] | None = None,
    scale: float | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Flow as colour, sRGB: hue is direction (red to the right, then yellow-green down), brightness is speed.

    Args:
        displacement: px/frame.
        mask: shown grey outside.
        scale: speed of full brightness, px/frame; the 99th percentile where None.
    """
    d = np.nan_to_num(np.asarray(displacement, np.float32))
    speed = np.hypot(d[..., 0], d[..., 1])
    shown = speed if mask is None else speed[mask]
    if scale is None:
        scale = float(np.percentile(shown, 99)) if shown.size else 1.0
    hue = np.mod(np.degrees(np.arctan2(d[..., 1], d[..., 0])), 360.0) / 2.0  # OpenCV: half degrees in 8 bit
    value = 255.0 * np.clip(speed / max(scale, 1e-6), 0.0, 1.0)
    hsv = np.stack([hue, np.full_like(hue, 230.0), value], axis=-1).astype(np.uint8)
    picture = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
    if mask is not None:
        picture[~np.asarray(mask, bool)] = 96
    return picture


def _grey(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
