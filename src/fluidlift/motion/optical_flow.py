"""Optical flow between neighbouring frames (paper: V_2D): the estimators, and the one door to all of them.

What several frames say together is in `motion.multiframe`, how far flow is trusted in `motion.confidence`.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.errors import require
from fluidlift.motion.confidence import flow_confidence, grey, texture_strength, there_and_back
from fluidlift.motion.multiframe import Progress, each_pair, mean_flow, multiframe_flow, result_arrays, running_window
from fluidlift.seams import FlowEstimator
from fluidlift.types import PixelFlow

__all__ = [
    "ESTIMATORS",
    "METHODS",
    "DenseInverseSearch",
    "Farneback",
    "PairsAsTheyAre",
    "each_pair",
    "estimate_flow",
    "flow_confidence",
    "flow_of_pair",
    "flow_picture",
    "mean_flow",
    "texture_strength",
]


class DenseInverseSearch(FlowEstimator):
    """Dense inverse search with variational refinement (Kroeger et al. 2016).

    OpenCV's medium preset stops at half resolution; eddies are small, so the search goes on to full resolution with
    denser patches (about 10 % less end-point error on simulated rivers and honey).

    Args:
        half: stop at half resolution, as the preset does.
    """

    any_thread = True

    def __init__(self, half: bool = False) -> None:
        self._own, self._half = threading.local(), half  # OpenCV's object keeps its pictures in itself

    @property
    def halved(self) -> DenseInverseSearch:
        """The one that stops at half resolution: a quarter of the time."""
        return DenseInverseSearch(half=True)

    @property
    def _algorithm(self) -> Any:
        if not hasattr(self._own, "algorithm"):
            algorithm = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
            if not self._half:
                algorithm.setFinestScale(0)
                algorithm.setPatchStride(3)
            self._own.algorithm = algorithm
        return self._own.algorithm

    def displacement(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """float32 [H,W,2], px: where each pixel of `first` (u8 [H,W,3] or grey [H,W]) went in `second`."""
        nothing: Any = None  # an array would be taken for a first guess
        return self._algorithm.calc(grey(first), grey(second), nothing)


class Farneback(FlowEstimator):
    """Polynomial expansion (Farneback 2003), the estimator that the paper names."""

    any_thread = True

    def displacement(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """float32 [H,W,2], px: where each pixel of `first` (u8 [H,W,3] or grey [H,W]) went in `second`."""
        a, b = grey(first), grey(second)
        room = np.empty((*a.shape, 2), np.float32)
        return cv2.calcOpticalFlowFarneback(a, b, room, 0.5, 5, 21, 5, 5, 1.1, cv2.OPTFLOW_FARNEBACK_GAUSSIAN)


ESTIMATORS: dict[str, type[FlowEstimator]] = {"dis": DenseInverseSearch, "farneback": Farneback}
"""of single pairs"""
METHODS = ("multiframe", *ESTIMATORS)
"""names that `estimate_flow` knows"""


def estimate_flow(
    frames: UInt8[np.ndarray, "t h w 3"],
    *,
    method: str | FlowEstimator = "multiframe",
    progress: Progress | None = None,
    out: tuple[np.ndarray, np.ndarray] | None = None,
) -> PixelFlow:
    """Forward flow of every neighbouring pair with its confidence.

    Args:
        frames: sRGB; may be memory-mapped, a few are read at a time.
        method: "multiframe" (dense inverse search on what moves, see `motion.multiframe`), "dis" or "farneback" on the
            pictures as they are, or an estimator of one's own. A clip too short for a running mean is measured as it
            is.
        progress: called with (steps done, steps in all).
        out: displacement [T-1,H,W,2] and confidence [T-1,H,W] of a floating type to fill, such as mapped files;
            None: new ones, float32 and float16.

    Returns:
        displacement px/frame and confidence, those of `out` where given. Beyond the result, memory is that of a few
        pictures, however long the clip.

    Raises:
        ValueError: fewer than two frames, frames or `out` of the wrong shape or type, or an unknown method.
    """
    frames = np.asanyarray(frames)
    require(
        frames.ndim == 4 and frames.shape[-1] == 3 and frames.dtype == np.uint8,
        f"frames {frames.shape} {frames.dtype}",
        "u8 [T,H,W,3]",
    )
    require(len(frames) >= 2, f"{len(frames)} frame", "at least two")
    if not isinstance(method, FlowEstimator):
        require(method in METHODS, f"flow method '{method}'", "one of " + ", ".join(METHODS))
    estimator = method if isinstance(method, FlowEstimator) else ESTIMATORS.get(method, DenseInverseSearch)()
    if method == "multiframe" and running_window(0, len(frames)) is not None:
        return multiframe_flow(frames, estimator, progress, out=out)
    displacement, confidence = result_arrays(frames, out)
    pairs = len(displacement)
    calls = ((frames[t], frames[t + 1], estimator) for t in range(pairs))
    for t, found in enumerate(each_pair(flow_of_pair, calls, estimator)):
        displacement[t], confidence[t] = found
        if progress is not None:
            progress(t + 1, pairs)
    return PixelFlow(displacement, confidence)


def flow_of_pair(
    first: UInt8[np.ndarray, "h w 3"], second: UInt8[np.ndarray, "h w 3"], estimator: FlowEstimator
) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
    """Displacement (px, values that are not finite put to 0) and confidence between two pictures as they are.

    Where the estimator has an opinion of its own, trust is the product of that and of the round trip and the texture.
    """
    forward, backward, own = there_and_back(estimator, first, second)
    return forward, own * flow_confidence(first, forward, backward)


class PairsAsTheyAre:
    """Flow of the pairs of a clip, measured when it is asked for, each by itself (`flow_of_pair`).

    Args:
        frames: u8 [T,H,W,3]; may be memory-mapped.
        estimator: of flow between two pictures.
    """

    def __init__(self, frames: UInt8[np.ndarray, "t h w 3"], estimator: FlowEstimator) -> None:
        self._frames, self._estimator = frames, estimator

    def __call__(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Displacement [H,W,2], px, and confidence [H,W] from frame t to t + 1."""
        return flow_of_pair(self._frames[t], self._frames[t + 1], self._estimator)

    def in_order(self, pairs: Iterable[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """As a call for each of the pairs, several of them measured side by side (`each_pair`)."""
        calls = ((self._frames[t], self._frames[t + 1], self._estimator) for t in pairs)
        return each_pair(flow_of_pair, calls, self._estimator)


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
